"""Camera models of other programs expressed by our distortions and projections; cameras in pixels.

Computer vision uses camera axes x right, y down, z forward; we use x right, y up, z backward. Pixel coordinates follow
docs/conventions.md: the centre of the upper left pixel is (0.5, 0.5).
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxphoto.arrays import as_jax_array
from jaxphoto.camera import (
    AbstractDistortion,
    AbstractProjection,
    Agisoft,
    Equidistant,
    InteriorOrientation,
    OpenCv,
    OpenCvFisheye,
    Perspective,
    Sensor,
    get_parameter,
    parameter_names,
)
from jaxphoto.io.camera_files import CameraSource


class CameraModel(NamedTuple):
    """Distortion and projection; the distortion coefficients `lacks` are zero."""

    distortion: type[AbstractDistortion]
    lacks: tuple[str, ...]
    projection: AbstractProjection

    def only(self, *terms: str) -> "CameraModel":
        """Return the model restricted to the coefficients `terms`."""
        return self._replace(lacks=tuple(name for name in self.distortion.coefficients if name not in terms))


OPENCV = CameraModel(OpenCv, ("b2",), Perspective())
"""OpenCV's rational model with fx and fy."""
OPENCV_FISHEYE = CameraModel(OpenCvFisheye, ("p1", "p2", "s1", "s2", "b2"), Equidistant())
"""OpenCV's fisheye model with fx and fy."""
BROWN = CameraModel(OpenCv, ("k4", "k5", "k6", "b2"), Perspective())
"""OpenCV's model with k1 to k3, p1, p2, fx and fy."""
AGISOFT = CameraModel(Agisoft, ("p3", "p4"), Perspective())
AGISOFT_FISHEYE = CameraModel(Agisoft, ("p3", "p4"), Equidistant())
BROWN_TERMS, FISHEYE_TERMS = ("k1", "k2", "k3", "p1", "p2"), ("k1", "k2", "k3", "k4")
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""OpenCV's coefficients in the order of its files."""


class ProjectCamera(NamedTuple):
    """Camera of a project, and the names of its free parameters."""

    sensor: Sensor
    interior: InteriorOrientation
    free: tuple[str, ...] = ()

    @staticmethod
    def estimated(sensor: Sensor, interior: InteriorOrientation) -> "ProjectCamera":
        """Return a camera with free c, xp, yp and all nonzero coefficients."""
        first = ("c_mm", "xp_mm", "yp_mm")
        names = (n for n in parameter_names(interior) if n in first or float(get_parameter(interior, n)) != 0)
        return ProjectCamera(sensor, interior, tuple(names))

    def terms(self, names: tuple[str, ...]) -> dict[str, float]:
        """Return distortion coefficients by name."""
        return {name: float(getattr(self.interior.distortion, name)) for name in names}


def in_pixels(
    source: CameraSource, sensor: Sensor, fx: float, fy: float, centre: tuple[float, float], model: CameraModel, **terms
) -> InteriorOrientation:
    """Convert focal lengths and principal point in pixels to an interior orientation: c is fy, b1 is fx / fy - 1."""
    if not (fx > 0 and fy > 0):
        raise source.error(f"focal lengths {fx:g} and {fy:g} px are not positive; give positive values")
    if fx != fy:
        terms["b1"] = fx / fy - 1
    x_p, y_p = sensor.mm_from_px(np.array([centre], float))[0]
    distortion = model.distortion(**terms)
    interior = InteriorOrientation(fy * sensor.pixel_mm, x_p, y_p, distortion, projection=model.projection)
    return jax.tree.map(as_jax_array, interior)


def pixels_of(interior: InteriorOrientation, sensor: Sensor) -> tuple[float, float, float, float]:
    """Return fx, fy and the principal point (column, row) in pixels: the inverse of `in_pixels`."""
    fy = float(interior.c / sensor.pixel_mm)
    column, row = sensor.px_from_mm(np.array([[float(interior.x_p), float(interior.y_p)]]))[0]
    return fy * (1 + float(getattr(interior.distortion, "b1", 0.0))), fy, float(column), float(row)
