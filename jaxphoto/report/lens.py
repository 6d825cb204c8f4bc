"""What a block says of its lens beyond what was known of such lenses, in words."""

from collections.abc import Iterator

import numpy as np

from jaxphoto.camera import get_parameter
from jaxphoto.errors import camera_words
from jaxphoto.report.findings import Finding, Level
from jaxphoto.report.tables import Tables
from jaxphoto.unknowns import Weighted

# Of the standard deviation known beforehand: a block that leaves more of it has said little.
_LITTLE = 0.7


def lens_findings(tables: Tables) -> Iterator[Finding]:
    """A warning where c is known to hardly better than what was known before; else by how much the block tells it."""
    adjusted = tables.adjusted
    if not bool(adjusted.converged):
        return
    interior = tables.interior.set_index(["camera", "parameter"])
    for camera, priors in adjusted.block.priors.interior.items():
        prior = get_parameter(priors, "c_mm")
        value, own = (float(interior[column][camera, "c_mm"]) for column in ("value", "sigma"))
        if not isinstance(prior, Weighted) or not np.isfinite(own):
            continue
        known = float(prior.sigma)
        if own > _LITTLE * known:
            yield Finding(
                Level.WARNING,
                f"the block does not tell c of {camera_words(camera)}: its standard deviation of {own:.2g} mm is that "
                f"of what was known before ({known:.2g} mm); another flying height, oblique images or heights known on "
                "the ground would tell it",
            )
        else:
            off = value - float(prior.value)
            yield Finding(
                Level.INFORMATION,
                f"c of {camera_words(camera)} was known to {known:.2g} mm before, and is to {own:.2g} mm with the "
                f"block: {abs(off):.2g} mm {'more' if off > 0 else 'less'} than was thought, {abs(off) / known:.1f} of "
                "the former",
            )
