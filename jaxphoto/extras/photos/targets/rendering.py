"""Photographs of a flat board as a known camera would take them: for tests, examples and planning."""

import math

import cv2
import jax
import numpy as np

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.extras.photos.targets.pattern import Pattern
from jaxphoto.orientation.rays import camera_rays

_BACKGROUND = 0.55
_GOLDEN = (5**0.5 - 1) / 2


def rendered(
    pattern: Pattern,
    sensor: Sensor,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    *,
    noise: float = 0.0,
    blur_px: float = 0.6,
    rays: int = 34,
    margin_m: float = 0.03,
    seed: int = 0,
) -> np.ndarray:
    """Grey values (rows, columns) of 0 to 255 of the board, in the plane Z = 0 of its frame.

    Each pixel is the mean over `rays`, each traced through lens and plane; the lens blurs by a Gaussian of `blur_px`;
    `noise` is the standard deviation of a grey value. The board ends `margin_m` beyond its outermost target; beyond is
    grey.
    """
    column, row = np.meshgrid(np.arange(sensor.width_px), np.arange(sensor.height_px))
    corner = np.stack([column.ravel(), row.ravel()], axis=1)
    interior = jax.tree.map(lambda v: np.asarray(v, float), interior)
    position, turn = np.asarray(exterior.position), np.asarray(exterior.camera_from_object)
    low, high = (f(pattern.board.xyz_m[:, :2], axis=0) for f in (np.min, np.max))
    total = np.zeros(len(corner))
    step = next(n for n in range(round(_GOLDEN * rays), 2 * rays) if math.gcd(n, rays) == 1)
    for k in range(rays):
        # A lattice in which no two rays of a pixel share a column or a row: edges along them are as fine as others.
        inside = (np.array([k, k * step % rays]) + 0.5) / rays
        ray = camera_rays(interior, sensor.mm_from_px(corner + inside)) @ turn
        along = -position[2] / np.where(ray[:, 2] == 0, 1e-300, ray[:, 2])
        place = position[:2] + along[:, None] * ray[:, :2]
        on = (along > 0) & np.all((place > low - margin_m) & (place < high + margin_m), axis=1)
        total += _BACKGROUND * ~on
        total[on] += pattern.reflectance(place[on])
    # Neither black nor white is the end of the scale, so that noise is not cut off.
    grey = 30 + 195 * total.reshape(sensor.height_px, sensor.width_px) / rays
    grey = cv2.GaussianBlur(grey, (0, 0), blur_px) + noise * np.random.default_rng(seed).standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
