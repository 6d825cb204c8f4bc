"""Orient a block without initial values by COLMAP, with matches derived from its points.

Gross errors remain in the block; COLMAP excludes them from the initial values.
"""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import numpy as np

from jaxphoto.block import Block, Start
from jaxphoto.camera import InteriorOrientation, Perspective, get_parameter
from jaxphoto.errors import BlockError
from jaxphoto.initial.approximate import completed
from jaxphoto.initial.matches import PairMatches
from jaxphoto.initial.rays import ideal_coordinates
from jaxphoto.procedures.orientation.colmap import MappedCamera, map_images
from jaxphoto.procedures.orientation.known_frame import in_known_frame
from jaxphoto.procedures.orientation.orient_photographs import Report
from jaxphoto.unknowns import FIXED

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
