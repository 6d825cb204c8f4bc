"""Agreement of image coordinates with the format of their camera."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.camera.sensor import Sensor

# Minimum number of image points that are judged, and percentiles of their coordinates: a few may be wrong.
_FEW, _PERCENTILES = 20, (1.0, 99.0)
# Maximum distance of the middle of the image points from that of the format, as a fraction of its sides. Points of all
# images of a camera, taken together, are in the middle of the format to a few per cent.
_OFF_CENTRE = 0.12
# Maximum part of the format beyond its border: distortion and measurements next to the border.
_BEYOND = 0.02
# Resized pictures: maximum relative difference of the factors of both axes; maximum distance of the first points from
# the corner, as a fraction of that of the last.
_ONE_FACTOR, _CORNER = 0.15, 0.15


class Mismatch(NamedTuple):
    """Image points that do not fit the format of their camera."""

    text: str
    resized: bool
    """True if pictures of another size, or turned ones, explain all image points; False for points in one part only."""


def size_mismatch(sensor: Sensor, xy_mm: Float[np.ndarray, "2 n"]) -> Mismatch | None:
    """Detect image points that were measured on pictures of another size, turned or cropped.

    Pixel coordinates of resized pictures start in the upper left corner and end at a fraction, or a multiple, of the
    format of the camera.
    """
    if xy_mm.shape[1] < _FEW:
        return None
    size = np.array([sensor.width_px, sensor.height_px])
    column_row = xy_mm / np.array([[sensor.pixel_mm], [-sensor.pixel_mm]]) + size[:, None] / 2
    low, high = np.percentile(column_row, _PERCENTILES, axis=1)
    span = (
        f"image points span columns {low[0]:.0f} to {high[0]:.0f} and rows {low[1]:.0f} to {high[1]:.0f} of "
        f"{size[0]} x {size[1]} px"
    )
    factors = high / size
    factor = float(factors.mean())
    resized = Mismatch(f"{span}, as on pictures of {factor:.2g} times this size", True)
    same = np.ptp(factors) < _ONE_FACTOR * factor and (low < _CORNER * high).all()
    if (factors > 1 + _BEYOND).any() or (low < -_BEYOND * size).any():
        if (high <= (1 + _BEYOND) * size[::-1]).all() and (low >= -_BEYOND * size[::-1]).all():
            return Mismatch(f"{span}, as on pictures turned by 90 degrees", True)
        return resized if same else Mismatch(f"{span}, beyond the format", True)
    if (np.abs((low + high) / 2 - size / 2) <= _OFF_CENTRE * size).all():
        return None
    return resized if same else Mismatch(f"{span}, one part of the format", False)
