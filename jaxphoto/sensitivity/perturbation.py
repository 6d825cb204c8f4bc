"""Perturbations for Monte Carlo: errors of observations and of fixed or weighted parameters.

A perturbation is any function of a key and a block that returns the block with other values, alone or with a dict of
scalars to record:

    def perturb(key, block):
        rise = 0.1 * jax.random.normal(key)
        heights = block.stations.value + rise * (block.stations.axis == 2)
        return eqx.tree_at(lambda b: b.stations.value, block, heights), {"rise_m": rise}

`bias` and `noise` return common perturbations.

A constant error b of a trajectory shifts laser returns and exposures. Because the weights of the knots sum to 1, this
is equivalent to knots c' = c - b instead of c: the prior of the first knot of a strip becomes -b, and

    c[k + 1] - f c[k] = 0    becomes    c'[k + 1] - f c'[k] = -(1 - f) b

(`observations.knot_steps`). This is exact for positions and of first order in the error for attitudes.
"""

import dataclasses
from collections.abc import Callable, Collection, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names, table_name
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import TrajectoryKnot, strip_of_knot
from jaxphoto.observations import (
    ATTITUDE_AXES,
    AXES,
    Attitudes,
    AttitudeSteps,
    CameraPositions,
    Correlated,
    KnownParameters,
    PositionSteps,
    TrajectoryAttitudes,
    TrajectoryStations,
)
from jaxphoto.rotation import small_rotation
from jaxphoto.short_repr import pretty_repr
from jaxphoto.unknowns import FIXED, FREE, Weighted, is_prior

Steps = type[PositionSteps] | type[AttitudeSteps]
OBSERVED = {
    "station": (CameraPositions, TrajectoryStations),
    "attitude": (Attitudes, TrajectoryAttitudes),
}
"""Kinds of bias of GNSS and IMU, and the observations that they change."""
TRAJECTORY: dict[str, tuple[str, Steps]] = {
    "trajectory": ("position", PositionSteps),
    "trajectory-attitude": ("attitude", AttitudeSteps),
}
"""Kinds of bias of a scanner's trajectory: field of its knots, and observed differences between knots."""
LABELS = {
    "station": tuple(f"{a}_m" for a in AXES),
    "attitude": tuple(f"{a}_rad" for a in ATTITUDE_AXES),
    "control": tuple(f"{a}_m" for a in AXES),
    "image-points": ("x_mm", "y_mm"),
    **{kind: TrajectoryKnot.names[field] for kind, (field, _) in TRAJECTORY.items()},
}
"""Labels of the error components of one owner."""


class BiasedArray(NamedTuple):
    """Array of a block, with the owner and the axis of the error of each element."""

    path: tuple[Any, ...]
    """Path of the array in the block."""
    owner: list[str]
    axis: Int[np.ndarray, "numbers"]
    factor: Float[np.ndarray, "sets 3 3"] | None = None
    """Matrix multiplied with the errors of each set of three elements; None for the identity."""


def observed_arrays(block: Block, kind: str, per: str) -> list[BiasedArray]:
    """Return the arrays of stations, attitudes, control or image points."""
    kinds = OBSERVED.get(kind, ())
    if not kinds:
        name = kind.replace("-", "_")
        return [_observed_array(block, getattr(block, name), (name,), kind, per)]
    groups: list[tuple[tuple[Any, ...], Any]] = [((name,), getattr(block, name)) for name in ("stations", "attitudes")]
    groups += [(("more", k), rows) for k, rows in enumerate(block.more)]
    return [
        _observed_array(block, rows, path, kind, per) for path, rows in groups if isinstance(rows, kinds) and len(rows)
    ]


def _observed_array(block: Block, rows: Any, path: tuple[Any, ...], kind: str, per: str) -> BiasedArray:
    labels = LABELS[kind]
    if hasattr(rows, "who"):
        index, axis = rows.who, rows.axis
    else:
        index, axis = np.repeat(rows.image, len(labels)), np.tile(np.arange(len(labels)), len(rows))
    path = (*path, rows.observed)
    if per == "observation":
        point = np.repeat(rows.point, len(labels))
        owner = [f"{block.images[i]}.{block.points[p]}" for i, p in zip(index, point, strict=True)]
        return BiasedArray(path, owner, axis)
    names = {"image": block.images, "camera": block.image_camera, "strip": block.image_strip, "point": block.points}
    return BiasedArray(path, ["block" if per == "block" else names[per][k] for k in index], axis)


def trajectory_arrays(block: Block, kind: str, per: str) -> list[BiasedArray]:
    """Return the arrays that an error of the trajectory of a laser scanner changes, for each strip.

    Raises InputError for a block without a trajectory, and for a scalar prior of three axes.
    """
    field, steps = TRAJECTORY[kind]
    if not any(isinstance(rows, steps) and len(rows) for rows in block.more):
        raise InputError(
            f"block {block.title!r} has no trajectory of a laser scanner for a bias of kind {kind}: use the block of a "
            "strip adjustment (docs/boresight.md), or --bias station"
        )
    return [*_knots(block, field, per), *_steps(block, steps, per)]


def _knots(block: Block, field: str, per: str) -> Iterator[BiasedArray]:
    """Yield the arrays of knots that are fixed or have priors."""
    kind = TrajectoryKnot.kind
    for owner, knot in block.priors.more[kind].items():
        prior = getattr(knot, field)
        weighted = isinstance(prior, Weighted)
        if weighted and np.shape(prior.value) != (3,):
            raise InputError(f"{field} of {owner}: the prior is one value for three axes, give three")
        if weighted or prior == FIXED:
            leaf = ("more", kind, owner, field)
            path = ("priors", *leaf, "value") if weighted else ("start", "unknowns", *leaf)
            yield BiasedArray(path, [_owner(owner, per)] * 3, np.arange(3), -np.eye(3)[None])


def _steps(block: Block, steps: Steps, per: str) -> Iterator[BiasedArray]:
    knots = list(block.start.unknowns.more[TrajectoryKnot.kind])
    for k, rows in enumerate(block.more):
        if isinstance(rows, steps):
            decay = 1 - np.asarray(rows.kept)
            owner = [_owner(knots[start], per) for start in rows.start]
            axis, factor = np.tile(np.arange(3), len(rows)), -decay[:, None, None] * np.eye(3)
            yield BiasedArray(("more", k, rows.observed), [name for name in owner for _ in range(3)], axis, factor)


def _owner(knot: str, per: str) -> str:
    return "block" if per == "block" else strip_of_knot(knot)


Recorded = dict[str, Array]
Perturbation = Callable[[Any, Block], Block | tuple[Block, Recorded]]
Distribution = Callable[[Any, tuple[int, ...]], Array]
"""Random variates of mean 0 and standard deviation 1, from a key and a shape."""

PER = {
    "station": ("block", "strip", "image"),
    "attitude": ("block", "strip", "image"),
    "trajectory": ("block", "strip"),
    "trajectory-attitude": ("block", "strip"),
    "control": ("block", "point"),
    "image-points": ("camera", "image", "observation"),
    "lever-arm": ("mount",),
    "boresight": ("mount",),
    "interior": ("camera",),
}
"""Kinds of bias, and the units that can have independent errors."""
_AXES = {"lever-arm": ("right_m", "forward_m", "up_m"), "boresight": ("x_rad", "y_rad", "z_rad")}


@pretty_repr
class Bias(eqx.Module):
    """Errors added to values of a block: `sigma` times independent variates of `distribution`.

    Calling it with a key and a block applies random errors; `applied` adds given errors.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    """Names of the errors, such as `E1.X_m`; angles in rad."""
    sigma: Float[np.ndarray, "errors"]
    """Standard deviations of the errors, in the units of the names."""
    targets: tuple[tuple[Any, ...], ...] = eqx.field(static=True)
    """Paths in the block of the arrays to which the errors are added."""
    index: tuple[Int[np.ndarray, "..."], ...]
    """Index of the error of each element of these arrays; the number of errors for elements without an error."""
    distribution: Distribution = eqx.field(static=True, default=jax.random.normal)
    recorded: bool = eqx.field(static=True, default=True)
    """True if each error is recorded."""
    mixed: tuple[Float[np.ndarray, "_ _ _"] | None, ...] = ()
    """Factors L (sets, n, n) of the errors of each array, None for the identity. Correlated errors have the covariance
    L L'.
    """

    def __call__(self, key, block: Block) -> tuple[Block, Recorded]:
        """Return `block` with random errors, and the errors by name."""
        errors = self.drawn(key)
        return self.applied(errors, block), dict(zip(self.names, errors, strict=True)) if self.recorded else {}

    def drawn(self, key) -> Float[Array, "errors"]:
        """Draw the errors of a key."""
        return jnp.asarray(self.sigma) * self.distribution(key, self.sigma.shape)

    def applied(self, errors: Float[Array, "errors"], block: Block) -> Block:
        """Return `block` with given errors, in the order of `names`."""
        padded = jnp.append(errors, 0.0)
        targets = lambda b: [_follow(b, path) for path in self.targets]  # noqa: E731
        factors = self.mixed or (None,) * len(self.targets)
        new = [
            _with_errors(v, padded[k] if factor is None else jnp.einsum("nij,nj->ni", factor, padded[k]))
            for v, k, factor in zip(targets(block), self.index, factors, strict=True)
        ]
        return in_order_of(block, eqx.tree_at(targets, block, new))


def in_order_of(block: Block, changed: Block) -> Block:
    """Reorder the unknowns of `changed` as in `block`."""
    start = dataclasses.replace(changed.start, unknowns=changed.start.unknowns.in_order_of(block.start.unknowns))
    return dataclasses.replace(changed, start=start, priors=changed.priors.in_order_of(block.priors))


def _with_errors(values: Any, errors: Array) -> Array:
    """Add errors to values; rotation matrices are multiplied by small rotations."""
    if errors.size == np.size(values):
        return jnp.asarray(values) + errors.reshape(np.shape(values))
    turn = jax.vmap(small_rotation)(errors.reshape(-1, 3))
    return (turn @ jnp.asarray(values).reshape(-1, 3, 3)).reshape(np.shape(values))


def bias(
    block: Block,
    kind: str,
    sigma: float | Collection[float],
    per: str | None = None,
    *,
    of: Collection[str] = (),
    parameter: str = "",
    distribution: Distribution = jax.random.normal,
) -> Bias:
    """Define errors of one kind, independent for each axis and each strip, image, point, mount or camera.

    `kind` is a key of `PER`, `per` one of its entries (default: the first). `sigma`: m for stations, control and lever
    arms; rad for attitudes and boresights; mm for image points; own units for the interior `parameter` (`c`, `k1`
    ...); one value, or one per axis. `of` names the units that get errors (default: all). Lever arms, boresights and
    interior parameters must be FIXED (the fixed value changes) or Weighted (the prior value changes).

    Errors of `station` and `attitude` apply to exposures only. `trajectory` (m) and `trajectory-attitude` (rad, about
    right, forward and up) are errors of the trajectory of a laser scanner, for the whole flight or for each laser
    strip. They apply to its returns and to the exposures on the trajectory (`BiasedArray`).

    Raises InputError for an invalid kind, name or sigma.
    """
    if kind not in PER:
        raise InputError(f"unknown kind of bias {kind!r}: choose among {', '.join(PER)}")
    per = PER[kind][0] if per is None else per
    if per not in PER[kind]:
        raise InputError(f"a bias of kind {kind} is drawn per {' or '.join(PER[kind])}, not per {per}")
    if (parameter != "") != (kind == "interior"):
        raise InputError("a parameter name, such as c, is required for a bias of kind interior only")
    if kind in ("lever-arm", "boresight", "interior"):
        return _parameters(block, kind, sigma, of, table_name(parameter), distribution)
    axes = LABELS[kind]
    arrays = (trajectory_arrays if kind in TRAJECTORY else observed_arrays)(block, kind, per)
    owners = list(dict.fromkeys(name for array in arrays for name in array.owner))
    if not owners:
        raise InputError(f"block {block.title!r} has no observation for a bias of kind {kind}")
    if owners == [""]:
        raise InputError(f"the images of block {block.title!r} belong to no {per}: name it in images.csv")
    chosen = _chosen(of, owners, kind, per)
    first = {name: len(axes) * k for k, name in enumerate(chosen)}
    indices = []
    for array in arrays:
        index = np.array([first.get(name, -1) for name in array.owner], int)
        index = np.where(index < 0, len(axes) * len(chosen), index + array.axis)
        indices.append(index if array.factor is None else index.reshape(-1, 3))
    names = tuple(f"{name}.{label}" for name in chosen for label in axes)
    paths, factors = tuple(array.path for array in arrays), tuple(array.factor for array in arrays)
    sigmas, recorded = _sigmas(sigma, axes, len(chosen)), per != "observation"
    return Bias(names, sigmas, paths, tuple(indices), distribution, recorded, factors)


class _Noisy(NamedTuple):
    """Path of observed values, their standard deviations, and the Cholesky factor of their covariance if correlated."""

    path: tuple[Any, ...]
    sigma: np.ndarray
    factor: np.ndarray | None = None


def noise(block: Block) -> Bias:
    """Define errors of all observations and prior values, with the a priori covariance of the block.

    Raises InputError for a scalar prior of several values.
    """
    parts = [part for part in (*_observed(block), *_weighted(block)) if np.size(part.sigma)]
    starts = np.cumsum([0, *(np.size(part.sigma) for part in parts)])
    names = tuple(f"{'.'.join(map(str, part.path))}.{k}" for part in parts for k in range(np.size(part.sigma)))
    index = tuple(
        np.asarray(start + np.arange(np.size(part.sigma)).reshape(np.shape(part.sigma)))
        for start, part in zip(starts, parts, strict=False)
    )
    sigma = np.concatenate([np.ravel(part.sigma) for part in parts])
    factors = tuple(part.factor for part in parts)
    return Bias(names, sigma, tuple(part.path for part in parts), index, recorded=False, mixed=factors)


def _observed(block: Block) -> Iterator[_Noisy]:
    """Yield the observations of all groups of the block."""
    groups = (block.image_points, *block.observations)
    fields: list[tuple[tuple[Any, ...], Any]] = [((f.name,), getattr(block, f.name)) for f in dataclasses.fields(block)]
    fields += [(("more", k), rows) for k, rows in enumerate(block.more)]
    for path, rows in fields:
        if isinstance(rows, KnownParameters):
            yield _correlated((*path, "value"), rows.covariance[None])
        elif isinstance(rows, Correlated):
            yield _correlated((*path, "rows", rows.rows.observed), rows.covariance)
        elif any(rows is group for group in groups):
            yield _Noisy((*path, rows.observed), np.asarray(rows.sigmas))


def _correlated(path: tuple[Any, ...], covariance: Any) -> _Noisy:
    factor = np.linalg.cholesky(np.asarray(covariance))
    return _Noisy(path, np.ones(factor.shape[:2]), factor)


def _weighted(block: Block) -> Iterator[_Noisy]:
    """Yield the prior values."""
    paths = jax.tree_util.tree_leaves_with_path(block.priors, is_leaf=is_prior)
    unknowns = block.start.unknowns
    for keys, prior in paths:
        if isinstance(prior, Weighted):
            path = tuple(getattr(key, "name", getattr(key, "key", None)) for key in keys)
            value = _follow(unknowns, path)
            if np.shape(prior.value) != np.shape(value):
                raise InputError(
                    f"{_label(path)}: the prior is one value for {np.size(value)} numbers, give one for each"
                )
            rotations = path[-1] == "camera_from_object"
            shape = (*np.shape(value)[:-1],) if rotations else np.shape(value)
            if prior.covariance is None:
                yield _Noisy(("priors", *path, "value"), np.broadcast_to(prior.sigma, shape))
            else:
                sets = (int(np.prod(shape[:-1], dtype=int)), 3, 3)
                yield _correlated(("priors", *path, "value"), np.broadcast_to(prior.covariance, sets))


def _label(path: tuple[Any, ...]) -> str:
    """Return a label for messages, such as "shift of a" or "exterior.position"."""
    return (
        f"{path[-1]} of {path[-2]}" if path[0] in ("mounts", "strips", "scanner", "more") else ".".join(map(str, path))
    )


def _parameters(block: Block, kind: str, sigma, of: Collection[str], parameter: str, distribution: Distribution):
    unknowns, priors = block.start.unknowns, block.priors
    table: Any = unknowns.interior if kind == "interior" else unknowns.mounts
    prior_table: Any = priors.interior if kind == "interior" else priors.mounts
    if not table:
        raise InputError(f"block {block.title!r} has no mount for a bias of kind {kind}")
    chosen = _chosen(of, list(table), kind, PER[kind][0])
    field = {"lever-arm": "lever_arm", "boresight": "boresight", "interior": parameter}[kind]
    axes = (parameter,) if kind == "interior" else tuple(f"{field}_{a}" for a in _AXES[kind])
    targets = []
    for name in chosen:
        if kind == "interior" and parameter not in parameter_names(table[name]):
            choices = ", ".join(parameter_names(table[name]))
            raise InputError(f"camera {name} has no parameter {parameter!r}: choose among {choices}")
        prior = _leaf(prior_table[name], field)
        if prior == FREE:
            raise InputError(f"{field} of {name} is free, so a bias of its value has no effect: fix it or weight it")
        root = ("start", "unknowns") if prior == FIXED else ("priors",)
        if prior != FIXED and np.shape(prior.value) != (() if kind == "interior" else (3,)):
            raise InputError(f"{field} of {name}: the prior is one value for three axes, give three")
        path = (*root, "interior" if kind == "interior" else "mounts", name, field)
        targets.append(path if prior == FIXED else (*path, "value"))
    index = tuple(len(axes) * k + np.arange(len(axes)) for k in range(len(chosen)))
    names = tuple(f"{name}.{axis}" for name in chosen for axis in axes)
    return Bias(names, _sigmas(sigma, axes, len(chosen)), tuple(targets), index, distribution)


def _follow(tree: Any, path: tuple[Any, ...]) -> Any:
    """Return the leaf at a path of fields, keys, indices and names of interior parameters."""
    for step in path:
        tree = tree[step] if isinstance(tree, dict | tuple) else _leaf(tree, step)
    return tree


def _leaf(tree: Any, name: str) -> Any:
    """Return a field, or an interior parameter of a camera, by name."""
    named = isinstance(tree, InteriorOrientation) and not hasattr(tree, name)
    return get_parameter(tree, name) if named else getattr(tree, name)


def _chosen(of: Collection[str], owners: list[str], kind: str, per: str) -> list[str]:
    if isinstance(of, str):
        of = (of,)
    for name in of:
        if name not in owners:
            examples = ", ".join(owners[:8]) + (" ..." if len(owners) > 8 else "")
            raise InputError(f"unknown {per} {name!r} for a bias of kind {kind}: choose among {examples}")
    return [name for name in owners if name != "" and (not of or name in of)]


def _sigmas(sigma: float | Collection[float], axes: tuple[str, ...], n: int) -> np.ndarray:
    values = np.atleast_1d(np.asarray(sigma, float))
    if len(values) not in (1, len(axes)):
        raise InputError(f"sigma must be one value, or one for each of {', '.join(axes)}; got {len(values)}")
    if not (np.isfinite(values).all() and (values >= 0).all() and values.any()):
        raise InputError(f"sigma must be a standard deviation above zero, got {', '.join(f'{v:g}' for v in values)}")
    return np.tile(np.broadcast_to(values, len(axes)), n)
