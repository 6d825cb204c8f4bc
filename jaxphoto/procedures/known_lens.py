"""Prior information about a lens, for a camera without earlier calibration."""

import dataclasses
import math
from collections.abc import Collection
from typing import NamedTuple

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names, set_parameter
from jaxphoto.camera.lens_prior import LensPrior, prior_sigmas
from jaxphoto.observations import KnownParameters
from jaxphoto.statistics import CorrelatedNoise, critical_w
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


def with_known_lens(block: Block, camera: str, lens: KnownLens, without: Collection[str] = ()) -> Block:
    """Weight all free parameters of the camera, except `without`, by the prior information about its lens.

    Fixed parameters, and cameras with an earlier calibration, are unchanged.
    """
    if has_prior(block, camera):
        return block
    sigma = prior_sigmas(lens.prior, lens.nominal, block.sensors[camera], lens.c_rounding)
    priors = block.priors.interior[camera]
    for name in parameter_names(lens.nominal):
        if name not in without and get_parameter(priors, name) != FIXED and math.isfinite(sigma[name]):
            value = float(get_parameter(lens.nominal, name))
            priors = set_parameter(priors, name, Weighted(value, sigma[name]))
    interior = block.priors.interior | {camera: priors}
    return dataclasses.replace(block, priors=dataclasses.replace(block.priors, interior=interior))


class RejectedPrior(NamedTuple):
    """Prior value of a parameter that contradicts all other observations."""

    parameter: str
    prior: Weighted
    value: float
    """Estimate without this prior."""
    sigma: float

    @property
    def words(self) -> str:
        """Describe prior and estimate."""
        given = f"{float(self.prior.value):.5g} +- {float(self.prior.sigma):.2g}"
        return f"{self.parameter} {self.value:.5g} +- {self.sigma:.2g} without it, {given} by it"


def contradicted_prior(adjusted: Adjustment, noise: CorrelatedNoise, camera: str) -> RejectedPrior | None:
    """Return the prior of the camera that most contradicts the other observations, if significantly.

    With estimate x, variances q (independent errors) and s^2 (`noise`), and a prior p of variance p2, the estimate
    without this prior is

        x + (x - p) q / (p2 - q),    with variance (s^2 - q^2 / p2) (p2 / (p2 - q))^2.

    Its difference from p, over the standard deviation of the difference, is tested at the level of blunders.
    """
    found: list[tuple[float, RejectedPrior]] = []
    interior, priors = adjusted.unknowns.interior[camera], adjusted.block.priors.interior[camera]
    for name in parameter_names(priors):
        prior, label = get_parameter(priors, name), f"interior[{camera}].{name}"
        if not isinstance(prior, Weighted) or label not in noise.labels:
            continue
        k, known = noise.labels.index(label), float(prior.sigma) ** 2
        q, s2 = noise.independent[k, k], noise.covariance[k, k]
        x, p = float(get_parameter(interior, name)), float(prior.value)
        if q < known:
            sigma = math.sqrt(max(s2 - q**2 / known, 0.0)) * known / (known - q)
            value = x + (x - p) * q / (known - q)
            found.append((abs(value - p) / math.hypot(sigma, prior.sigma), RejectedPrior(name, prior, value, sigma)))
    largest = max(found, key=lambda one: one[0], default=None)
    return largest[1] if largest and largest[0] > critical_w(len(found), adjusted.redundancy) else None
