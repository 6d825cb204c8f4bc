"""Networks designed by gradient: the design variables between bounds that make a criterion of the covariance smallest.

A design is a tree of numbers; the user's pure function makes a `Layout` of it, and the criterion a number of the
covariance of that. The way from one to the other is differentiated, so a search needs some tens of covariances where a
grid needs so many to the power of the number of variables. Bounds are kept by the sine,

    x = (low + high) / 2 + (high - low) / 2 sin u

in which u is free, and the logarithm of the criterion is what BFGS makes small: neither has a unit. Valleys are many,
so a search goes down from several starts.
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
from jaxphoto.sensitivity.network.block import check_layout
from jaxphoto.sensitivity.network.covariance import NetworkCovariance, design_covariance
from jaxphoto.sensitivity.network.layout import Layout

Design = TypeVar("Design")
LayoutOf = Callable[[Any], Layout]
Criterion = Callable[[NetworkCovariance], Float[Array, ""]]
MAX_STEPS = 200
# The search ends where a step changes ln(criterion) and the variables (in units of their range) by less.
_TOLERANCE = 1e-6
# How near to a bound a start may be, in units of the half range: on it, the derivative by u is zero.
_NEAR = 0.99
# Designs whose covariances are computed at a time.
_BATCH = 16


class DesignSearch(eqx.Module, Generic[Design]):
    """What `optimise_design` found. Designs have a leading axis over the starts; values are those of the criterion."""

    starts: Design
    start_values: Float[np.ndarray, "starts"]
    found: Design
    values: Float[np.ndarray, "starts"]
    steps: Int[np.ndarray, "starts"]
    converged: Bool[np.ndarray, "starts"]

    @property
    def best(self) -> Design:
        """The design of the smallest criterion."""
        return jax.tree.map(lambda v: v[np.argmin(self.values)], self.found)

    @property
    def value(self) -> float:
        """The criterion there."""
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
    """The designs between `low` and `high` of the smallest `criterion`, one for each of `starts`.

    `layout_of` takes one design to its `Layout` and is differentiable; `low`, `high` and each start are designs, equal
    in shape. A variable whose bounds are equal is held. `starts` has a leading axis (`random_designs`, `stacked`).
    `smooth` takes the place of a `criterion` with kinks inside the search; values and the best design are by
    `criterion`, and no start comes out worse than it went in.

    Raises InputError for bounds that are upside down, a start outside, or a criterion of a fixed parameter; DatumError
    or BlockError where a start leaves the block without a datum, or images without points.
    """
    low, high = _checked(low, high)
    starts = _inside(starts, low, high)
    for k, start in enumerate(_each(starts)):
        _check(call_compiled(_layout, layout_of, start), f"start {k + 1} of the search")
    before = evaluate_designs(criterion, layout_of, starts)
    for number in np.flatnonzero(~np.isfinite(before)):
        raise InputError(
            f"start {number + 1} of the search does not determine all unknowns of its block, so the criterion has no "
            "value there; begin elsewhere, hold an interior parameter fixed, or give control and stations more weight"
        )
    objective = criterion if smooth is None else smooth
    found, steps, converged = call_compiled(_search, objective, layout_of, low, high, starts, max_steps)
    found = jax.tree.map(np.asarray, found)
    after = evaluate_designs(criterion, layout_of, found)
    better = after < before
    found = jax.tree.map(lambda new, old: np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old), found, starts)
    return DesignSearch(
        starts, before, found, np.where(better, after, before), np.asarray(steps), np.asarray(converged)
    )


def evaluate_designs(criterion: Criterion, layout_of: LayoutOf, designs: Design) -> Float[np.ndarray, "designs"]:
    """The criterion of every one of `designs` (a leading axis): a grid search is its smallest value.

    NaN where a design does not determine the unknowns.
    """
    arrays = jax.tree.map(lambda v: np.asarray(v, float), designs)
    return np.asarray(call_compiled(_evaluate, criterion, layout_of, arrays))


def random_designs(low: Design, high: Design, n: int, seed: int = 0) -> Design:
    """`n` designs drawn uniformly between the bounds, with a leading axis."""
    low, high = _checked(low, high)
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a, b: a + (b - a) * rng.uniform(size=(n, *a.shape)), low, high)


def grid_designs(low: Design, high: Design, n: int) -> Design:
    """Every combination of `n` values of each variable, evenly spread from `low` to `high`, with a leading axis.

    A variable whose bounds are equal has one value.
    """
    low, high = _checked(low, high)
    (lows, tree), highs = jax.tree.flatten(low), jax.tree.leaves(high)
    pairs = [(a, b) for x, y in zip(lows, highs, strict=True) for a, b in zip(x.ravel(), y.ravel(), strict=True)]
    values = [np.linspace(a, b, n if b > a else 1) for a, b in pairs]
    columns = np.stack([v.ravel() for v in np.meshgrid(*values, indexing="ij")], axis=1)
    ends = np.cumsum([x.size for x in lows])
    parts = np.split(columns, ends[:-1], axis=1)
    return jax.tree.unflatten(tree, [v.reshape(-1, *x.shape) for v, x in zip(parts, lows, strict=True)])


def promising(criterion: Criterion, layout_of: LayoutOf, designs: Design, n: int) -> Design:
    """The `n` of `designs` (a leading axis) with the smallest criterion: where to begin a search.

    From the best of a grid it finds what is better than the grid. Raises InputError where fewer have a value.
    """
    values = evaluate_designs(criterion, layout_of, designs)
    if np.isfinite(values).sum() < n:
        raise InputError(
            f"of {len(values)} designs {np.isfinite(values).sum()} determine their unknowns, not {n}; narrow the "
            "bounds, or ask for fewer"
        )
    chosen = np.argsort(values)[:n]
    return jax.tree.map(lambda v: np.asarray(v)[chosen], designs)


def stacked(*designs: Design) -> Design:
    """Single designs as one with a leading axis."""
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

    def down(start):
        part = jax.tree.map(lambda v, m, h: (v - m) / jnp.where(h > 0, h, 1.0), start, middle, half)
        u = jax.tree.map(lambda v: jnp.arcsin(jnp.clip(v, -_NEAR, _NEAR)), part)
        solver: Any = optx.BestSoFarMinimiser(optx.BFGS(_TOLERANCE, _TOLERANCE))
        solution: optx.Solution = optx.minimise(logarithm, solver, u, max_steps=max_steps, throw=False)
        return design(solution.value), solution.stats["num_steps"], solution.result == optx.RESULTS.successful

    # One after the other: of all at once each would wait for the slowest, and on a CPU no product gains by a batch.
    return jax.lax.map(down, starts)


def _checked(low: Design, high: Design) -> tuple[Design, Design]:
    """Both as arrays. Raises InputError unless every low bound is at most its high one."""
    low, high = (jax.tree.map(lambda v: np.asarray(v, float), tree) for tree in (low, high))
    if not _alike(low, high):
        raise InputError("the bounds are designs of different kinds; give low and high the same variables")
    for (path, a), b in zip(jax.tree.leaves_with_path(low), jax.tree.leaves(high), strict=True):
        name = jax.tree_util.keystr(path).lstrip(".") or "the design variable"
        if a.shape != b.shape:
            raise InputError(f"the bounds of {name} have the shapes {a.shape} and {b.shape}; give both the same")
        if not (np.isfinite(a).all() and np.isfinite(b).all()):
            raise InputError(f"the bounds of {name} are not all finite numbers; a search needs a region")
        if (a > b).any():
            k = int(np.argmax(np.ravel(a - b)))
            raise InputError(
                f"the bounds of {name} are upside down: the low one, {np.ravel(a)[k]:g}, is above the high one, "
                f"{np.ravel(b)[k]:g}; exchange them"
            )
    return low, high


def _alike(one: Any, other: Any) -> bool:
    """Whether both are trees of the same variables."""
    first: Any = jax.tree.structure(one)
    return bool(first == jax.tree.structure(other))


def _inside(starts: Design, low: Design, high: Design) -> Design:
    """`starts` as arrays. Raises InputError where one is outside of the bounds."""
    starts = jax.tree.map(lambda v: np.asarray(v, float), starts)
    if not _alike(starts, low):
        raise InputError("the starts are no designs of the kind of the bounds; give them the same variables")
    leaves = zip(jax.tree.leaves_with_path(starts), jax.tree.leaves(low), jax.tree.leaves(high), strict=True)
    for (path, v), a, b in leaves:
        name = jax.tree_util.keystr(path).lstrip(".") or "the design variable"
        if v.shape[1:] != a.shape:
            raise InputError(
                f"the starts of {name} have the shape {v.shape}, but each is one of {a.shape}; put the starts along a "
                "leading axis (stacked)"
            )
        if ((v < a) | (v > b)).any():
            raise InputError(f"a start of {name} lies outside of its bounds; widen these or begin elsewhere")
    return starts


def _each(designs: Design) -> list[Design]:
    n = len(jax.tree.leaves(designs)[0])
    return [jax.tree.map(lambda v, k=k: v[k], designs) for k in range(n)]


def _check(layout: Layout, name: str) -> None:
    """`check_layout`, which names the design. It has to be the error that is raised, not another."""
    try:
        check_layout(layout)
    except DatumError as error:
        raise DatumError(f"{name} leaves its block without a datum: {error}") from error
    except BlockError as error:
        raise BlockError(f"{name} cannot be flown: {error}") from error
