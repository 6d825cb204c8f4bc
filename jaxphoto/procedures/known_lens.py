"""Prior information about a lens, for a camera without earlier calibration."""

import dataclasses
import math
from typing import NamedTuple

from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names, set_parameter
from jaxphoto.camera.lens_prior import LensPrior, prior_sigmas
from jaxphoto.observations import KnownParameters
from jaxphoto.unknowns import FIXED, Weighted

# Temperature difference (K) between flights of different seasons.
_KELVIN = 10.0


class KnownLens(NamedTuple):
    """Nominal lens from EXIF, and typical deviations of real lenses from it."""

    nominal: InteriorOrientation
    prior: LensPrior
    c_rounding: float
    """Relative standard deviation of the nominal c due to rounding in EXIF."""

    def sentences(self, block: Block, camera: str) -> tuple[str, ...]:
        """Return messages for a report."""
        sigma, c = prior_sigmas(self.prior, self.nominal, block.sensors[camera], self.c_rounding), float(self.nominal.c)
        p = self.prior
        sensor = block.sensors[camera]
        rounding = f", of which {100 * self.c_rounding:.2g} % rounding in EXIF" if self.c_rounding else ""
        return (
            f"lens of class {p.name}: c observed as {c:.5g} mm, sigma {sigma['c_mm']:.2g} mm "
            f"({100 * sigma['c_mm'] / c:.2g} %{rounding}); principal point in the centre, sigma {sigma['xp_mm']:.2g} "
            f"mm ({sigma['xp_mm'] / sensor.pixel_mm:.2g} px); distortion zero, sigma {p.radial_percent:g} % of the "
            f"corner's distance for each radial term, {p.decentring_percent:g} % for each other term",
            f"source: {' '.join(p.source.split())}" + ("" if p.published else "; use an earlier calibration if any"),
            f"c of such lenses changes by about {1e-3 * _KELVIN * p.drift_ppm_per_K * c:.2g} µm with {_KELVIN:g} K: "
            "smaller differences from another day's c are not significant",
        )


def has_prior(block: Block, camera: str) -> bool:
    """Return True if the camera has prior information from an earlier calibration."""
    labels = (label for rows in block.more if isinstance(rows, KnownParameters) for label in rows.labels)
    return any(label.startswith(f"interior[{camera}].") for label in labels)


def with_known_lens(block: Block, camera: str, lens: KnownLens) -> Block:
    """Weight all free parameters of the camera by the prior information about its lens.

    Fixed parameters, and cameras with an earlier calibration, are unchanged.
    """
    if has_prior(block, camera):
        return block
    sigma = prior_sigmas(lens.prior, lens.nominal, block.sensors[camera], lens.c_rounding)
    priors = block.priors.interior[camera]
    for name in parameter_names(lens.nominal):
        if get_parameter(priors, name) != FIXED and math.isfinite(sigma[name]):
            value = float(get_parameter(lens.nominal, name))
            priors = set_parameter(priors, name, Weighted(value, sigma[name]))
    interior = block.priors.interior | {camera: priors}
    return dataclasses.replace(block, priors=dataclasses.replace(block.priors, interior=interior))
