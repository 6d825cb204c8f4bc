"""Determinability of shared unknowns: the criteria of the verdict on an adjustment and of a sweep over designs."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment.weak_directions import POOR, Yardsticks
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation

FELT = 10.0
"""Maximum shift of the image corner by one sigma of an interior parameter, in standard deviations of an image point.

Half of `adjustment.POOR`: the limit of a moderate dilution of precision in GNSS. Well-determined blocks over flat
ground remain below 8, undetermined ones exceed 15 (benchmarks/defects.py).
"""
WEAK_CORRELATION = 0.9
"""Correlation of an interior parameter with an exterior orientation above which `FELT` applies."""


def corner_yardsticks(
    block: Block, interior: Mapping[str, InteriorOrientation], labels: Sequence[str], yards: Yardsticks
) -> Float[np.ndarray, "shared"]:
    """Return the changes of the shared unknowns that move the corner of the image by the sigma of an image point.

    c acts along the radius, the principal point directly; all other unknowns have their yardsticks
    (`adjustment.yardsticks`).
    """
    rows, units = block.image_points, np.array(yards.shared)
    for camera, own in interior.items():
        sensor = block.sensors[camera]
        of_camera = np.isin(rows.image, np.flatnonzero(np.array(block.image_camera) == camera))
        measured = float(np.median(np.asarray(rows.sigma)[of_camera])) if of_camera.any() else 1.0
        tangent = np.hypot(sensor.width_mm, sensor.height_mm) / 2 / float(own.c)
        for name, unit in (("c_mm", measured / tangent), ("xp_mm", measured), ("yp_mm", measured)):
            if (label := f"interior[{camera}].{name}") in labels:
                units[labels.index(label)] = unit
    return units


def weakly_determined(
    labels: Sequence[str],
    sigma: Float[np.ndarray, "shared"],
    yards: Yardsticks,
    corner: Float[np.ndarray, "shared"],
    rho: Float[np.ndarray, "shared"],
) -> tuple[str, ...]:
    """Return the labels of weakly determined shared unknowns.

    Criteria: a standard deviation above `POOR` yardsticks; for interior parameters also one above `FELT` of
    `corner_yardsticks` with a correlation `rho` above `WEAK_CORRELATION` with the exterior orientation of an image.
    """
    interior = np.array([label.startswith("interior[") for label in labels], bool)
    weak = (sigma > POOR * yards.shared) | (interior & (sigma > FELT * corner) & (np.abs(rho) > WEAK_CORRELATION))
    return tuple(label for label, own in zip(labels, weak, strict=True) if own)
