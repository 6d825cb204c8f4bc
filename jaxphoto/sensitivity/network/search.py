"""Gradient-based network design: minimise a criterion of the covariance over bounded design variables.

A design is a tree of numeric values. The user's pure function maps it to a `Layout`, and the criterion maps the
covariance of the layout to a scalar. The composition is differentiated, so a search needs some tens of covariances. A
grid search needs a number of covariances that is exponential in the number of variables. Bounds are enforced by

    x = (low + high) / 2 + (high - low) / 2 sin u

with unbounded u. BFGS minimises the logarithm of the criterion, so variables and objective are dimensionless. The
objective has many local minima, so a search uses several starts.
"""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError, DatumError, InputError
from jaxphoto.sensitivity.network.covariance import NetworkCovariance, design_covariance
from jaxphoto.sensitivity.network.layout import Layout, check_layout

Design = TypeVar("Design")
LayoutOf = Callable[[Any], Layout]
Criterion = Callable[[NetworkCovariance], Float[Array, ""]]
MAX_STEPS = 200
# Convergence limit: maximum change of ln(criterion) and of the variables (in units of their range).
_TOLERANCE = 1e-6
# Maximum distance of initial values from the centre, in half ranges: the derivative by u is zero at a bound.
_MAX_START = 0.99
# Maximum number of designs per batch of covariances.
_BATCH = 16


class DesignSearch(eqx.Module, Generic[Design]):
    """Result of `optimise_design`. Designs have a leading axis over the starts; values are criterion values."""

    starts: Design
    start_values: Float[np.ndarray, "starts"]
    designs: Design
    values: Float[np.ndarray, "starts"]
    steps: Int[np.ndarray, "starts"]
    converged: Bool[np.ndarray, "starts"]

    @property
    def best(self) -> Design:
        """Design with the smallest criterion."""
        return jax.tree.map(lambda v: v[np.argmin(self.values)], self.designs)

    @property
    def value(self) -> float:
        """Smallest criterion value."""
        return float(np.min(self.values))


def optimise_design(
    criterion: Criterion,
    layout_of: LayoutOf,
    low: Design,
    high: Design,
    starts: Design,
    smooth: Criterion | None = None,
    max_steps: int = MAX_STEPS,
) -> DesignSearch[Design]:
    """Minimise `criterion` over designs between `low` and `high`, once from each of `starts`.

    `layout_of` maps one design to its `Layout` and must be differentiable. `low`, `high` and each start are designs of
    equal structure. A variable with equal bounds is fixed. `starts` has a leading axis (`random_designs`,
    `stack_designs`). For a `criterion` with kinks, give a differentiable `smooth` for the search. Values and the best
    design refer to `criterion`, and no result is worse than its start.

    Raises InputError for reversed bounds, a start outside the bounds, or a criterion of a fixed parameter; DatumError
    or BlockError for a start whose block has no datum, or images without points.
    """
    low, high = _checked(low, high)
    starts = _checked_starts(starts, low, high)
    for k in range(len(jax.tree.leaves(starts)[0])):
        start = jax.tree.map(lambda v: v[k], starts)  # noqa: B023
        _check(call_compiled(_layout, layout_of, start), f"start {k + 1} of the search")
    before = evaluate_designs(criterion, layout_of, starts)
    for number in np.flatnonzero(~np.isfinite(before)):
        raise InputError(
            f"start {number + 1} of the search has a rank defect, so the criterion is undefined: start elsewhere, fix "
            "an interior parameter, or increase the weight of control and stations"
        )
    objective = criterion if smooth is None else smooth
    designs, steps, converged = call_compiled(_search, objective, layout_of, low, high, starts, max_steps)
    designs = jax.tree.map(np.asarray, designs)
    after = evaluate_designs(criterion, layout_of, designs)
    better = after < before
    best = lambda new, old: np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
    designs = jax.tree.map(best, designs, starts)
    values = np.where(better, after, before)
    return DesignSearch(starts, before, designs, values, np.asarray(steps), np.asarray(converged))


def evaluate_designs(criterion: Criterion, layout_of: LayoutOf, designs: Design) -> Float[np.ndarray, "designs"]:
    """Compute the criterion of each of `designs` (a leading axis), for a grid search; NaN with a rank defect."""
    arrays = jax.tree.map(lambda v: np.asarray(v, float), designs)
    return np.asarray(call_compiled(_evaluate, criterion, layout_of, arrays))


def random_designs(low: Design, high: Design, n: int, seed: int = 0) -> Design:
    """Draw `n` designs uniformly between the bounds; they have a leading axis."""
    low, high = _checked(low, high)
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a, b: a + (b - a) * rng.uniform(size=(n, *a.shape)), low, high)


def grid_designs(low: Design, high: Design, n: int) -> Design:
    """Return every combination of `n` equidistant values of each variable from `low` to `high`, with a leading axis.

    A variable with equal bounds has one value.
    """
    low, high = _checked(low, high)
    (lows, tree), highs = jax.tree.flatten(low), jax.tree.leaves(high)
    pairs = [(a, b) for x, y in zip(lows, highs, strict=True) for a, b in zip(x.ravel(), y.ravel(), strict=True)]
    values = [np.linspace(a, b, n if b > a else 1) for a, b in pairs]
    columns = np.stack([v.ravel() for v in np.meshgrid(*values, indexing="ij")], axis=1)
    ends = np.cumsum([x.size for x in lows])
    parts = np.split(columns, ends[:-1], axis=1)
    return jax.tree.unflatten(tree, [v.reshape(-1, *x.shape) for v, x in zip(parts, lows, strict=True)])


def best_designs(criterion: Criterion, layout_of: LayoutOf, designs: Design, n: int) -> Design:
    """Return the `n` of `designs` (a leading axis) with the smallest criterion, as starts of a search.

    Raises InputError if fewer than `n` designs have a finite criterion.
    """
    values = evaluate_designs(criterion, layout_of, designs)
    if np.isfinite(values).sum() < n:
        raise InputError(
            f"only {np.isfinite(values).sum()} of {len(values)} designs have no rank defect, {n} are required: narrow "
            "the bounds, or request fewer"
        )
    best = np.argsort(values)[:n]
    return jax.tree.map(lambda v: np.asarray(v)[best], designs)


def stack_designs(*designs: Design) -> Design:
    """Stack single designs along a new leading axis."""
    return jax.tree.map(lambda *v: np.stack([np.asarray(x, float) for x in v]), *designs)


@eqx.filter_jit
def _layout(layout_of: LayoutOf, design) -> Layout:
    return layout_of(design)


@eqx.filter_jit
def _evaluate(criterion: Criterion, layout_of: LayoutOf, designs):
    return jax.lax.map(lambda d: criterion(design_covariance(layout_of(d))), designs, batch_size=_BATCH)


@eqx.filter_jit
def _search(objective: Criterion, layout_of: LayoutOf, low, high, starts, max_steps: int):
    middle, half = jax.tree.map(lambda a, b: (a + b) / 2, low, high), jax.tree.map(lambda a, b: (b - a) / 2, low, high)

    def design(u):
        return jax.tree.map(lambda m, h, v: m + h * jnp.sin(v), middle, half, u)

    def logarithm(u, _):
        return jnp.log(objective(design_covariance(layout_of(design(u)))))

    def minimise(start):
        relative = jax.tree.map(lambda v, m, h: (v - m) / jnp.where(h > 0, h, 1.0), start, middle, half)
        u = jax.tree.map(lambda v: jnp.arcsin(jnp.clip(v, -_MAX_START, _MAX_START)), relative)
        solver: Any = optx.BestSoFarMinimiser(optx.BFGS(_TOLERANCE, _TOLERANCE))
        solution: optx.Solution = optx.minimise(logarithm, solver, u, max_steps=max_steps, throw=False)
        return design(solution.value), solution.stats["num_steps"], solution.result == optx.RESULTS.successful

    # Run sequentially: vmapped, each search would wait for the slowest, and batches save no time on a CPU.
    return jax.lax.map(minimise, starts)


def _checked(low: Design, high: Design) -> tuple[Design, Design]:
    """Return the bounds as arrays. Raises InputError unless every low bound is at most its high one."""
    low, high = (jax.tree.map(lambda v: np.asarray(v, float), tree) for tree in (low, high))
    if not _same_structure(low, high):
        raise InputError("low and high have different structures: give both the same variables")
    for (path, a), b in zip(jax.tree.leaves_with_path(low), jax.tree.leaves(high), strict=True):
        name = jax.tree_util.keystr(path).lstrip(".") or "the design variable"
        if a.shape != b.shape:
            raise InputError(f"the bounds of {name} have the shapes {a.shape} and {b.shape}: give both the same")
        if not (np.isfinite(a).all() and np.isfinite(b).all()):
            raise InputError(f"the bounds of {name} are not all finite: a search needs a bounded region")
        if (a > b).any():
            k = int(np.argmax(np.ravel(a - b)))
            raise InputError(
                f"the bounds of {name} are reversed: the low one, {np.ravel(a)[k]:g}, exceeds the high one, "
                f"{np.ravel(b)[k]:g}; exchange them"
            )
    return low, high


def _same_structure(one: Any, other: Any) -> bool:
    first: Any = jax.tree.structure(one)
    return bool(first == jax.tree.structure(other))


def _checked_starts(starts: Design, low: Design, high: Design) -> Design:
    """Return `starts` as arrays. Raises InputError for a start outside the bounds."""
    starts = jax.tree.map(lambda v: np.asarray(v, float), starts)
    if not _same_structure(starts, low):
        raise InputError("the starts and the bounds have different structures: give both the same variables")
    leaves = zip(jax.tree.leaves_with_path(starts), jax.tree.leaves(low), jax.tree.leaves(high), strict=True)
    for (path, v), a, b in leaves:
        name = jax.tree_util.keystr(path).lstrip(".") or "the design variable"
        if v.shape[1:] != a.shape:
            raise InputError(
                f"the starts of {name} have the shape {v.shape}, but the variable has {a.shape}: stack the starts "
                "along a leading axis (stack_designs)"
            )
        if ((v < a) | (v > b)).any():
            raise InputError(f"a start of {name} is outside its bounds: widen these or start elsewhere")
    return starts


def _check(layout: Layout, name: str) -> None:
    """Apply `check_layout` and add the name of the design to its error."""
    try:
        check_layout(layout)
    except DatumError as error:
        raise DatumError(f"{name} has no datum: {error}") from error
    except BlockError as error:
        raise BlockError(f"{name} is not feasible: {error}") from error
