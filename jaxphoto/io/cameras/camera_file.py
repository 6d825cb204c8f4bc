"""What a camera file says: one camera, its sensor and interior orientation, and how sure it is of them."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import on_device
from jaxphoto.camera import AbstractDistortion, AbstractProjection, InteriorOrientation, Sensor
from jaxphoto.errors import InputError, quoted
from jaxphoto.io.names import harm_in
from jaxphoto.io.text_tables import LARGEST
from jaxphoto.io.whole_text import SMALL, read_whole

ASSUMED_PIXEL_MM = 0.001
"""The pixel where neither file nor user gives one: c in micrometres then is the focal length in pixels."""


# Pixels along a side: a mosaic of the largest scanners.
_WIDEST = 1e7


class SeveralCamerasError(InputError):
    """A file holds several cameras, and nobody said which is meant."""


class CameraFile(NamedTuple):
    """A camera as a file gives it.

    `covariance` is that of `parameter_names(interior)` (a posteriori, with zero rows for what was held), None where the
    file has none. `note` says what was assumed, and what else the file tells; empty where there is nothing to say.
    """

    name: str
    sensor: Sensor
    interior: InteriorOrientation
    covariance: Float[np.ndarray, "n n"] | None = None
    note: str = ""


class CameraSource(NamedTuple):
    """A file to read, and what the user adds to it."""

    path: Path
    camera: str | None = None
    """Which camera, where the file holds several."""
    pixel_mm: float | None = None
    size_px: tuple[int, int] | None = None
    """Width and height, where the file does not give them."""
    block: Path | None = None
    """The block folder or block.toml that says of which model the parameters of interior.csv are."""

    def error(self, message: str) -> InputError:
        """An error about this file."""
        return InputError(f"{self.path}: {message}")

    def text(self) -> str:
        """The whole file. Raises InputError where it is not text, and what `read_whole` raises."""
        content = read_whole(self.path, SMALL)
        try:
            return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
        except UnicodeDecodeError:
            raise self.error("the file is no text; give a camera file") from None

    def number(self, name: str, text: Any) -> float:
        """A finite number of the file."""
        try:
            value = float(text)
        except (TypeError, ValueError, OverflowError):
            value = np.nan
        if not abs(value) <= LARGEST:
            raise self.error(f"{name} is {quoted(text)}, not a finite number; write it like 12.34")
        return value

    def chosen(self, names: list[str]) -> str:
        """The one camera among `names` that is meant."""
        known = ", ".join(names)
        if not names:
            raise self.error("there is no camera in it; give a file with one")
        for name in names:
            if harm := harm_in(name):
                raise self.error(f"the camera {quoted(name)} {harm}")
        if self.camera is None:
            if len(names) > 1:
                raise SeveralCamerasError(f"{self.path}: it holds {len(names)} cameras; name one of {known}")
            return names[0]
        if self.camera not in names:
            raise self.error(f"there is no camera {quoted(self.camera)} in it; name one of {known}")
        return self.camera

    def sensor(self, width: float, height: float, pixel_mm: float | None = None) -> tuple[Sensor, str]:
        """The sensor in the file's own format, and what was assumed of it; the user's pixel goes before `pixel_mm`."""
        if self.size_px is not None and self.size_px != (width, height):
            given = "{} x {}".format(*self.size_px)
            raise self.error(f"its images have {width:g} x {height:g} pixels, not {given}; leave the size out")
        if not (0 < width <= _WIDEST and 0 < height <= _WIDEST and width == int(width) and height == int(height)):
            raise self.error(
                f"an image of {width:g} x {height:g} pixels cannot be; give whole positive numbers up to {_WIDEST:g}"
            )
        pixel = self.pixel_mm if self.pixel_mm is not None else pixel_mm
        if pixel is not None and not 0 < pixel < np.inf:
            raise self.error(f"a pixel of {pixel:g} mm cannot be; give its size in millimetres")
        assumed = f"the size of a pixel is not known; {ASSUMED_PIXEL_MM} mm was assumed, and c_mm scales with it"
        if pixel is None:
            return Sensor(int(width), int(height), ASSUMED_PIXEL_MM, pixel_assumed=True), assumed
        return Sensor(int(width), int(height), float(pixel)), ""


class CameraModel(NamedTuple):
    """What the cameras of a format are here: a distortion, those of its coefficients that the format lacks, and a
    projection."""

    distortion: type[AbstractDistortion]
    lacks: tuple[str, ...]
    projection: AbstractProjection

    def only(self, *terms: str) -> "CameraModel":
        """The part of it that has the coefficients `terms` alone."""
        return self._replace(lacks=tuple(name for name in self.distortion.coefficients if name not in terms))


def in_pixels(
    source: CameraSource,
    sensor: Sensor,
    fx: float,
    fy: float,
    centre: tuple[float, float],
    model: CameraModel,
    **coefficients,
) -> InteriorOrientation:
    """A camera of computer vision: focal lengths and principal point in pixels (of conventions.md) -> millimetres.

    c is fy, fx / fy - 1 is the affinity `b1` where they differ. Raises InputError for focal lengths that cannot be.
    """
    if not (fx > 0 and fy > 0):
        raise source.error(f"focal lengths of {fx:g} and {fy:g} pixels cannot be; give positive ones")
    if fx != fy:
        coefficients["b1"] = fx / fy - 1
    x_p, y_p = sensor.mm_from_px(np.array([centre]))[0]
    distortion = model.distortion(**coefficients)
    interior = InteriorOrientation(fy * sensor.pixel_mm, x_p, y_p, distortion, projection=model.projection)
    return jax.tree.map(on_device, interior)


def from_centre_px(interior: InteriorOrientation, sensor: Sensor) -> tuple[float, float, float, float]:
    """fx, fy and the principal point in pixels of conventions.md: the inverse of `in_pixels`."""
    fy = float(interior.c / sensor.pixel_mm)
    column, row = sensor.px_from_mm(np.array([[float(interior.x_p), float(interior.y_p)]]))[0]
    return fy * (1 + float(getattr(interior.distortion, "b1", 0.0))), fy, float(column), float(row)


def joined_notes(*notes: str) -> str:
    """Several notes as one."""
    return "; ".join(note for note in notes if note)
