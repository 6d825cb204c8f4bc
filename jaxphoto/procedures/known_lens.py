"""What is known of the lens beforehand as observations of a block's camera, where no earlier calibration says more."""

import dataclasses
import math
from typing import NamedTuple

from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names, set_parameter
from jaxphoto.camera.lens_prior import LensPrior, prior_sigmas
from jaxphoto.observations import KnownParameters
from jaxphoto.unknowns import FIXED, Weighted

# Between the season of one flight and that of the next.
_KELVIN = 10.0


class KnownLens(NamedTuple):
    """A lens as EXIF tells it, and how far such lenses are from that."""

    nominal: InteriorOrientation
    prior: LensPrior
    c_rounding: float
    """Relative standard deviation of the nominal c that is due to how it was noted."""

    def sentences(self, block: Block, camera: str) -> tuple[str, ...]:
        """What a report says of it."""
        sigma, c = prior_sigmas(self.prior, self.nominal, block.sensors[camera], self.c_rounding), float(self.nominal.c)
        p = self.prior
        sensor = block.sensors[camera]
        noted = f", of which {100 * self.c_rounding:.2g} % by how EXIF notes it" if self.c_rounding else ""
        return (
            f"the lens is one of {p.name}: c is observed as {c:.5g} mm with a standard deviation of "
            f"{sigma['c_mm']:.2g} mm ({100 * sigma['c_mm'] / c:.2g} %{noted}), the principal point as in the middle "
            f"with {sigma['xp_mm']:.2g} mm ({sigma['xp_mm'] / sensor.pixel_mm:.2g} px), and distortion as none with "
            f"{p.radial_percent:g} % of the distance of the corner for each radial term, {p.decentring_percent:g} % "
            "for each other one",
            f"source: {' '.join(p.source.split())}" + ("" if p.published else "; an earlier calibration says more"),
            f"c of such lenses changes by about {1e-3 * _KELVIN * p.drift_ppm_per_K * c:.2g} µm with {_KELVIN:g} K, "
            "so much less than this is not known of another day's c",
        )


def known_from_before(block: Block, camera: str) -> bool:
    """Whether an earlier calibration tells anything of a camera of the block."""
    told = (label for rows in block.more if isinstance(rows, KnownParameters) for label in rows.labels)
    return any(label.startswith(f"interior[{camera}].") for label in told)


def with_known_lens(block: Block, camera: str, lens: KnownLens) -> Block:
    """The block in which all that is estimated of the camera is observed as what is known of its lens.

    What is held stays held, and a camera with an earlier calibration as it is.
    """
    if known_from_before(block, camera):
        return block
    sigma = prior_sigmas(lens.prior, lens.nominal, block.sensors[camera], lens.c_rounding)
    priors = block.priors.interior[camera]
    for name in parameter_names(lens.nominal):
        if get_parameter(priors, name) != FIXED and math.isfinite(sigma[name]):
            value = float(get_parameter(lens.nominal, name))
            priors = set_parameter(priors, name, Weighted(value, sigma[name]))
    interior = block.priors.interior | {camera: priors}
    return dataclasses.replace(block, priors=dataclasses.replace(block.priors, interior=interior))
