"""Simulated photographs to be oriented: features and matches of a scene with known truth, false matches among them."""

from typing import NamedTuple

import numpy as np

from jaxphoto.camera import Sensor
from jaxphoto.orientation.matches import PairMatches
from tests.formulas import camera_from_object

PIXEL = 0.005
SENSOR = Sensor(1600, 1200, PIXEL)


class Camera(NamedTuple):
    """The true camera: c, principal point (mm), K1, K2, in the sense of `jaxphoto.Brown`."""

    c: float = 8.0
    x_p: float = 0.04
    y_p: float = -0.03
    k1: float = 1.5e-3
    k2: float = -2e-5

    def measured(self, ideal):
        """From ideal to measured coordinates: Newton's method for r_ideal = r - K1 r^3 - K2 r^5."""
        target = np.linalg.norm(ideal, axis=1, keepdims=True)
        r = target.copy()
        for _ in range(30):
            r -= (r - self.k1 * r**3 - self.k2 * r**5 - target) / (1 - 3 * self.k1 * r**2 - 5 * self.k2 * r**4)
        return ideal * np.divide(r, target, out=np.ones_like(r), where=target > 0) + [self.x_p, self.y_p]


class Scene(NamedTuple):
    """Truth of images and points."""

    positions: np.ndarray
    matrices: np.ndarray
    points: np.ndarray


class Photographs(NamedTuple):
    """What `orient` is given, and the truth it came from."""

    names: tuple[str, ...]
    features: list[np.ndarray]
    matches: list[PairMatches]
    scene: Scene
    camera: Camera
    point_of: list[np.ndarray]
    """The true point of each feature, -1 for one of none."""


def looking(position, at, roll):
    """`camera_from_object` of a camera that looks from `position` to `at`, rolled about its axis."""
    back = (position - at) / np.linalg.norm(position - at)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    s, c = np.sin(roll), np.cos(roll)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ np.stack([right, np.cross(back, right), back])


def convergent(n_images=10, n_points=400, seed=0):
    """Images round a heap of points, at two heights, some of them rolled by a quarter of a turn."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (n_points, 3)) * [3.0, 3.0, 1.2]
    angles = 2 * np.pi * np.arange(n_images) / n_images * 0.7
    height = 2.5 + 2.0 * (np.arange(n_images) % 2)
    positions = np.column_stack([7.5 * np.cos(angles), 7.5 * np.sin(angles), height])
    positions += 0.2 * rng.normal(size=(n_images, 3))
    rolls = np.where(np.arange(n_images) % 3 == 0, np.pi / 2, 0.0) + 0.05 * rng.normal(size=n_images)
    matrices = np.stack([looking(p, 0.3 * rng.normal(size=3), r) for p, r in zip(positions, rolls, strict=True)])
    return Scene(positions, matrices, points)


def aerial(strips=2, per_strip=6, n_points=600, seed=0):
    """Strips flown there and back over hilly ground, 70 % overlap along and across."""
    rng = np.random.default_rng(seed)
    positions, matrices = [], []
    for s in range(strips):
        for k in range(per_strip):
            x = 30.0 * (k if s % 2 == 0 else per_strip - 1 - k)
            positions.append([x, 40.0 * s, 100.0])
            kappa = np.pi * (s % 2)
            matrices.append(camera_from_object(*(0.03 * rng.normal(size=2)), kappa + 0.03 * rng.normal()))
    positions = np.array(positions) + rng.normal(size=(len(positions), 3))
    low, high = [-50, -40], [30.0 * per_strip + 20, 40.0 * strips]
    points = np.column_stack([rng.uniform(low, high, (n_points, 2)), 25 * rng.random(n_points)])
    return Scene(positions, np.stack(matrices), points)


TRUE = Camera()


def photographed(scene, camera=TRUE, noise_px=0.3, false=0.0, seed=1, clutter=60, found=0.8):
    """Features of the points of `scene`, in disorder and among others, and matches of which the part `false` is."""
    rng = np.random.default_rng(seed)
    features, point_of = [], []
    half = np.array([SENSOR.width_mm, SENSOR.height_mm]) / 2
    for position, matrix in zip(scene.positions, scene.matrices, strict=True):
        u, v, w = matrix @ (scene.points - position).T
        ideal = -camera.c * np.column_stack([u, v]) / w[:, None]
        xy = camera.measured(ideal)
        seen = np.flatnonzero((w < 0) & (np.abs(xy) < half).all(axis=1) & (np.linalg.norm(ideal, axis=1) < 1.3 * 5.0))
        xy = np.concatenate([xy[seen], rng.uniform(-half, half, (clutter, 2))])
        xy[: len(seen)] += noise_px * PIXEL * rng.normal(size=(len(seen), 2))
        order = rng.permutation(len(xy))
        features.append(xy[order])
        point_of.append(np.append(seen, np.full(clutter, -1))[order])
    # False matches come from a stream of their own, so that the true ones are the same with and without them.
    wrong = np.random.default_rng(seed + 1000)
    matches = []
    for i in range(len(features)):
        for j in range(i + 1, len(features)):
            _, one, other = np.intersect1d(point_of[i], point_of[j], return_indices=True)
            true = point_of[i][one] >= 0
            true &= rng.random(len(true)) < found
            one, other = one[true], other[true]
            if len(one) < 10:
                continue
            n = round(len(one) * false / (1 - false))
            free = [np.setdiff1d(np.arange(len(point_of[k])), used) for k, used in ((i, one), (j, other))]
            n = min(n, *map(len, free))
            pairs = np.column_stack([wrong.permutation(f)[:n] for f in free])
            pairs = np.concatenate([np.column_stack([one, other]), pairs])
            matches.append(PairMatches(i, j, pairs[rng.permutation(len(pairs))] if not false else pairs))
    names = tuple(f"p{k:02d}" for k in range(len(features)))
    return Photographs(names, features, matches, scene, camera, point_of)
