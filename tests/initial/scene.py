"""Blocks with known truth, to be spoilt by each test: a strip over hilly ground, and whatever is known of it."""

import dataclasses

import equinox as eqx
import numpy as np

from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import Brown, InteriorOrientation, Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import Mount, StripBias
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints
from jaxphoto.unknowns import FIXED, Unknowns, uniform_priors
from tests.formulas import camera_from_object

C = 35.0
K1 = -9e-5


def measured(ideal):
    """Measured coordinates of a barrel: Newton's method for ideal = measured (1 - K1 r^2), by radius."""
    target = np.linalg.norm(ideal, axis=-1, keepdims=True)
    r = target.copy()
    for _ in range(30):
        r -= (r * (1 - K1 * r**2) - target) / (1 - 3 * K1 * r**2)
    return ideal * np.divide(r, target, out=np.ones_like(r), where=target > 0)


def ideal_images(position, matrix, points):
    """Ideal image coordinates of points, and which are in front of the camera and on its format."""
    u, v, w = matrix @ (points - position).T
    xy = -C * np.column_stack([u, v]) / w[:, None]
    return xy, (w < 0) & (np.abs(xy) < [18, 12]).all(axis=1)


@dataclasses.dataclass
class Truth:
    positions: np.ndarray
    matrices: np.ndarray
    points: np.ndarray


def strip(n_images=6, seed=0, noise_mm=0.0):
    """A block of one strip flown east, 60 % overlap, of which nothing is known but the camera; and its truth."""
    rng = np.random.default_rng(seed)
    x = 400.0 * np.arange(n_images)
    positions = np.column_stack([x, 20 * rng.normal(size=n_images), 1000 + 10 * rng.normal(size=n_images)])
    tilts = 0.03 * rng.normal(size=(n_images, 3))
    matrices = np.stack([camera_from_object(*t) for t in tilts])
    east, north = np.meshgrid(np.arange(-450, x[-1] + 451, 90), np.arange(-270, 271, 90))
    points = np.column_stack([east.ravel(), north.ravel(), rng.uniform(0, 120, east.size)])
    rows = []
    for i in range(n_images):
        xy, seen = ideal_images(positions[i], matrices[i], points)
        rows += [(i, p, *measured(xy[p])) for p in np.flatnonzero(seen)]
    image, point, *xy = (np.array(v) for v in zip(*sorted(rows, key=lambda r: r[1]), strict=True))
    image, point, xy = image.astype(int), point.astype(int), np.column_stack(xy)
    often = np.bincount(point, minlength=len(points)) >= 2
    renumbered = np.cumsum(often) - 1
    keep = often[point]
    xy = xy[keep] + noise_mm * rng.normal(size=(keep.sum(), 2))
    truth = Truth(positions, matrices, points[often])
    return block_of(image[keep], renumbered[point[keep]], xy, n_images, often.sum()), truth


def block_of(image, point, xy, n_images, n_points):
    """A block of which nothing is known but the camera."""
    unknowns = Unknowns(
        interior={"kodak": InteriorOrientation(C, 0.0, 0.0, Brown(k1=K1))},
        exterior=ExteriorOrientation(np.zeros((n_images, 3)), np.tile(np.eye(3), (n_images, 1, 1))),
        points=np.zeros((n_points, 3)),
        mounts={"default": Mount(np.zeros(3), np.zeros(3))},
        strips={"default": StripBias(np.zeros(3), np.zeros(3))},
    )
    return Block(
        title="scene",
        images=tuple(f"i{k}" for k in range(n_images)),
        points=tuple(f"p{k}" for k in range(n_points)),
        sensors={"kodak": Sensor(4500, 3000, 0.008)},
        image_camera=("kodak",) * n_images,
        image_mount=("default",) * n_images,
        image_strip=("default",) * n_images,
        image_time=np.zeros(n_images),
        image_points=ImagePoints(image, point, xy, np.full_like(xy, 0.004)),
        control=ControlCoordinates.none(),
        fixed=ControlCoordinates.none(),
        check=ControlCoordinates.none(),
        stations=CameraPositions.none(),
        attitudes=Attitudes.none(),
        distances=Distances.none(),
        datum=Datum(),
        start=Start(unknowns, np.zeros(n_images, bool), np.zeros(n_points, bool)),
        priors=uniform_priors(unknowns, FIXED),
    )


def with_known(block, truth, images=(), points=()):
    """The block with the true orientation of `images` and the true coordinates of `points` known."""
    u = block.start.unknowns
    position, matrix = u.exterior.position.copy(), u.exterior.camera_from_object.copy()
    coordinates = u.points.copy()
    image_known, point_known = block.start.image_known.copy(), block.start.point_known.copy()
    images, points = np.asarray(images, int), np.asarray(points, int)
    position[images], matrix[images], image_known[images] = truth.positions[images], truth.matrices[images], True
    coordinates[points], point_known[points] = truth.points[points], True
    places = lambda v: (v.exterior.position, v.exterior.camera_from_object, v.points)  # noqa: E731
    unknowns = eqx.tree_at(places, u, (position, matrix, coordinates))
    return eqx.tree_at(lambda b: b.start, block, Start(unknowns, image_known, point_known))


def coordinate_rows(values, who, axes=(0, 1, 2)):
    """ControlRows of every axis of `axes` of `who`, with the values of the table `values`."""
    who, axis = (grid.ravel() for grid in np.meshgrid(np.asarray(who, int), axes, indexing="ij"))
    return ControlCoordinates(who, axis, values[who, axis], np.full(len(who), 0.03))
