"""A block of which too little is known but what was measured in its images: oriented as photographs are.

Its points say which measurements belong together, so there is nothing to match. Gross errors stay in the block; they
are only kept from spoiling its start.
"""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import numpy as np

from jaxphoto.block import Block, Start
from jaxphoto.camera import Perspective
from jaxphoto.errors import BlockError
from jaxphoto.initial.approximate import completed
from jaxphoto.initial.matches import PairMatches
from jaxphoto.procedures.orientation.growing import grown
from jaxphoto.procedures.orientation.network import Sight, sight_of
from jaxphoto.procedures.orientation.onto_known import onto_known
from jaxphoto.procedures.orientation.refine import calibration_of
from jaxphoto.procedures.orientation.related_pairs import LENS_PX, MOST, Report, check_connected, relate

# Points measured by hand are few, and mostly right.
_LEAST_MATCHES, _LEAST_POINTS = 8, 6


def orient_block(block: Block, report: Report = lambda text: None) -> Block:
    """`block` with a start for its images and points, found from its image points alone.

    The frame is that of its known points and camera stations, where three or more not on a line are seen, else that of
    its known images; where nothing is known, it is a frame of its own. Interior orientation that is not fixed starts
    where the images want it. What was known stays as it is; images and points that cannot be oriented stay unknown.

    Raises BlockError for cameras that are not perspective, where no two images begin a network, for groups of images
    that nothing connects, and where known points and stations are too few for the frame.
    """
    _check_perspective(block)
    sight = sight_of(block, block.start.unknowns.interior)
    calibration = calibration_of(block)
    pixel = float(np.median([s.pixel_mm / float(block.start.unknowns.interior[n].c) for n, s in block.sensors.items()]))
    lens = LENS_PX * pixel if any(calibration.names.values()) else 0.0
    rays = [sight.ray[sight.of_image(i)] for i in range(len(block.images))]
    sigma = float(np.median(sight.sigma))
    loose = float(np.hypot(sigma, lens))
    related = relate(block.images, rays, loose, list(_common_points(sight, len(rays))), _LEAST_MATCHES, report)
    check_connected(block.images, related)
    most = MOST * loose / sigma
    network = grown(block, related.pairs, calibration, _LEAST_POINTS, most, report).network
    found = onto_known(block, network, completed(block))

    start = block.start.unknowns
    image_known, point_known = np.asarray(block.start.image_known), np.asarray(block.start.point_known)
    met = np.isfinite(found.points).all(axis=1) & found.met(sight) & ~point_known
    oriented = found.oriented & ~image_known
    given = (start.exterior.position, start.exterior.camera_from_object, start.points)
    new = (found.positions, found.camera_from_object, found.points)
    is_new = (oriented[:, None], oriented[:, None, None], met[:, None])
    places = lambda u: (u.exterior.position, u.exterior.camera_from_object, u.points)  # noqa: E731
    unknowns = eqx.tree_at(places, start, tuple(np.where(*v) for v in zip(is_new, new, given, strict=True)))
    unknowns = dataclasses.replace(unknowns, interior=found.interior)
    return dataclasses.replace(block, start=Start(unknowns, image_known | oriented, point_known | met))


def _check_perspective(block: Block) -> None:
    for name, interior in block.start.unknowns.interior.items():
        if type(interior.projection) is not Perspective:
            raise BlockError(
                f"camera {name} has the projection {interior.projection.name}, and images are oriented from nothing "
                "but their points for perspective cameras only: give approximate values in images.csv, stations and "
                "attitudes, or four known points in each image"
            )


def _common_points(sight: Sight, n_images: int) -> Iterator[PairMatches]:
    """The points that each two images have in common, as indices of their rows."""
    points = [sight.point[sight.of_image(i)] for i in range(n_images)]
    for i in range(n_images):
        for j in range(i + 1, n_images):
            common, one, other = np.intersect1d(points[i], points[j], return_indices=True)
            if len(common) >= _LEAST_MATCHES:
                yield PairMatches(i, j, np.column_stack([one, other]))
