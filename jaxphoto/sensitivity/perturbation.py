"""What is drawn in a Monte Carlo: errors of observations and of parameters that the adjustment holds.

A perturbation is any function of a key and a block that returns the block with other numbers in it, alone or with a
dict of numbers to record:

    def perturb(key, block):
        rise = 0.1 * jax.random.normal(key)
        heights = block.stations.value + rise * (block.stations.axis == 2)
        return eqx.tree_at(lambda b: b.stations.value, block, heights), {"rise_m": rise}

`bias` makes the usual ones.
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
from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.observations import Correlated, KnownParameters
from jaxphoto.rotation import small_rotation
from jaxphoto.sensitivity.biased_numbers import LABELS, TRAJECTORY, observed_numbers, trajectory_numbers
from jaxphoto.short_repr import shown
from jaxphoto.unknowns import FIXED, FREE, Weighted, is_prior

Recorded = dict[str, Array]
Perturbation = Callable[[Any, Block], Block | tuple[Block, Recorded]]
Distribution = Callable[[Any, tuple[int, ...]], Array]
"""Numbers of mean 0 and standard deviation 1 from a key and a shape."""

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
"""Kinds of bias, and whose own each may be."""
_AXES = {"lever-arm": ("right_m", "forward_m", "up_m"), "boresight": ("x_rad", "y_rad", "z_rad")}


@shown
class Bias(eqx.Module):
    """Errors added to some numbers of a block: `sigma` times independent draws of `distribution`.

    Called with a key and a block it is a perturbation; `applied` adds given numbers.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    """Of the errors drawn, such as `E1.X_m`; angles in rad."""
    sigma: Float[np.ndarray, "errors"]
    """In the units of the names."""
    targets: tuple[tuple[Any, ...], ...] = eqx.field(static=True)
    """Paths, from the block, of the arrays that the errors are added to."""
    index: tuple[Int[np.ndarray, "..."], ...]
    """The error that each number of these arrays gets; the number of errors where it gets none."""
    distribution: Distribution = eqx.field(static=True, default=jax.random.normal)
    recorded: bool = eqx.field(static=True, default=True)
    """Whether each error is worth a record of its own."""
    mixed: tuple[Float[np.ndarray, "_ _ _"] | None, ...] = ()
    """Of arrays that get no error as drawn, L (sets, n, n), which makes theirs of those drawn: of correlated errors
    that of their covariance L L'."""

    def __call__(self, key, block: Block) -> tuple[Block, Recorded]:
        """`block` with errors drawn by `key`, and the errors by name."""
        errors = self.drawn(key)
        return self.applied(errors, block), dict(zip(self.names, errors, strict=True)) if self.recorded else {}

    def drawn(self, key) -> Float[Array, "errors"]:
        """The errors that a key draws."""
        return jnp.asarray(self.sigma) * self.distribution(key, self.sigma.shape)

    def applied(self, errors: Float[Array, "errors"], block: Block) -> Block:
        """`block` with given errors, in the order of `names`."""
        added = jnp.append(errors, 0.0)
        where = lambda b: [_follow(b, path) for path in self.targets]  # noqa: E731
        mixed = self.mixed or (None,) * len(self.targets)
        new = [
            _with_errors(v, added[k] if factor is None else jnp.einsum("nij,nj->ni", factor, added[k]))
            for v, k, factor in zip(where(block), self.index, mixed, strict=True)
        ]
        return in_order_of(block, eqx.tree_at(where, block, new))


def in_order_of(block: Block, changed: Block) -> Block:
    """`changed` with its unknowns in the order that they have in `block`."""
    start = dataclasses.replace(changed.start, unknowns=changed.start.unknowns.in_order_of(block.start.unknowns))
    return dataclasses.replace(changed, start=start, priors=changed.priors.in_order_of(block.priors))


def _with_errors(values: Any, errors: Array) -> Array:
    """Numbers with errors added; rotation matrices turned by them, small rotations."""
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
    """Errors of one kind, independent for each axis and each strip, image, point, mount or camera.

    `kind` is one of `PER`, `per` one of what it lists there (its first if not given). `sigma`: m for stations, control
    and lever arms; rad for attitudes and boresights; mm for image points; own units for the interior `parameter`
    (`c_mm`, `k1` ...); one, or one an axis. `of` names those that get errors, all if empty. Lever arms, boresights and
    interior parameters must be FIXED (the value that is held changes) or Weighted (the value given beforehand changes).

    Errors of `station` and `attitude` are those of exposures alone. `trajectory` (m) and `trajectory-attitude` (rad,
    about right, forward and up) are what the trajectory of a laser scanner is off by, of the whole flight or of each
    laser strip: its returns and the exposures on it have them alike (`sensitivity.biased_numbers`).

    Raises InputError for a kind, a name or a sigma that cannot be.
    """
    if kind not in PER:
        raise InputError(f"there is no bias of kind {kind!r}; there are {', '.join(PER)}")
    per = PER[kind][0] if per is None else per
    if per not in PER[kind]:
        raise InputError(f"a bias of kind {kind} is drawn per {' or '.join(PER[kind])}, not per {per}")
    if (parameter != "") != (kind == "interior"):
        raise InputError("a bias of kind interior, and no other, needs the name of a parameter, such as c_mm")
    if kind in ("lever-arm", "boresight", "interior"):
        return _parameters(block, kind, sigma, of, parameter, distribution)
    axes = LABELS[kind]
    places = (trajectory_numbers if kind in TRAJECTORY else observed_numbers)(block, kind, per)
    known = list(dict.fromkeys(name for place in places for name in place.owner))
    if not known:
        raise InputError(f"the block {block.title!r} has no observation that a bias of kind {kind} could be added to")
    if known == [""]:
        raise InputError(f"the images of the block {block.title!r} belong to no {per}: name it in images.csv")
    chosen = _chosen(of, known, kind, per)
    first = {name: len(axes) * k for k, name in enumerate(chosen)}
    indices = []
    for place in places:
        index = np.array([first.get(name, -1) for name in place.owner], int)
        index = np.where(index < 0, len(axes) * len(chosen), index + place.axis)
        indices.append(index if place.factor is None else index.reshape(-1, 3))
    names = tuple(f"{name}.{label}" for name in chosen for label in axes)
    own = per != "observation"
    paths, mixed = tuple(place.path for place in places), tuple(place.factor for place in places)
    return Bias(names, _sigmas(sigma, axes, len(chosen)), paths, tuple(indices), distribution, own, mixed)


class _Noisy(NamedTuple):
    """Where observed numbers are, their standard deviations, and what mixes errors of unit size if correlated."""

    path: tuple[Any, ...]
    sigma: np.ndarray
    mixed: np.ndarray | None = None


def noise(block: Block) -> Bias:
    """Errors of all observations and of all values given beforehand, each with its own standard deviation.

    It is what the covariance of the block is about. Raises InputError for a value given beforehand as one for several
    numbers.
    """
    parts = [part for part in (*_observed(block), *_weighted(block)) if np.size(part.sigma)]
    starts = np.cumsum([0, *(np.size(part.sigma) for part in parts)])
    names = tuple(f"{'.'.join(map(str, part.path))}.{k}" for part in parts for k in range(np.size(part.sigma)))
    index = tuple(
        np.asarray(start + np.arange(np.size(part.sigma)).reshape(np.shape(part.sigma)))
        for start, part in zip(starts, parts, strict=False)
    )
    sigma = np.concatenate([np.ravel(part.sigma) for part in parts])
    mixed = tuple(part.mixed for part in parts)
    return Bias(names, sigma, tuple(part.path for part in parts), index, recorded=False, mixed=mixed)


def _observed(block: Block) -> Iterator[_Noisy]:
    """All observations, wherever the block holds them."""
    own = (block.image_points, *block.observations)
    places: list[tuple[tuple[Any, ...], Any]] = [((f.name,), getattr(block, f.name)) for f in dataclasses.fields(block)]
    places += [(("more", k), rows) for k, rows in enumerate(block.more)]
    for path, rows in places:
        if isinstance(rows, KnownParameters):
            yield _correlated((*path, "value"), rows.covariance[None])
        elif isinstance(rows, Correlated):
            yield _correlated((*path, "rows", rows.rows.observed), rows.covariance)
        elif any(rows is other for other in own):
            yield _Noisy((*path, rows.observed), np.asarray(rows.sigmas))


def _correlated(path: tuple[Any, ...], covariance: Any) -> _Noisy:
    factor = np.linalg.cholesky(np.asarray(covariance))
    return _Noisy(path, np.ones(factor.shape[:2]), factor)


def _weighted(block: Block) -> Iterator[_Noisy]:
    """Values given beforehand."""
    paths = jax.tree_util.tree_leaves_with_path(block.priors, is_leaf=is_prior)
    known = block.start.unknowns
    for keys, prior in paths:
        if isinstance(prior, Weighted):
            path = tuple(getattr(key, "name", getattr(key, "key", None)) for key in keys)
            value = _follow(known, path)
            if np.shape(prior.value) != np.shape(value):
                raise InputError(
                    f"{_label(path)} is known beforehand by one value for {np.size(value)} numbers: give each its own"
                )
            rotations = path[-1] == "camera_from_object"
            shape = (*np.shape(value)[:-1],) if rotations else np.shape(value)
            if prior.covariance is None:
                yield _Noisy(("priors", *path, "value"), np.broadcast_to(prior.sigma, shape))
            else:
                sets = (int(np.prod(shape[:-1], dtype=int)), 3, 3)
                yield _correlated(("priors", *path, "value"), np.broadcast_to(prior.covariance, sets))


def _label(path: tuple[Any, ...]) -> str:
    """Such as "shift of a" and "exterior.position"."""
    return (
        f"{path[-1]} of {path[-2]}" if path[0] in ("mounts", "strips", "scanner", "more") else ".".join(map(str, path))
    )


def _parameters(block: Block, kind: str, sigma, of: Collection[str], parameter: str, distribution: Distribution):
    unknowns, priors = block.start.unknowns, block.priors
    table: Any = unknowns.interior if kind == "interior" else unknowns.mounts
    of_priors: Any = priors.interior if kind == "interior" else priors.mounts
    if not table:
        raise InputError(f"the block {block.title!r} has no mount that a bias of kind {kind} could be added to")
    chosen = _chosen(of, list(table), kind, PER[kind][0])
    field = {"lever-arm": "lever_arm", "boresight": "boresight", "interior": parameter}[kind]
    axes = (parameter,) if kind == "interior" else tuple(f"{field}_{a}" for a in _AXES[kind])
    targets = []
    for name in chosen:
        if kind == "interior" and parameter not in parameter_names(table[name]):
            known = ", ".join(parameter_names(table[name]))
            raise InputError(f"camera {name} has no parameter {parameter!r}; it has {known}")
        prior = _leaf(of_priors[name], field)
        if prior == FREE:
            raise InputError(
                f"{field} of {name} is free, so the adjustment does not take the value that a bias changes"
            )
        at = ("start", "unknowns") if prior == FIXED else ("priors",)
        if prior != FIXED and np.shape(prior.value) != (() if kind == "interior" else (3,)):
            raise InputError(f"{field} of {name} is known beforehand by one value for three axes: give it three")
        path = (*at, "interior" if kind == "interior" else "mounts", name, field)
        targets.append(path if prior == FIXED else (*path, "value"))
    index = tuple(len(axes) * k + np.arange(len(axes)) for k in range(len(chosen)))
    names = tuple(f"{name}.{axis}" for name in chosen for axis in axes)
    return Bias(names, _sigmas(sigma, axes, len(chosen)), tuple(targets), index, distribution)


def _follow(tree: Any, path: tuple[Any, ...]) -> Any:
    """The leaf at a path of fields, keys, numbers and names of interior parameters."""
    for step in path:
        tree = tree[step] if isinstance(tree, dict | tuple) else _leaf(tree, step)
    return tree


def _leaf(tree: Any, name: str) -> Any:
    """A field, or a parameter of a camera by its name."""
    named = isinstance(tree, InteriorOrientation) and not hasattr(tree, name)
    return get_parameter(tree, name) if named else getattr(tree, name)


def _chosen(of: Collection[str], known: list[str], kind: str, per: str) -> list[str]:
    if isinstance(of, str):
        of = (of,)
    for name in of:
        if name not in known:
            some = ", ".join(known[:8]) + (" ..." if len(known) > 8 else "")
            raise InputError(
                f"there is no {per} {name!r} that a bias of kind {kind} could be added to; there are {some}"
            )
    return [name for name in known if name != "" and (not of or name in of)]


def _sigmas(sigma: float | Collection[float], axes: tuple[str, ...], n: int) -> np.ndarray:
    given = np.atleast_1d(np.asarray(sigma, float))
    if len(given) not in (1, len(axes)):
        raise InputError(f"sigma is one number, or one for each of {', '.join(axes)}; got {len(given)}")
    if not (np.isfinite(given).all() and (given >= 0).all() and given.any()):
        raise InputError(f"sigma is a standard deviation above zero, got {', '.join(f'{v:g}' for v in given)}")
    return np.tile(np.broadcast_to(given, len(axes)), n)
