"""Agreement of an adjustment with its a priori standard deviations: sigma0, blunders, residuals of control."""

from jaxphoto.adjustment import Adjustment
from jaxphoto.statistics import (
    LEVEL,
    Covariance,
    blunder_test,
    chi_square_p,
    redundancy_numbers,
    residual_spread,
)

LARGE_SIGMA0 = 1.5
"""A rejected sigma0 is a contradiction only above this: below, a priori sigmas are merely optimistic."""
_SHOWN = 4


def fit(adjusted: Adjustment, cov: Covariance) -> tuple[list[str], bool]:
    """Return messages about sigma0, blunders and residuals of control; and True if all is consistent."""
    sigma0, redundancy = float(adjusted.sigma0), adjusted.redundancy
    p = chi_square_p(float(adjusted.sum_of_squares), redundancy)
    found = f"sigma0 {sigma0:.3f} with redundancy {redundancy}"
    test = f"(chi-square test, p = {p:.2g})"
    large = p < LEVEL and sigma0 > LARGE_SIGMA0
    if large:
        found += f" contradicts the a priori standard deviations {test}: observations are worse than announced"
    elif p < LEVEL:
        found += f" is above what the a priori standard deviations announce {test}: enlarge them by that factor"
    elif p > 1 - LEVEL:
        found += f" is below what the a priori standard deviations announce {test}: they are too large"
    else:
        found += f" agrees with the a priori standard deviations {test}"
    tested = blunder_test(adjusted, redundancy_numbers(adjusted, cov))
    blunders = tested.suspects
    if blunders:
        shown = ", ".join(f"{b.words} ({abs(b.w):.1f})" for b in blunders[:_SHOWN])
        count = "1 blunder" if len(blunders) == 1 else f"{len(blunders)} blunders, the largest first"
        sentence = f"{count}: {shown}; normalised residuals above {tested.limit:.1f}"
    else:
        sentence = f"no blunder: none of {tested.n} normalised residuals is above {tested.limit:.1f}"
    control = [s for s in residual_spread(adjusted) if s.group == "control_points"]
    on_control = ["residuals at control, RMSE: " + ", ".join(f"{s.axis} {s.rmse:.3f} m" for s in control)]
    return [found, sentence, *(on_control if control else [])], not (large or blunders)
