"""Orient a block without initial values by COLMAP, with matches derived from its points.

Gross errors remain in the block; COLMAP excludes them from the initial values.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.block import Block, Start
from jaxphoto.camera import InteriorOrientation, Perspective, get_parameter
from jaxphoto.errors import BlockError
from jaxphoto.initial.approximate import completed
from jaxphoto.initial.matches import PairMatches
from jaxphoto.initial.quaternions import average_rotation
from jaxphoto.initial.rays import ideal_coordinates
from jaxphoto.procedures.orientation.colmap import MappedCamera, Network, map_images
from jaxphoto.procedures.orientation.orient_photographs import Report
from jaxphoto.unknowns import FIXED

# Minimum ratio of the spread of known points across their line to the spread along it; below, a rotation is
# undetermined.
_LINE = 1e-3
# Minimum of the same ratio if known images can determine the rotation: approximate positions of a strip scatter by more
# than `_LINE`.
_NEARLY_A_LINE = 0.05


class Similarity(NamedTuple):
    """Similarity: X in one frame is `shift + scale * turn @ x` of x in another."""

    shift: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3 3"]
    scale: float

    def of(self, x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Transform points to the other frame."""
        return self.shift + self.scale * x @ self.turn.T

    def turned(self, camera_from_object: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
        """Transform rotations to the other frame."""
        return camera_from_object @ self.turn.T

    def of_block(self, block: Block) -> Block:
        """Transform the initial values of `block` to the other frame; observations are unchanged."""
        unknowns = block.start.unknowns
        exterior = dataclasses.replace(
            unknowns.exterior,
            position=self.of(np.asarray(unknowns.exterior.position, float)),  # type: ignore[arg-type]
            camera_from_object=self.turned(np.asarray(unknowns.exterior.camera_from_object, float)),  # type: ignore[arg-type]
        )
        unknowns = dataclasses.replace(unknowns, exterior=exterior, points=self.of(np.asarray(unknowns.points, float)))
        return dataclasses.replace(block, start=dataclasses.replace(block.start, unknowns=unknowns))


def similarity_between(
    there: Float[np.ndarray, "n 3"], here: Float[np.ndarray, "n 3"], line: float = _LINE
) -> Similarity | None:
    """Estimate the similarity from `there` to `here` by least squares; None if it is undetermined.

    Umeyama (1991), "Least-squares estimation of transformation parameters between two point patterns". Three points are
    needed whose spread across their line exceeds the fraction `line` of that along it.
    """
    if len(here) < 3:
        return None
    a, b = there - there.mean(axis=0), here - here.mean(axis=0)
    for spread in (np.linalg.svd(v, compute_uv=False) for v in (a, b)):
        if not spread[1] > line * spread[0]:
            return None
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = (u * sign) @ vt
    scale = float(np.sum(d * sign) / np.sum(a * a))
    return Similarity(here.mean(axis=0) - scale * turn @ there.mean(axis=0), turn, scale)


def in_known_frame(block: Block, network: Network, known: Start) -> Network:
    """Transform `network` to the frame of known points and stations of `block`, then of the images of `known`.

    If known points are few or nearly collinear, images and points of `known` are added. If all are nearly collinear,
    known images determine the rotation, and for a single point, scale bars determine the scale. Without information,
    frame and scale of the network are unchanged.

    Raises BlockError for one or two known points, or collinear ones, without a known image.
    """
    there, here = _surveyed(block, network)
    images = np.flatnonzero(np.asarray(known.image_known) & network.oriented)
    similarity = similarity_between(there, here, _NEARLY_A_LINE if len(images) else _LINE)
    if similarity is None and len(images):
        similarity = _by_images(block, network, known, images, there, here)
    elif similarity is None and len(here):
        raise BlockError(
            f"the images are oriented to one another, but the {len(here)} known points and stations that they see are "
            "fewer than three or lie on a line, so the frame is undetermined: measure more known points, or give "
            "approximate X_m, Y_m, Z_m, omega_deg, phi_deg, kappa_deg in images.csv"
        )
    elif similarity is None:
        similarity = Similarity(np.zeros(3), np.eye(3), _scale_of_bars(block, network))
    return network._replace(
        positions=similarity.of(network.positions),
        camera_from_object=similarity.turned(network.camera_from_object),
        points=similarity.of(network.points),
    )


def _surveyed(block: Block, network: Network) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return known points and stations of oriented images: network coordinates and surveyed coordinates."""
    points = np.flatnonzero(np.asarray(block.start.point_known) & _met(network))
    station = np.full((len(block.images), 3), np.nan)
    station[np.asarray(block.stations.who), np.asarray(block.stations.axis)] = np.asarray(block.stations.value, float)
    images = np.flatnonzero(np.isfinite(station).all(axis=1) & network.oriented)
    there = np.concatenate([network.points[points], network.positions[images]])
    return there, np.concatenate([np.asarray(block.start.unknowns.points, float)[points], station[images]])


def _by_images(block: Block, network: Network, known: Start, images, there, here) -> Similarity:
    """Estimate the similarity with `images` and points of `known` added, and with rotations if all are nearly
    collinear.
    """
    exterior = known.unknowns.exterior
    points = np.flatnonzero(np.asarray(known.point_known) & ~np.asarray(block.start.point_known) & _met(network))
    there = np.concatenate([there, network.points[points], network.positions[images]])
    positions = np.asarray(exterior.position, float)[images]
    here = np.concatenate([here, np.asarray(known.unknowns.points, float)[points], positions])
    similarity = similarity_between(there, here, _NEARLY_A_LINE)
    if similarity is not None:
        return similarity
    matrices = np.asarray(exterior.camera_from_object, float)[images]
    turn, _ = average_rotation(np.einsum("nji,njk->nik", matrices, network.camera_from_object[images]))
    a, b = there - there.mean(axis=0), here - here.mean(axis=0)
    spread = float(np.sum(a * a))
    scale = float(np.sum(b * (a @ turn.T))) / spread if len(here) > 1 and spread > 0 else 0.0
    if not scale > 0:
        scale = _scale_of_bars(block, network)
    return Similarity(here.mean(axis=0) - scale * turn @ there.mean(axis=0), turn, scale)


def _scale_of_bars(block: Block, network: Network) -> float:
    """Return the median scale of the scale bars with both ends; 1 if there are none."""
    ends = np.asarray(block.distances.points)
    met = _met(network)[ends].all(axis=1)
    if not met.any():
        return 1.0
    length = np.linalg.norm(network.points[ends[met, 0]] - network.points[ends[met, 1]], axis=1)
    return float(np.median(np.asarray(block.distances.value, float)[met] / length))


def _met(network: Network) -> Bool[np.ndarray, " points"]:
    return np.isfinite(network.points).all(axis=1)


# Minimum number of matches of a pair, and of points of an image: manual image points are few and mostly correct.
_MIN_MATCHES, _MIN_POINTS = 8, 6


def orient_block(block: Block, report: Report = lambda text: None) -> Block:
    """Add initial values for images and points of `block`, from its image points alone.

    The frame is defined by three or more known points and camera stations that are not collinear, else by known images;
    else it is arbitrary. A principal distance that is not fixed starts at COLMAP's estimate. Known values are
    unchanged; images and points that cannot be oriented remain unknown.

    Raises BlockError for cameras that are not perspective, if no two images can be oriented, for unconnected groups of
    images, and for too few known points and stations.
    """
    _check_perspective(block)
    start, measured = block.start.unknowns, block.image_points
    cameras = sorted(set(block.image_camera))
    rows = [np.flatnonzero(np.asarray(measured.image) == i) for i in range(len(block.images))]
    point_of = [np.asarray(measured.point)[row] for row in rows]
    features = [
        block.sensors[name].px_from_mm(ideal_coordinates(start.interior[name], np.asarray(measured.xy, float)[row]))
        for name, row in zip(block.image_camera, rows, strict=True)
    ]
    report(f"orienting {len(block.images)} images (COLMAP)")
    network = map_images(
        block.images,
        [_mapped_camera(block, name) for name in cameras],
        [cameras.index(name) for name in block.image_camera],
        features,
        list(_common_points(point_of)),
        _MIN_MATCHES,
        _MIN_POINTS,
    )
    # If COLMAP split a point, use the part with most rays.
    points = np.full((len(block.points), 3), np.nan)
    number = np.array([point_of[i][f] for i, f in zip(network.image, network.feature, strict=True)], int)
    order = np.argsort(np.bincount(network.point)[network.point], kind="stable")
    points[number[order]] = network.points[network.point[order]]
    network = in_known_frame(block, network._replace(points=points), completed(block))

    image_known, point_known = np.asarray(block.start.image_known), np.asarray(block.start.point_known)
    met = np.isfinite(network.points).all(axis=1) & ~point_known
    oriented = network.oriented & ~image_known
    old = (start.exterior.position, start.exterior.camera_from_object, start.points)
    new = (network.positions, network.camera_from_object, network.points)
    is_new = (oriented[:, None], oriented[:, None, None], met[:, None])
    places = lambda u: (u.exterior.position, u.exterior.camera_from_object, u.points)  # noqa: E731
    unknowns = eqx.tree_at(places, start, tuple(np.where(*v) for v in zip(is_new, new, old, strict=True)))
    interior = {
        name: _with_c(start.interior[name], c_px * block.sensors[name].pixel_mm)
        for name, c_px in zip(cameras, network.c_px, strict=True)
        if not _fixed(block, name)
    }
    unknowns = dataclasses.replace(unknowns, interior=start.interior | interior)
    return dataclasses.replace(block, start=Start(unknowns, image_known | oriented, point_known | met))


def _mapped_camera(block: Block, name: str) -> MappedCamera:
    sensor, interior = block.sensors[name], block.start.unknowns.interior[name]
    return MappedCamera(sensor.width_px, sensor.height_px, float(interior.c) / sensor.pixel_mm, _fixed(block, name))


def _fixed(block: Block, name: str) -> bool:
    return get_parameter(block.priors.interior[name], "c_mm") == FIXED


def _with_c(interior: InteriorOrientation, c_mm: float) -> InteriorOrientation:
    return dataclasses.replace(interior, c=np.asarray(c_mm))  # type: ignore[arg-type]


def _check_perspective(block: Block) -> None:
    for name, interior in block.start.unknowns.interior.items():
        if type(interior.projection) is not Perspective:
            raise BlockError(
                f"camera {name} has the projection {interior.projection.name}, but orientation from image points "
                "alone needs a perspective camera: give approximate values in images.csv, stations and attitudes, or "
                "four known points in each image"
            )


def _common_points(points: list[np.ndarray]) -> Iterator[PairMatches]:
    """Yield the common points of each two images, as indices of their rows."""
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            _, one, other = np.intersect1d(points[i], points[j], return_indices=True)
            if len(one):
                yield PairMatches(i, j, np.column_stack([one, other]))
