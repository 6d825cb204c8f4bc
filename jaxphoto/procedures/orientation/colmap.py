"""Incremental mapping by COLMAP: features and their matches -> exterior orientation, object points and tracks.

COLMAP (Schönberger and Frahm 2016, "Structure-from-Motion Revisited") verifies every pair by its essential or
fundamental matrix or homography, and adds images by resection, triangulation and local bundle adjustment. Its input
here is ideal image coordinates of the initial camera, and it may estimate the principal distance and one radial term.
`jaxphoto.procedures.orientation.orient` adjusts its result, which are initial values.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.errors import BlockError, GroupsError
from jaxphoto.initial.matches import PairMatches, connected_images

# Minimum angles (deg) between rays of a point; the smaller one is tried if images are missing.
_ANGLES_DEG = (1.5, 0.4)
# Maximum ratio of the estimated principal distance to its initial value.
_PLAUSIBLE = 1.5
# Minimum inlier ratio of a pair: fewer matches agree by chance.
_MIN_INLIER_RATIO = 0.25


# Maximum misclosure (px) of two images that differ by a rotation only.
_ROTATED_PX = 2.0
_ONE_PLACE = "they were taken from one place, or see too few points at a wide enough angle"


class MappedCamera(NamedTuple):
    """Camera without distortion, in pixels."""

    width_px: int
    height_px: int
    c_px: float
    fixed: bool
    """True if the principal distance and the radial term are not estimated."""


class Network(NamedTuple):
    """Images oriented in an arbitrary frame, and their points."""

    positions: Float[np.ndarray, "images 3"]
    camera_from_object: Float[np.ndarray, "images 3 3"]
    oriented: Bool[np.ndarray, " images"]
    order: tuple[int, ...]
    """Oriented images in COLMAP's order."""
    points: Float[np.ndarray, "points 3"]
    image: Int[np.ndarray, " rows"]
    feature: Int[np.ndarray, " rows"]
    point: Int[np.ndarray, " rows"]
    c_px: tuple[float, ...]
    """Principal distance of each camera."""
    verified: tuple[PairMatches, ...]
    """Inlier matches of each pair."""


def import_pycolmap() -> Any:
    """Import pycolmap and disable its log output. Raises BlockError if it is not installed."""
    try:
        # If OpenCV 5.0 is loaded after pycolmap 4.2.1, it terminates the process when it writes a PNG.
        import cv2  # noqa: F401
        import pycolmap
    except ImportError:
        raise BlockError(
            "images are oriented by COLMAP, which is not installed: pip install 'jaxphoto[photos]'"
        ) from None
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    return pycolmap


def map_images(
    names: Sequence[str],
    cameras: Sequence[MappedCamera],
    image_camera: Sequence[int],
    features_px: Sequence[Float[np.ndarray, "_ 2"]],
    matches: Sequence[PairMatches],
    min_matches: int,
    min_points: int,
) -> Network:
    """Orient the images `names` from `matches` of their features, which may include gross errors.

    `features_px` are ideal coordinates in pixels (column, row), `image_camera` the camera of each image. A pair needs
    `min_matches` inliers, an image `min_points`.

    Raises BlockError if no two images can be oriented, and GroupsError for unconnected groups.
    """
    pycolmap = import_pycolmap()
    if not (enough := [m for m in matches if len(m.features) >= min_matches]):
        few = max(matches, key=lambda m: len(m.features), default=None)
        why = (
            "their pairs have no matches"
            if few is None
            else f"images {names[few.first]} and {names[few.second]} have {len(few.features)} matches, and "
            f"{min_matches} are needed"
        )
        raise BlockError(_no_pair(len(names), why))
    with tempfile.TemporaryDirectory() as folder:
        database = f"{folder}/database.db"
        write_database(database, cameras, image_camera, features_px, enough)
        two_view = pycolmap.TwoViewGeometryOptions()
        two_view.min_num_inliers, two_view.min_inlier_ratio = min_matches, _MIN_INLIER_RATIO
        two_view.ransac.random_seed, two_view.detect_watermark = 0, False
        pycolmap.geometric_verification(database, two_view_geometry_options=two_view)
        verified = _verified_matches(pycolmap, database)
        rays = [_rays(cameras[k], xy) for k, xy in zip(image_camera, features_px, strict=True)]
        if verified and all(_only_rotated(rays, match, cameras[0].c_px) for match in verified):
            raise BlockError(_no_pair(len(names), _ONE_PLACE))
        _check_connected(names, verified)
        best, score = None, (False, 0, 0)
        wanted = len({image for m in verified for image in (m.first, m.second)})
        attempts = [(angle, free) for angle in _ANGLES_DEG for free in (True, False)]
        for angle, free in attempts:
            if free and all(camera.fixed for camera in cameras):
                continue
            options = _options(pycolmap, cameras, angle, free, min_matches, min_points)
            models = pycolmap.incremental_mapping(database, folder, folder, options).values()
            for model in models:
                quality = _score(model, cameras)
                if quality > score:
                    best, score = model, quality
            if score[:2] == (True, wanted):
                break
        if best is None:
            raise BlockError(_no_pair(len(names), _ONE_PLACE))
        return _network(best, len(names), len(cameras), verified)


def _verified_matches(pycolmap: Any, database: str) -> tuple[PairMatches, ...]:
    """Read the inlier matches of all pairs from a COLMAP `database`."""
    verified = []
    with pycolmap.Database.open(database) as stored:
        for pair, geometry in zip(*stored.read_two_view_geometries(), strict=True):
            one, other = (image - 1 for image in pycolmap.pair_id_to_image_pair(pair))
            features = np.asarray(geometry.inlier_matches, int).reshape(-1, 2)
            if len(features):
                verified.append(PairMatches(one, other, features))
    return tuple(sorted(verified, key=lambda m: m[:2]))


def _rays(camera: MappedCamera, xy_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Return unit directions of ideal coordinates, in COLMAP's camera frame."""
    xy = (xy_px - np.array([camera.width_px, camera.height_px]) / 2) / camera.c_px
    rays = np.column_stack([xy, np.ones(len(xy))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _only_rotated(rays: list[np.ndarray], match: PairMatches, c_px: float) -> bool:
    """Return True if a rotation maps the rays of one image to the other: both images have one projection centre."""
    one, other = rays[match.first][match.features[:, 0]], rays[match.second][match.features[:, 1]]
    u, _, vt = np.linalg.svd(one.T @ other)
    turned = one @ (u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.median(np.linalg.norm(turned - other, axis=1))) < _ROTATED_PX / c_px


def _no_pair(n_images: int, why: str) -> str:
    return (
        f"no two of the {n_images} images can be oriented to one another ({why}): take photographs that overlap by "
        "more than half, from different places"
    )


def _check_connected(names: Sequence[str], verified: Sequence[PairMatches]) -> None:
    if not verified:
        raise BlockError(_no_pair(len(names), "no pair has enough matches that agree with one relative orientation"))
    groups = [g for g in connected_images(len(names), list(verified)) if len(g) > 1]
    if len(groups) > 1:
        by_name = [[names[i] for i in group] for group in groups]
        raise GroupsError(
            f"the images are {len(groups)} groups that have too few points in common to be oriented to one another "
            f"({'; '.join(map(', '.join, by_name))}): orient each separately, or add images that connect them",
            by_name,
        )


def write_database(
    database: Path | str,
    cameras: Sequence[MappedCamera],
    image_camera: Sequence[int],
    features_px: Sequence[Float[np.ndarray, "_ 2"]],
    matches: Sequence[PairMatches],
    prior_c: bool = True,
) -> None:
    """Write a COLMAP database; its ids are the indices plus one. `prior_c`: the principal distances are known."""
    pycolmap = import_pycolmap()
    with pycolmap.Database.open(database) as stored, pycolmap.DatabaseTransaction(stored):
        for camera in cameras:
            initial = pycolmap.Camera.create_from_model_name(
                0, "SIMPLE_RADIAL", camera.c_px, camera.width_px, camera.height_px
            )
            initial.has_prior_focal_length = prior_c
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, stored.write_camera(initial)))
            stored.write_rig(rig)
        for k, (of_camera, features) in enumerate(zip(image_camera, features_px, strict=True)):
            image = stored.write_image(pycolmap.Image(name=str(k), camera_id=of_camera + 1))
            frame = pycolmap.Frame()
            frame.rig_id = of_camera + 1
            frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, of_camera + 1), image))
            stored.write_frame(frame)
            stored.write_keypoints(image, np.asarray(features, np.float32).reshape(-1, 2))
        for match in matches:
            stored.write_matches(match.first + 1, match.second + 1, np.asarray(match.features, np.uint32))


def _options(pycolmap: Any, cameras, angle: float, free: bool, min_matches: int, min_points: int) -> Any:
    """Return mapping options. COLMAP's defaults find no initial pair if all images look along their path."""
    options = pycolmap.IncrementalPipelineOptions(random_seed=0)
    options.extract_colors, options.min_model_size, options.max_num_models = False, 2, 4
    options.min_num_matches = min_matches
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = free
    options.constant_cameras = {k + 1 for k, camera in enumerate(cameras) if camera.fixed}
    options.mapper.init_max_forward_motion, options.mapper.init_min_tri_angle = 1.0, 4.0
    options.mapper.init_min_num_inliers = min(30, 2 * min_matches)
    options.mapper.abs_pose_min_num_inliers = min_points
    options.mapper.filter_min_tri_angle = options.triangulation.min_angle = angle
    options.triangulation.ignore_two_view_tracks = False
    return options


def _score(model: Any, cameras: Sequence[MappedCamera]) -> tuple[bool, int, int]:
    """Return (True if all principal distances are plausible, number of images, number of image points)."""
    ratios = [c.focal_length / cameras[k - 1].c_px for k, c in model.cameras.items()]
    plausible = all(1 / _PLAUSIBLE < ratio < _PLAUSIBLE for ratio in ratios)
    return plausible, model.num_reg_images(), model.compute_num_observations()


def _network(model: Any, n_images: int, n_cameras: int, verified: tuple[PairMatches, ...]) -> Network:
    positions, matrices = np.zeros((n_images, 3)), np.tile(np.eye(3), (n_images, 1, 1))
    order = tuple(int(image) - 1 for image in model.reg_image_ids())
    for k in order:
        image = model.image(k + 1)
        positions[k] = image.projection_center()
        # COLMAP's camera looks along +z, with y down.
        matrices[k] = np.diag([1.0, -1, -1]) @ image.cam_from_world().rotation.matrix()
    tracks = [point.track.elements for point in model.points3D.values()]
    rows = np.array([(e.image_id - 1, e.point2D_idx, p) for p, track in enumerate(tracks) for e in track], int)
    # COLMAP may join two features of an image to one point: use the first.
    rows = rows.reshape(-1, 3)[np.unique(rows.reshape(-1, 3)[:, [2, 0]], axis=0, return_index=True)[1]]
    return Network(
        positions,
        matrices,
        np.isin(np.arange(n_images), order),
        order,
        np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3),
        rows[:, 0],
        rows[:, 1],
        rows[:, 2],
        tuple(model.camera(k + 1).focal_length for k in range(n_cameras)),
        verified,
    )
