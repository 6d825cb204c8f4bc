"""Photographs of a ground whose brightness is known everywhere, by the textbook's formulas."""

import numpy as np

from tests.formulas import camera_from_object


def rendered(sensor, interior, position, angles, height, texture):
    """The pixels (bands, rows, columns) of a camera with Brown's radial distortion over Z = `height` (X, Y).

    Every pixel's ray is followed to the ground, and the ground's brightness there is `texture` (X, Y).
    """
    column, row = np.meshgrid(np.arange(sensor.width_px) + 0.5, np.arange(sensor.height_px) + 0.5)
    x = (column - sensor.width_px / 2) * sensor.pixel_mm - interior.xp
    y = (sensor.height_px / 2 - row) * sensor.pixel_mm - interior.yp
    square = x * x + y * y
    x, y = (v - v * (interior.distortion.k1 * square + interior.distortion.k2 * square**2) for v in (x, y))
    rays = np.stack([x, y, np.full(x.shape, -interior.c)], axis=-1) @ camera_from_object(*angles)
    meet = np.zeros(rays.shape)
    for _ in range(30):
        meet = position + rays * ((height(meet[..., 0], meet[..., 1]) - position[2]) / rays[..., 2])[..., None]
    return texture(meet[..., 0], meet[..., 1])
