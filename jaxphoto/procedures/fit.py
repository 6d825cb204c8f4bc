"""Does an adjustment fit the standard deviations it was given: sigma naught, blunders, residuals of control."""

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import Residuals
from jaxphoto.statistics import (
    LEAST_CHECKED,
    Covariance,
    Redundancy,
    chi_square_p,
    critical_value,
    normalised_residuals,
    observation_groups,
    redundancy_numbers,
    residual_spread,
)

LEVEL = 1e-3
"""Error probability of the chi-square test of sigma0, and of the blunder test over all observations together."""
LARGE_SIGMA0 = 1.5
"""A rejected sigma0 is a contradiction only above this: below, the a priori sigmas are merely somewhat hopeful."""
_SHOWN = 4


def fit(adjusted: Adjustment, cov: Covariance) -> tuple[list[str], bool]:
    """sigma0 against the a priori sigmas, blunders and residuals of control in words; and whether all that is sound."""
    sigma0, redundancy = float(adjusted.sigma0), adjusted.redundancy
    p = chi_square_p(float(adjusted.square_sum), redundancy)
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
    redundancies = redundancy_numbers(adjusted, cov)
    blunders, limit, n = _blunders(adjusted, normalised_residuals(adjusted, redundancies), redundancies)
    if blunders:
        shown = ", ".join(f"{name} ({w:.1f})" for w, name in blunders[:_SHOWN])
        count = "1 blunder" if len(blunders) == 1 else f"{len(blunders)} blunders, the largest first"
        sentence = f"{count}: {shown}; normalised residuals above {limit:.1f}"
    else:
        sentence = f"no blunder: none of {n} normalised residuals is above {limit:.1f}"
    control = [s for s in residual_spread(adjusted) if s.group == "control_points"]
    on_control = ["residuals at control, RMSE: " + ", ".join(f"{s.axis} {s.rmse:.3f} m" for s in control)]
    return [found, sentence, *(on_control if control else [])], not (large or blunders)


def _blunders(adjusted: Adjustment, w: Residuals, numbers: Redundancy) -> tuple[list[tuple[float, str]], float, int]:
    """Observations whose |w| no correct observation reaches, largest first; that limit, and how many were tested."""
    size = {name: np.where(numbers[name] > LEAST_CHECKED, np.abs(v), 0.0) for name, v in w.named.items()}
    n = sum(int((v > 0).sum()) for v in size.values())
    limit = critical_value(LEVEL / max(n, 1))
    block = adjusted.block
    found: dict[str, float] = {}
    for name, rows in observation_groups(adjusted).items():
        if not rows.unit:
            # What is known of parameters beforehand is no observation.
            continue
        words = np.broadcast_to(rows.words(block.images, block.points), size[name].shape)
        large = size[name] > limit
        for v, word in zip(size[name][large].tolist(), words[large].tolist(), strict=True):
            # What has one name is one blunder, whichever of its coordinates shows it.
            found[word] = max(v, found.get(word, 0.0))
    return sorted(((v, word) for word, v in found.items()), reverse=True), limit, n
