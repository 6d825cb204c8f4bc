"""Rank: unknowns that the observations cannot tell apart, named."""

import numpy as np

from jaxphoto.adjustment.padding import crop_reduced
from jaxphoto.adjustment.result import Adjustment
from jaxphoto.errors import RankError
from jaxphoto.unknowns import FREE, Unknowns

# A pivot of the unit-diagonal reduced matrix below this is a rank defect: at float64 it is rounding, not geometry.
_DEFECT = 1e-13


def check_priors(priors: Unknowns) -> None:
    """Raise RankError where a camera's principal distance and a coefficient that does the same are both free.

    The normal matrix would not show it: residuals are of ideal coordinates, so a smaller scale makes smaller residuals
    and the square sum has no minimum at all.
    """
    for camera, interior in priors.interior.items():
        for name in interior.distortion.scales:
            if interior.c is FREE and getattr(interior.distortion, name) is FREE:
                raise RankError(
                    f"interior[{camera}].c_mm and interior[{camera}].{name} are one scale and cannot both "
                    f"be estimated: hold {name} fixed"
                )


def check_rank(adjusted: Adjustment) -> None:
    """Raise RankError where the normal matrix at the optimum is singular; the message names the unknowns."""
    if adjusted.padded is None or not bool(adjusted.converged):
        return
    s = adjusted.structure
    lower = crop_reduced(adjusted.padded.factored.lower, s)
    a = crop_reduced(adjusted.padded.factored.reduced.a, s)
    diagonal = np.diagonal(a)
    pivots = np.diagonal(lower) ** 2 / np.where(diagonal > 0, diagonal, 1.0)
    if len(pivots) == 0 or pivots.min() > _DEFECT:
        return
    full = np.tril(a) + np.tril(a, -1).T
    d = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    weakest, vectors = np.linalg.eigh(full * d[:, None] * d[None, :])
    null = np.abs(vectors[:, 0])
    names = [f"exterior[{i}].{n}" for i in adjusted.block.images for n in ("X", "Y", "Z", "rx", "ry", "rz")]
    names += list(s.labels)
    worst = [names[k] for k in np.argsort(-null, kind="stable")[:6] if null[k] > 0.05]
    raise RankError(
        f"the observations cannot tell these unknowns apart: {', '.join(worst)}; hold one of them fixed, or give it a "
        f"weight, or add observations that see it (smallest eigenvalue of the scaled normal matrix {weakest[0]:.1e})"
    )
