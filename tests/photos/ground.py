"""Photographs of flat textured ground from known places: every correspondence is known."""

import cv2
import numpy as np

from jaxphoto.extras.photos.rendered_photographs import GROUND_M, SENSOR
from jaxphoto.rotation import matrix_from_omega_phi_kappa

C_MM = 3.6


def plane_to_pixel(position, angles_deg):
    """The matrix from (X, Y, 1) in m on the ground Z = 0 to pixels (column, row, 1), by collinearity.

    As OpenCV counts pixels: the centre of the upper left one is (0, 0).
    """
    rotation = np.asarray(matrix_from_omega_phi_kappa(np.deg2rad(angles_deg)))
    in_camera = rotation @ np.column_stack([[1, 0, 0], [0, 1, 0], -np.asarray(position, float)])
    c_px = C_MM / SENSOR.pixel_mm
    # x = -c U / W, y = -c V / W; columns run right, rows down.
    pixel = [[-c_px, 0, SENSOR.width_px / 2 - 0.5], [0, c_px, SENSOR.height_px / 2 - 0.5], [0, 0, 1]]
    return np.array(pixel) @ in_camera


def photograph(path, ground, position, angles_deg, rng, noise=2.0):
    """Write the picture and return its matrix `plane_to_pixel`."""
    size = len(ground)
    plane_from_ground = np.array([[GROUND_M, 0, -GROUND_M * size / 2], [0, -GROUND_M, GROUND_M * size / 2], [0, 0, 1]])
    matrix = plane_to_pixel(position, angles_deg)
    view = cv2.warpPerspective(
        ground, matrix @ plane_from_ground, (SENSOR.width_px, SENSOR.height_px), flags=cv2.INTER_CUBIC
    )
    view = view + noise * rng.normal(size=view.shape)
    cv2.imwrite(str(path), np.clip(np.round(view), 0, 255).astype(np.uint8))
    return matrix


def mapped(matrix, xy):
    """Points (n, 2) under a projective map."""
    u, v, w = matrix @ np.column_stack([xy, np.ones(len(xy))]).T
    return np.column_stack([u / w, v / w])
