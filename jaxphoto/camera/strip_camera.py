"""Strip-variant principal distance and principal point.

The interior orientation of the camera is common to all strips; each strip adds corrections to c, x_p and y_p. If all
are free, only differences between strips are determined. Either observe the corrections as zero, which makes the camera
the mean of its strips, or constrain them from strip to strip (`observations.StripCameraSteps`). Source: Moniwa (1981),
The concept of photo-variant self-calibration and its application in block adjustment with bundles, Photogrammetria 36.
"""

import dataclasses
from typing import Any

from jaxtyping import Array, Float

from jaxphoto.parameters import AbstractParameters

Scalar = Float[Array, "*images"] | float


class StripCamera(AbstractParameters):
    """Corrections of one strip to c, x_p and y_p (mm) of the camera of the block."""

    kind = "strip_cameras"
    owner = "strip"
    names = {"c_more": ("c_more_mm",), "xp_more": ("xp_more_mm",), "yp_more": ("yp_more_mm",)}  # noqa: RUF012
    modifies_interior = ("c", "xp", "yp")

    c_more: Scalar
    xp_more: Scalar
    yp_more: Scalar

    def interior(self, interior: Any, exposure: Any) -> Any:
        """Return the interior orientation of the strip."""
        return dataclasses.replace(
            interior,
            c=interior.c + self.c_more,
            xp=interior.xp + self.xp_more,
            yp=interior.yp + self.yp_more,
        )
