"""Sensor: format in pixels and millimetres, and conversion of image coordinates."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.short_repr import html_of


class Sensor(eqx.Module):
    """Frame sensor of `width_px` x `height_px` square pixels of `pixel_mm` millimetres."""

    width_px: int
    height_px: int
    pixel_mm: float
    pixel_assumed: bool = eqx.field(static=True, default=False)
    """True if the pixel size is assumed because no file contains it; all values in mm of the camera scale with it."""

    def __check_init__(self) -> None:
        if self.width_px <= 0 or self.height_px <= 0 or not self.pixel_mm > 0:
            raise ValueError(
                f"a sensor needs a positive width, height and pixel size, got {self.width_px} x "
                f"{self.height_px} px of {self.pixel_mm} mm"
            )

    def _repr_html_(self) -> str:
        format_mm = f"{self.width_mm:.6g} x {self.height_mm:.6g} mm"
        pixels = (
            f"{self.width_px} x {self.height_px} of {1e3 * self.pixel_mm:.6g} µm{' (assumed)' * self.pixel_assumed}"
        )
        return html_of("Sensor", {"pixels": pixels, "format": format_mm})

    @property
    def width_mm(self) -> float:
        """Return the format along x (mm)."""
        return self.width_px * self.pixel_mm

    @property
    def height_mm(self) -> float:
        """Return the format along y (mm)."""
        return self.height_px * self.pixel_mm

    def mm_from_px(self, column_row: Float[ArrayLike, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert (column, row) in pixels to millimetres, origin at the image centre, x right, y up.

        The centre of the upper-left pixel is (0.5, 0.5) (docs/conventions.md).
        """
        centre = np.array([self.width_px, self.height_px]) / 2
        return (np.asarray(column_row) - centre) * np.array([self.pixel_mm, -self.pixel_mm])

    def px_from_mm(self, xy_mm: Float[ArrayLike, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert millimetres to (column, row) in pixels: the inverse of `mm_from_px`."""
        centre = np.array([self.width_px, self.height_px]) / 2
        return np.asarray(xy_mm) / np.array([self.pixel_mm, -self.pixel_mm]) + centre


def sensor_keys(sensor: Sensor) -> dict[str, Any]:
    """Return the keys and values that describe a sensor in files; `pixel_assumed` only if true."""
    size = {"width_px": sensor.width_px, "height_px": sensor.height_px, "pixel_mm": sensor.pixel_mm}
    return size | ({"pixel_assumed": True} if sensor.pixel_assumed else {})
