"""How sure an RMSE_offset is, and what it would be of one and the same camera calibrated twice.

The offsets are v = v0 + J e with the errors e of both parameter sets, e ~ N(0, Q), and J exact
(`BundleOffsets.jacobian`). RMSE_offset is a norm: where bundles are nearly equal it is not normal, and its first
derivative says nothing. So v'v is taken as what it is, a quadratic form in normal variables (`QuadraticForm`): about
the offsets found (v0 = v) for the uncertainty, about none (v0 = 0) for the hypothesis that both are of one camera.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import Numbers
from jaxphoto.short_repr import shown
from jaxphoto.stability.comparison import BundleOffsets
from jaxphoto.stability.quadratic_form import QuadraticForm

LEVEL = 0.95


@shown
class OffsetUncertainty(NamedTuple):
    """Distribution of RMSE_offset by the covariances of both sets; everything in mm but the probability."""

    sigma_mm: float
    """Standard deviation of RMSE_offset over repeated calibrations of these two cameras."""
    low_mm: float
    """2.5 % of these calibrations give less,"""
    high_mm: float
    """and 2.5 % more."""
    expected_of_one_mm: float
    """Mean RMSE_offset of two such calibrations of one camera,"""
    limit_of_one_mm: float
    """which 5 % of them exceed."""
    p_value: float
    """Probability that two calibrations of one camera differ as much as these or more."""
    unexplained_mm: float
    """RMSE_offset less what the covariances explain: sqrt((v'v - E) / (2n - u)), E = tr(J Q J'); 0 where E is more."""


def offset_uncertainty(
    offsets: BundleOffsets,
    first: Float[Numbers, "p p"] | None = None,
    second: Float[Numbers, "p p"] | None = None,
) -> OffsetUncertainty | None:
    """What the covariances of the two parameter sets say about their RMSE_offset; None where both are None.

    `first` and `second` are a posteriori covariances in the order of `jaxphoto.camera.parameter_names`, with zero rows
    for what was fixed; a set without one is taken as exact. The sets are independent: from different images. Raises
    ValueError for a covariance of another size than its parameters.
    """
    if first is None and second is None:
        return None
    jacobian = np.asarray(offsets.jacobian)
    # One of them may be missing: its size is then what the other leaves.
    p1 = len(first) if first is not None else jacobian.shape[1] - len(second)  # type: ignore[arg-type]
    p2 = jacobian.shape[1] - p1
    if (second is not None and len(second) != p2) or p1 < 0:
        given = " and ".join(str(len(q)) for q in (first, second) if q is not None)
        raise ValueError(f"covariances of {given} parameters, but the two sets have {jacobian.shape[1]} together")
    covariance = np.zeros((p1 + p2, p1 + p2))
    covariance[:p1, :p1] = 0.0 if first is None else first
    covariance[p1:, p1:] = 0.0 if second is None else second
    v, f = np.asarray(offsets.offsets).ravel(), offsets.redundancy
    about = QuadraticForm.of_normal(v, jacobian, covariance)
    of_one = QuadraticForm.of_normal(np.zeros_like(v), jacobian, covariance)

    def root(square_sum: float) -> float:
        return float(np.sqrt(square_sum / f))

    tail = (1 - LEVEL) / 2
    square_sum = float(v @ v)
    return OffsetUncertainty(
        sigma_mm=about.sigma_of_root / f**0.5,
        low_mm=root(about.quantile(tail)),
        high_mm=root(about.quantile(1 - tail)),
        expected_of_one_mm=of_one.mean_of_root / f**0.5,
        limit_of_one_mm=root(of_one.quantile(LEVEL)),
        p_value=of_one.exceeded(square_sum),
        unexplained_mm=root(max(square_sum - of_one.mean, 0.0)),
    )
