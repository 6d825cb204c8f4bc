"""Rays of image points, and errors over their covariance."""

import numpy as np


def rays_of(xy):
    rays = np.column_stack([xy, -np.ones(len(xy))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def rotation_error(found, truth):
    """The small rotation (rad) of `small_rotation(theta) @ truth = found`, to second order."""
    m = found @ truth.T
    return 0.5 * np.array([m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]])


def normalised(error, covariance):
    return error @ np.linalg.solve(covariance, error)
