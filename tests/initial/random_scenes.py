"""Images and intersections of any geometry, with known truth: wide and narrow, flat, hilly and in space."""

from typing import NamedTuple

import numpy as np

from tests.formulas import random_rotations, turns
from tests.initial.image_pairs import rays_of

SIGMA_MM = 0.005


class ImageScene(NamedTuple):
    kind: str
    c_mm: float
    position: np.ndarray
    matrix: np.ndarray
    points: np.ndarray
    xy: np.ndarray


def image_scene(seed, sigma=SIGMA_MM) -> ImageScene:
    """Four to sixty points 1 km in front of a camera of 24 x 36 mm, vertical, rolled, or in any attitude."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 61)) if rng.uniform() < 0.8 else int(rng.integers(4, 7))
    c = float(rng.choice([15.0, 35.0, 100.0]))
    kind = str(rng.choice(["flat vertical", "flat convergent", "hilly vertical", "hilly convergent", "space"]))
    lean, side = rng.uniform(0.3, 0.6) if "convergent" in kind else 0.05 * rng.normal(), rng.uniform(0, 2 * np.pi)
    normal = np.array([np.sin(lean) * np.cos(side), np.sin(lean) * np.sin(side), np.cos(lean)])
    matrix = turns(np.array([0, 0, rng.uniform(-np.pi, np.pi)]))[0]
    if seed % 3:
        matrix = random_rotations(rng, 1)[0]
    xy = rng.uniform(-1, 1, (n, 2)) * [17, 11]
    rays = np.column_stack([xy / c, -np.ones(n)])
    # A plane that the camera leans over, seen no flatter than the format lets it.
    depth = np.clip(1000 * normal[2] / np.maximum(-rays @ normal, 0.3), 300, 3000)
    if "hilly" in kind:
        depth = depth * (1 + rng.uniform(-0.15, 0.15, n))
    if kind == "space":
        depth = rng.uniform(600, 1400, n)
    position = rng.normal(size=3) * 1e3 + ([5e5, 6e6, 0] if seed % 2 else 0)
    return ImageScene(
        kind, c, position, matrix, position + rays * depth[:, None] @ matrix, xy + sigma * rng.normal(size=(n, 2))
    )


class Intersections(NamedTuple):
    positions: np.ndarray
    matrices: np.ndarray
    image: np.ndarray
    rays: np.ndarray
    point: np.ndarray
    truth: np.ndarray


def intersections(n, seed, sigma, origin=0.0) -> Intersections:
    """Points, each from two to eight images of its own, over bases from a hundredth of the distance to all of it."""
    rng = np.random.default_rng(seed)
    count = rng.integers(2, 9, n)
    point = np.repeat(np.arange(n), count)
    truth = rng.uniform(-30, 30, (n, 3)) * [1, 1, 0.3] - [0, 0, 100]
    base = 10 ** rng.uniform(0, 2, n)
    positions = rng.uniform(-1, 1, (len(point), 3)) * base[point, None] * [1, 1, 0.2]
    # Each looks near its point, rolled by any angle.
    matrices = random_rotations(rng, len(point))
    in_camera = np.einsum("nij,nj->ni", matrices, truth[point] - positions)
    target = np.column_stack([rng.uniform(-0.5, 0.5, (len(point), 2)), -np.ones(len(point))])
    target *= np.linalg.norm(in_camera, axis=1, keepdims=True) / np.linalg.norm(target, axis=1, keepdims=True)
    axis = np.cross(in_camera, target)
    sine, cosine = np.linalg.norm(axis, axis=1), np.sum(in_camera * target, axis=1)
    matrices = turns(axis / sine[:, None] * np.arctan2(sine, cosine)[:, None]) @ matrices
    x, y, z = np.einsum("nij,nj->in", matrices, truth[point] - positions)
    xy = np.column_stack([x, y]) / -z[:, None] + sigma * rng.normal(size=(len(point), 2))
    return Intersections(positions + origin, matrices, np.arange(len(point)), rays_of(xy), point, truth + origin)
