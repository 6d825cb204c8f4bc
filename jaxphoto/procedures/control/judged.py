"""Surveyed points and their marks after an adjustment: how far they are off, and what contradicts the rest.

Of what was adjusted with, the normalised residual tells (Baarda's test), of check points and points that were left out
the difference over its standard deviation: that of the survey and that of the adjustment together.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.statistics import LEAST_CHECKED, covariance, normalised_residuals, redundancy_numbers

CRITICAL = 4.0
"""Normalised residuals beyond this are errors: one in 16,000 is not."""

# Residuals whose scatter is told, and the median of the larger of two normal errors.
_ENOUGH, _LARGER = 8, 1.05
# Surveyed points whose scatter is told, the median of a normal error, and by how much they scatter more than a guess
# before it is given up: the median of twelve is beyond 1.9 times what it should be in one block of a hundred.
_POINTS, _MEDIAN, _MORE = 6, 0.6745, 2.0
# Change (of the logarithm) that another adjustment is not worth.
_STILL = 0.15


class JudgedControl(NamedTuple):
    """The last `points` of a block and the marks of them."""

    adjusted_m: Float[np.ndarray, "points 3"]
    off_m: Float[np.ndarray, "points 3"]
    """Surveyed minus adjusted; NaN where nothing was surveyed."""
    sigma_m: Float[np.ndarray, "points 3"]
    """Of the adjusted coordinates, a posteriori."""
    w: Float[np.ndarray, "points 3"]
    """Over its standard deviation; NaN where nothing tells."""
    marks_px: Float[np.ndarray, "rows 2"]
    """Measured minus computed, column and row, of the marks in the order of the block."""
    marks_w: Float[np.ndarray, "rows"]
    """The larger of both axes; NaN where nothing tells."""


def judged(
    adjusted: Adjustment, n: int, xyz: Float[np.ndarray, "points 3"], sigma: Float[np.ndarray, "points 3"]
) -> JudgedControl:
    """The last `n` points, surveyed at `xyz` with `sigma` (m); whatever their role."""
    block = adjusted.block
    first = len(block.points) - n
    cov = covariance(adjusted, rows=True)
    redundancy = redundancy_numbers(adjusted, cov)
    tested = normalised_residuals(adjusted, redundancy)
    place = np.asarray(adjusted.unknowns.points, float)[first:]
    own = np.asarray(cov.point_sigma)[first:]
    off = xyz - place
    w = np.abs(off) / np.hypot(own, np.where(np.isfinite(sigma), sigma, 0.0))
    control = block.control
    if len(control):
        r, told = np.asarray(redundancy["control_points"]), np.asarray(tested["control_points"])
        mine = np.asarray(control.who) >= first
        who, axis = np.asarray(control.who)[mine] - first, np.asarray(control.axis)[mine]
        w[who, axis] = np.where(r[mine] > LEAST_CHECKED, np.abs(told[mine]), np.nan)
    rows = np.asarray(block.image_points.point) >= first
    pixel = np.array([block.sensors[c].pixel_mm for c in block.image_camera])[block.image_points.image[rows]]
    residual = np.asarray(adjusted.residuals.image)[:, rows] * np.asarray(block.image_points.sigma).T[:, rows]
    of_marks = np.where(
        np.asarray(redundancy.image)[:, rows] > LEAST_CHECKED, np.abs(np.asarray(tested.image)[:, rows]), np.nan
    )
    marks_px = residual.T / pixel[:, None] * (1, -1)
    return JudgedControl(place, off, own, w, marks_px, _largest(of_marks))


def _largest(w: Float[np.ndarray, "2 rows"]) -> Float[np.ndarray, "rows"]:
    """Over the first axis; NaN where all are."""
    found = np.max(np.nan_to_num(w, nan=-1.0), axis=0, initial=-1.0)
    return np.where(found < 0, np.nan, found)


def scatter(marks_w: Float[np.ndarray, "rows"]) -> float:
    """How much more the normalised residuals of marks scatter than they should; 1 at least, and where they are few.

    What people mark seldom is as good as they say, which makes no blunders of it.
    """
    known = marks_w[np.isfinite(marks_w)]
    return max(1.0, float(np.median(known)) / _LARGER) if len(known) >= _ENOUGH else 1.0


def poorer_survey(
    w: Float[np.ndarray, "points 3"],
    sigma_m: Float[np.ndarray, "points 3"],
    assumed: Bool[np.ndarray, "points 3"],
    guess_m: tuple[float, float, float],
) -> Float[np.ndarray, "3"] | None:
    """Standard deviations (m) of the coordinates `assumed` by which most of them fit; None where `sigma_m` will do.

    The median of the normalised residuals tells, of plan and height each; up to half of the points may spoil it.
    A block gives way to what is held too firmly, so that more than one adjustment is needed to tell: once they are not
    `guess_m` any more, standard deviations become smaller, too. Heights are at first taken to be as poor as the plan.
    """
    now, given_up = np.array(guess_m), bool((sigma_m[assumed] > max(guess_m)).any())
    factor = np.ones(3)
    for axes in ([0, 1], [2]):
        if assumed[:, axes].any():
            now[axes] = np.median(sigma_m[:, axes][assumed[:, axes]])
        told = assumed[:, axes] & np.isfinite(w[:, axes])
        if told.any(axis=1).sum() >= _POINTS:
            factor[axes] = np.median(w[:, axes][told]) / _MEDIAN
    if given_up:
        return None if np.abs(np.log(factor)).max() < _STILL else np.maximum(factor * now, guess_m)
    if factor.max() < _MORE:
        return None
    poorer = np.maximum(factor, 1) * now
    return np.maximum(poorer, poorer[0])


def beyond(w: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
    """Which points are off by more than chance."""
    return np.nan_to_num(w).max(axis=1, initial=0.0) > CRITICAL
