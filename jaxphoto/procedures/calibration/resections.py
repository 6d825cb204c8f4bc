"""Where each photograph of a board was taken from, before the adjustment."""

import jax.numpy as jnp
import numpy as np

from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.initial import resect, resect_by_quaternions
from jaxphoto.procedures.calibration.board import Board
from jaxphoto.procedures.calibration.calibration_block import TargetRows


def resected(
    board: Board, rows: TargetRows, interior: InteriorOrientation
) -> tuple[ExteriorOrientation, dict[str, str]]:
    """Exterior orientation of the images that have one, in their order; why the others have none, by their names."""
    positions, matrices, why = [], [], {}
    for k, name in enumerate(rows.images):
        own = rows.image == k
        try:
            sigma_mm = float(np.median(rows.sigma_mm[own]))
            exterior = _exterior(interior, rows.xy_mm[own], board.xyz_m[rows.point[own]], sigma_mm, name)
        except BlockError as error:
            why[name] = f"no resection: {error}"
            continue
        positions.append(np.asarray(exterior.position))
        matrices.append(np.asarray(exterior.camera_from_object))
    none = not positions
    return ExteriorOrientation(
        np.zeros((0, 3)) if none else np.stack(positions),  # type: ignore[arg-type]
        np.zeros((0, 3, 3)) if none else np.stack(matrices),  # type: ignore[arg-type]
    ), why


def _exterior(interior: InteriorOrientation, xy_mm, points, sigma_mm: float, image: str) -> ExteriorOrientation:
    """By quaternions (paper 002); from three points with robust weights where these leave it open or do not fit."""
    try:
        found = resect_by_quaternions(interior, xy_mm, points, sigma_mm, image)
    except BlockError:
        return resect(interior, xy_mm, points, image)
    return ExteriorOrientation(jnp.asarray(found.position), jnp.asarray(found.camera_from_object))
