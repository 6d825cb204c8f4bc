"""Iterated adjustment with lidar observations that depend on its result."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block, Start
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError, DatumError, RankError
from jaxphoto.procedures.adjust import adjust
from jaxphoto.statistics import LEAST_CHECKED, Covariance, angle_differences, covariance, redundancy_numbers
from jaxphoto.unknowns import FIXED, Unknowns

MAX_ROUNDS = 20
CHANGE_LIMIT = 0.1
"""Maximum change of an unknown at convergence, in standard deviations.

Smaller limits may never be reached: any motion may change the set of neighbouring laser points.
"""
# Maximum distance of a point from the surface, in standard deviations; rejected points are tested again in the next
# iteration.
_OUTLIER = 4.0
# Ratio to the largest normalised residual below which an observation is not rejected in the same iteration.
_LARGEST = 0.5
# First iteration with rejection, because the orientation may be inaccurate before; iteration after which rejections are
# final.
_JUDGED, _SETTLED = 2, 5
# Maximum difference of observations that are treated as equal, in standard deviations; iteration after which
# observations are constant.
_SAME, _LAST_LOOK = 0.5, 8
# Maximum ratio of the initial distance of points from the cloud to the height above it: error of the principal
# distance.
_FAR = 0.1
# Minimum fraction of observations that must be accepted in the final iteration.
_BORNE_OUT = 0.7
# Relative change of a principal distance above which it is unusual for a laboratory value.
_UNUSUAL = 0.02
# Sigma naught above which wrong weights are not a sufficient explanation (docs/trust.md).
_MISFIT = 3.0


class Round(NamedTuple):
    """Record of one iteration."""

    number: int
    observed: int
    """Number of lidar observations."""
    left_out: int
    """Rejected observations."""
    moved_m: float
    """Root mean square motion of the object points since the previous adjustment."""
    largest_change: float
    """Maximum change of interior and exterior orientation since then, in standard deviations."""
    rmse_m: float
    """RMS distance of the observed points from the surface, after the adjustment."""


class SurfaceAtPoints(NamedTuple):
    """Surface at points: one row per candidate, in the same order in every iteration."""

    point: Int[np.ndarray, "rows"]
    foot: Float[np.ndarray, "rows 3"]
    normal: Float[np.ndarray, "rows 3"]
    sigma: Float[np.ndarray, "rows"]
    """Standard deviation of the surface along its normal (m)."""
    usable: Bool[np.ndarray, "rows"]

    def apart(self, adjusted: Adjustment) -> Float[np.ndarray, "rows"]:
        """Return the heights of the adjusted points above the surface, along its normal (m)."""
        points = np.asarray(adjusted.unknowns.points)[self.point]
        return np.einsum("nk,nk->n", self.normal, points - self.foot)


class Observed(NamedTuple):
    """Last iteration: its adjustment, surface, and used observations."""

    before: SurfaceAtPoints
    """Surface at the first iteration."""
    adjusted: Adjustment
    covariance: Covariance
    seen: SurfaceAtPoints
    used: Bool[np.ndarray, "rows"]
    rounds: tuple[Round, ...]
    converged: bool
    """True if the iteration converged."""


Look = Callable[[Adjustment], SurfaceAtPoints]
Carry = Callable[[SurfaceAtPoints, Adjustment, Adjustment], SurfaceAtPoints]
Build = Callable[[Adjustment, Covariance, SurfaceAtPoints, Bool[np.ndarray, "rows"]], Block]


def adjust_with_fixed_interior(block: Block) -> Adjustment:
    """Adjust `block` with fixed interior orientation, for the positions of its points.

    If its datum is undetermined or nearly so, as for a strip with collinear stations, exterior orientation is fixed at
    its initial values from direct georeferencing: the cloud may determine the datum. Raises the errors of `adjust`, and
    BlockError if it does not converge.
    """
    held = fix_interior(block).priors
    try:
        adjusted = adjust(block, priors=held)
        placed = bool(adjusted.converged)
    except (DatumError, RankError):
        placed = False
    if not placed:
        exterior = ExteriorOrientation(FIXED, FIXED)  # type: ignore[arg-type]
        adjusted = adjust(block, priors=dataclasses.replace(held, exterior=exterior))
    if not bool(adjusted.converged):
        raise BlockError(f"the block alone, with fixed interior orientation, is {adjusted.outcome.value}")
    return adjusted


def fix_interior(block: Block) -> Block:
    """Fix the interior orientation of `block`."""
    interior = jax.tree.map(lambda _: FIXED, block.start.unknowns.interior)
    return dataclasses.replace(block, priors=dataclasses.replace(block.priors, interior=interior))


def check_without_surfaces(block: Block) -> None:
    """Raise BlockError if the block already has surface observations, which this procedure creates."""
    if len(block.surfaces.point) or block.start.unknowns.scanner is not None:
        raise BlockError(
            "the block already has points on the surfaces of a laser scanner: use the original block, without "
            "surfaces.csv and [scanner]"
        )


def with_common_error(
    sigma: Float[np.ndarray, "rows"], usable: Bool[np.ndarray, "rows"], common_m: float
) -> Float[np.ndarray, "rows"]:
    """Return standard deviations whose mean over n rows preserves a common error: sigma^2 + (n - 1) common^2.

    `sigma` contains the common error once. An adjustment treats observations as independent, which would average out
    the common error.
    """
    return np.sqrt(sigma**2 + max(int(usable.sum()) - 1, 0) * common_m**2)


def iterate_to_convergence(
    first: Adjustment,
    look: Look,
    build: Build,
    max_rounds: int,
    report: Callable[[Round], None],
    group: Literal["control_points", "surfaces"],
    carry: Carry = lambda surface, before, now: surface,
) -> Observed:
    """Iterate from `first` to convergence: `look` up the surface, `build` a block with it, adjust.

    Each block is adjusted from the unknowns of `build`. In later iterations an observation is unchanged if the new one
    is nearly equal, and finally in any case: otherwise the set of neighbouring laser points could alternate. `carry`
    transforms an earlier observation from the previous corrected cloud to the current one. The observations are the
    last rows of their `group`.
    """
    adjusted, cov, fits = first, covariance(first), np.array(True)
    before, at_first = first, look(first)
    surface = at_first
    _check_heights(first, surface)
    rounds: list[Round] = []
    while True:
        used = surface.usable & fits
        block = build(adjusted, cov, surface, used)
        new = adjust(block, block.start.unknowns)
        now = covariance(new)
        moved = np.asarray(new.unknowns.points) - np.asarray(adjusted.unknowns.points)
        change = _change(adjusted, new, now)
        apart = surface.apart(new)[used]
        rounds.append(
            Round(
                len(rounds) + 1,
                int(used.sum()),
                int((surface.usable & ~used).sum()),
                float(np.sqrt((moved**2).sum(axis=1).mean())),
                change,
                float(np.sqrt((apart**2).mean())) if len(apart) else np.nan,
            )
        )
        report(rounds[-1])
        before, adjusted, cov = adjusted, new, now
        converged = len(rounds) > _JUDGED and change < CHANGE_LIMIT and bool(new.converged)
        if converged or len(rounds) >= max_rounds:
            _check_used(surface, used)
            _warn_of_scale(first, new)
            _warn_of_misfit(new)
            return Observed(at_first, adjusted, cov, surface, used, tuple(rounds), converged)
        if len(rounds) >= _JUDGED:
            # In later iterations rejections are final, to avoid alternation.
            fits = _fit(surface, adjusted, cov, used, group) & (fits if len(rounds) >= _SETTLED else True)
        if len(rounds) < _SETTLED:
            surface = look(adjusted)
            continue
        surface = carry(surface, before, adjusted)
        if len(rounds) < _LAST_LOOK:
            surface = _keep_similar(surface, look(adjusted), adjusted)


def at_result(block: Block, unknowns: Unknowns) -> Block:
    """Return `block` with an adjustment's unknowns as initial values."""
    start = Start(unknowns, np.ones(len(block.images), bool), np.ones(len(block.points), bool))
    return dataclasses.replace(block, start=start)


def _check_heights(first: Adjustment, surface: SurfaceAtPoints) -> None:
    """Raise BlockError if the distance of cloud and points is too large for an error of the principal distance."""
    apart = surface.apart(first)[surface.usable]
    camera = float(np.mean(np.asarray(first.unknowns.exterior.position)[:, 2]))
    offset, height = (float(np.median(v)) for v in (apart, camera - surface.foot[surface.usable, 2]))
    if abs(offset) > _FAR * abs(height):
        raise BlockError(
            f"the cloud is {abs(offset):.0f} m {'below' if offset > 0 else 'above'} the block's points (flying height "
            f"{height:.0f} m); check the cloud's height unit and vertical datum, and the initial principal distance"
        )


def _check_used(surface: SurfaceAtPoints, used: Bool[np.ndarray, "rows"]) -> None:
    """Raise BlockError if the block contradicts the cloud at the majority of the points."""
    n, most = int(used.sum()), int(surface.usable.sum())
    if n < max(1.0, _BORNE_OUT * most):
        raise BlockError(
            f"only {n} of {most} observations of the cloud agree with the block: check that both are in one system, "
            "the stated standard deviations, and the adjustment without the cloud"
        )


def _warn_of_scale(first: Adjustment, adjusted: Adjustment) -> None:
    """Warn if the heights change a principal distance more than is plausible."""
    for name, interior in adjusted.unknowns.interior.items():
        before, after = float(first.unknowns.interior[name].c), float(interior.c)
        if abs(after - before) > _UNUSUAL * abs(before):
            warnings.warn(
                f"the principal distance of {name} changed from {before:.3f} to {after:.3f} mm: check that the cloud "
                "and the stations have the same vertical datum",
                UserWarning,
                stacklevel=4,
            )


def _warn_of_misfit(adjusted: Adjustment) -> None:
    """Warn if the observations do not agree with the cloud."""
    if (sigma0 := float(adjusted.sigma0)) > _MISFIT:
        warnings.warn(
            f"sigma naught is {sigma0:.3g}: the cloud contradicts the other observations; check its system, the order "
            "of its axes and its vertical datum",
            UserWarning,
            stacklevel=4,
        )


def _keep_similar(old: SurfaceAtPoints, new: SurfaceAtPoints, adjusted: Adjustment) -> SurfaceAtPoints:
    """Retain old observations that are nearly equal to the new ones."""
    same = np.abs(old.apart(adjusted) - new.apart(adjusted)) < _SAME * new.sigma
    chosen = (np.where(same[:, None] if v.ndim > 1 else same, u, v) for u, v in zip(old[1:], new[1:], strict=True))
    return SurfaceAtPoints(new.point, *chosen)


def _fit(
    surface: SurfaceAtPoints, adjusted: Adjustment, cov: Covariance, used: Bool[np.ndarray, "rows"], group: str
) -> Bool[np.ndarray, "rows"]:
    """Mark observations that are consistent with the others."""
    # Used observations: normalised residuals. The lidar observations are the last of their group.
    numbers, residuals = redundancy_numbers(adjusted, cov), adjusted.residuals
    # A group without rows has no residuals.
    none = np.zeros(0)
    v, r = (np.asarray(of.named.get(group, none)) for of in (residuals, numbers))
    v, r = (of_group[len(of_group) - int(used.sum()) :] for of_group in (v, r))
    # Other observations: relative to the adjusted positions.
    points = np.einsum("ni,nij,nj->n", surface.normal, np.asarray(cov.points)[surface.point], surface.normal)
    w = np.where(surface.usable, np.abs(surface.apart(adjusted)) / np.sqrt(surface.sigma**2 + points), 0.0)
    w[used] = np.abs(v) / np.sqrt(np.maximum(r, LEAST_CHECKED))
    # Reject the largest first: they affect the others.
    limit = _OUTLIER * max(1.0, float(adjusted.sigma0))
    return w <= max(limit, _LARGEST * w.max(initial=0.0))


def _change(old: Adjustment, new: Adjustment, cov: Covariance) -> float:
    """Return the largest change of a free interior or exterior orientation, in standard deviations."""
    if old.structure.labels != new.structure.labels:
        return np.inf
    sigma = np.sqrt(np.maximum(np.asarray(cov.matrix).diagonal(), 0.0))
    moved = np.asarray(new.unknowns.exterior.position) - np.asarray(old.unknowns.exterior.position)
    exterior = np.column_stack([moved, angle_differences(new, old)[1]]).ravel()
    free = new.structure.free
    shared = np.asarray(new.values.shared)[free] - np.asarray(old.values.shared)[free]
    known_at_all = sigma > 0
    change = np.abs(np.concatenate([exterior, shared]))
    return float(np.max(change[known_at_all] / sigma[known_at_all], initial=0.0))
