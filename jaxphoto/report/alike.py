"""Standard deviations of a camera where neighbouring rays of an image err alike."""

import numpy as np
import pandas as pd

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import get_parameter
from jaxphoto.unknowns import Weighted


def with_alike(interior: pd.DataFrame, adjusted: Adjustment, alike: float) -> pd.DataFrame:
    """The table of interior orientations with the column `sigma_alike`: `sigma` times `alike`.

    Of a parameter that was known beforehand with p, only what the rays say of it is multiplied: with s, the rays alone
    say d, 1 / d^2 = 1 / s^2 - 1 / p^2, and `sigma_alike` is that of p and `alike` d together, parameter by parameter.
    """
    known = []
    for camera, parameter in interior[["camera", "parameter"]].itertuples(index=False):
        prior = get_parameter(adjusted.block.priors.interior[camera], parameter)
        known.append(1 / float(prior.sigma) ** 2 if isinstance(prior, Weighted) else 0.0)
    before = np.array(known)
    sigma = interior["sigma"].to_numpy(float)
    rays = np.maximum(1 / sigma**2 - before, 0.0)
    total = before + rays / max(alike, 1.0) ** 2
    scaled = np.where(total > 0, 1 / np.sqrt(np.where(total > 0, total, 1.0)), sigma)
    return interior.assign(sigma_alike=np.where(np.isfinite(sigma), np.maximum(scaled, sigma), np.nan))
