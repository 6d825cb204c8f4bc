"""The stability analysis of two interior orientations: every method, its uncertainty, and a verdict against noise."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import Numbers
from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.short_repr import shown
from jaxphoto.stability.alignment import METHODS, Method
from jaxphoto.stability.comparison import BundleOffsets, bundle_offsets, check_rays
from jaxphoto.stability.uncertainty import OffsetUncertainty, offset_uncertainty

# A p-value below this speaks against one camera.
SIGNIFICANT_P = 0.05
# What is smaller than any number is told as this.
_LEAST_P = 1e-300


@shown
class Analysis(NamedTuple):
    """Two sets compared by one method; `uncertainty` is None where neither set has a covariance."""

    method: Method
    offsets: BundleOffsets
    uncertainty: OffsetUncertainty | None

    def similar(self, noise_mm: float) -> bool:
        """Whether RMSE_offset is within the noise of image coordinates (paper 002: about one pixel)."""
        return bool(self.offsets.rmse_mm <= noise_mm)

    def verdict(self, noise_mm: float) -> str:
        """What is to be said of the two sets, in one sentence or two."""
        rmse, known = float(self.offsets.rmse_mm), self.uncertainty
        alike, side = ("similar", "within") if self.similar(noise_mm) else ("not similar", "beyond")
        text = f"{alike}: RMSE_offset of {1e3 * rmse:.3g} um is {side} the noise of {1e3 * noise_mm:.3g} um"
        if known is None:
            return text + "; without covariances nobody knows how sure that is."
        if known.low_mm <= noise_mm <= known.high_mm:
            text += f", but calibrations repeated would give {1e3 * known.low_mm:.3g} to {1e3 * known.high_mm:.3g} um"
        one = f"Two calibrations of one camera would differ by {1e3 * known.expected_of_one_mm:.3g} um"
        meaning = change_meaning(known.p_value)
        return f"{text}. {one}, and by as much as this with p = {max(known.p_value, _LEAST_P):.2g}: {meaning}."


def change_meaning(p_value: float) -> str:
    """What is to be concluded where two sets of one camera differ so much with the probability `p_value`."""
    changed = "the camera has changed, or many image points of a calibration share errors (jaxphoto halves tells)"
    return changed if p_value < SIGNIFICANT_P else "nothing says that it has changed"


def analyse(
    first: InteriorOrientation,
    second: InteriorOrientation,
    points: Float[Numbers, "points 2"],
    covariances: tuple[Float[Numbers, "p p"] | None, Float[Numbers, "q q"] | None] = (None, None),
    relief: float = 0.0,
) -> dict[Method, Analysis]:
    """Both sets compared by zrot, rot and spr over image points (mm from the centre; see `image_grid`).

    `covariances` are a posteriori, in the order of `parameter_names` of either set. The object points of spr lie at a
    distance alternately greater and smaller by the part `relief` of it. Raises InputError where a distortion means
    nothing at some of the points or bundles are too far apart to be aligned, ValueError for a `relief` of 1 or more.
    """
    if not 0 <= relief < 1:
        raise ValueError(f"relief is a part of the object's distance, from 0 to less than 1, got {relief:g}")
    for name, interior in (("the first camera", first), ("the second camera", second)):
        check_rays(interior, points, name)
    depth = 1 + relief * (-1.0) ** np.arange(len(points))
    found = {}
    for method in METHODS:
        offsets = bundle_offsets(first, second, points, method, depth)
        if not bool(offsets.converged):
            raise InputError(f"the two bundles cannot be aligned by {method}: they are not of one camera")
        found[method] = Analysis(method, offsets, offset_uncertainty(offsets, *covariances))
    return found
