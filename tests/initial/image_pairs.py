"""Pairs of images with known relative orientation: rays of common points, false matches among them or not."""

from typing import NamedTuple

import numpy as np

from tests.formulas import turns


class PairScene(NamedTuple):
    rays_1: np.ndarray
    rays_2: np.ndarray
    rotation: np.ndarray
    base: np.ndarray
    false: int
    """The first so many pairs are false matches."""


def rays_of(xy):
    rays = np.column_stack([xy, -np.ones(len(xy))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def pair_scene(n, seed, sigma=0.0, false=0.0, flat=False, base=None, length=1.0, turn=0.15):
    """`n` points some 6 in front of camera 1, of which `false` (a part) are matched wrongly."""
    rng = np.random.default_rng(seed)
    rotation = turns(-turn * rng.normal(size=3))[0]
    direction = rng.normal(size=3) if base is None else np.array(base, float)
    direction /= np.linalg.norm(direction)
    points = rng.uniform(-1, 1, (n, 3)) * [3, 3, 2] - [0, 0, 6.0]
    if flat:
        points[:, 2] = -6 + 0.2 * points[:, 0] - 0.1 * points[:, 1]
    in_2 = (points - length * direction) @ rotation.T
    xy_1, xy_2 = (p[:, :2] / -p[:, 2:] + sigma * rng.normal(size=(n, 2)) for p in (points, in_2))
    m = int(false * n)
    xy_2[:m] = rng.uniform(-0.6, 0.6, (m, 2)) + xy_2[m:].mean(axis=0)
    return PairScene(rays_of(xy_1), rays_of(xy_2), rotation, direction, m)


def rotation_error(found, truth):
    """The small rotation (rad) of `small_rotation(theta) @ truth = found`, to second order."""
    m = found @ truth.T
    return 0.5 * np.array([m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]])


def normalised(error, covariance):
    return error @ np.linalg.solve(covariance, error)
