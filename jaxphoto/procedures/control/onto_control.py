"""The similarity that brings a block onto control points: of those that agree with one another.

Every three points (or 300 samples of three) give a similarity; that counts which most others fit, then least squares of
these. How well points have to fit leaves room for what an adjustment will take out: a block that is bent by a lens or
stands on weak positions misses by a part of its size. What does not fit is not judged here: it is left out of the first
adjustment, which judges it.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.errors import InputError
from jaxphoto.procedures.orientation.onto_known import Similarity, similarity_between

_SAMPLES = 300
# Standard deviations, and part of the size of the control, within which a point fits.
_BEYOND, _BENT = 5.0, 0.01
LEAST = 3


class OntoControl(NamedTuple):
    """A similarity and which points made it."""

    similarity: Similarity
    agree: Bool[np.ndarray, "points"]


def onto_control(
    there: Float[np.ndarray, "points 3"],
    here: Float[np.ndarray, "points 3"],
    sigma_m: Float[np.ndarray, "points"],
    file: str,
) -> OntoControl:
    """From places `there` in a frame of a block to the same as surveyed, `here`; `sigma_m` of the differences.

    Raises InputError for fewer than three, for such as lie on a line, and where no three and a fourth agree; it says
    where exchanged coordinates would.
    """
    if len(here) < LEAST:
        raise InputError(
            f"{file}: {len(here)} control points are marked in two photographs or more; three tell place, scale and "
            "attitude of a block"
        )
    best = _best(there, here, sigma_m)
    if best is None:
        raise InputError(
            f"{file}: the control points lie on a line, which leaves a turn about it open; mark one beside it"
        )
    if len(here) > LEAST and best.agree.sum() > LEAST:
        return best
    if best.agree.all() and len(here) == LEAST:
        return best
    exchanged = _best(there, here[:, [1, 0, 2]], sigma_m)
    if exchanged is not None and exchanged.agree.sum() > max(LEAST, best.agree.sum()):
        raise InputError(
            f"{file}: the control points fit the photographs with X and Y exchanged; exchange the two columns"
        )
    off = np.linalg.norm(here - best.similarity.of(there), axis=1)
    raise InputError(
        f"{file}: the marks of the control points do not fit their coordinates ({np.median(off):.3g} m off in the "
        "median); look at names, system and order of coordinates"
    )


def _best(there, here, sigma_m) -> OntoControl | None:
    size = float(np.linalg.norm(np.ptp(here, axis=0)))
    tolerance = _BEYOND * sigma_m + _BENT * size
    samples = list(combinations(range(len(here)), LEAST))
    if len(samples) > _SAMPLES:
        rng = np.random.default_rng(0)
        samples = [tuple(rng.choice(len(here), LEAST, replace=False)) for _ in range(_SAMPLES)]
    best: tuple[float, Similarity] | None = None
    for pick in samples:
        similarity = similarity_between(there[list(pick)], here[list(pick)], 0.02)
        if similarity is None:
            continue
        off = np.linalg.norm(here - similarity.of(there), axis=1) / tolerance
        score = float(np.sum(off < 1) - np.minimum(off, 1).mean())
        if best is None or score > best[0]:
            best = score, similarity
    if best is None:
        return None
    similarity = best[1]
    for _ in range(5):
        agree = np.linalg.norm(here - similarity.of(there), axis=1) < tolerance
        found = similarity_between(there[agree], here[agree])
        if found is None:
            break
        similarity = found
    return OntoControl(similarity, np.linalg.norm(here - similarity.of(there), axis=1) < tolerance)
