"""Unknowns of an adjustment, and prior information about them.

`Unknowns` is a tree of values; `priors` is the same tree with FREE, FIXED or Weighted(value, sigma) as leaves. "The
second experiment without k_2" is `block.fix("k2")`, or for the tree

    priors = with_prior(priors, "k2", lambda start: FIXED, start)

Interior orientations have scalar leaves. `exterior.position`, `exterior.camera_from_object`, `points`, and each vector
of declared parameters (mounts, strips, scanner, `more`) take one prior for the whole array.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import ArrayLike, from_list, to_numpy
from jaxphoto.camera import (
    CameraRates,
    CameraSpline,
    ImageMotion,
    InteriorOrientation,
    RollingShutter,
    StripCamera,
    ThermalRates,
    get_parameter,
    parameter_names,
    set_parameter,
    table_name,
)
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import FlightBias, Mount, RigCamera, Scanner, ScannerCalibration, StripBias, TrajectoryKnot
from jaxphoto.parameters import AbstractParameters, dynamic_fields
from jaxphoto.short_repr import fields_html, html_of, number_word, numbers_words
from jaxphoto.static_values import ordered

UNKNOWNS: tuple[type[AbstractParameters], ...] = (
    Scanner, Mount, StripBias, FlightBias, CameraRates, ThermalRates, CameraSpline, StripCamera, RollingShutter,
    ImageMotion, RigCamera, ScannerCalibration, TrajectoryKnot,
)  # fmt: skip
"""Classes of declared parameters that a block folder may contain; pass your own classes to `read_block`."""


class Prior:
    """FREE, an unknown without prior information, or FIXED, a constant. Compare with `==`.

    Part of the structure of a tree: JAX does not trace it.
    """

    # NumPy then uses `__eq__` below.
    __array_ufunc__ = None

    def __init__(self, name: str):
        self.name = name

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Prior) and self.name == other.name

    def __hash__(self) -> int:
        return hash((Prior, self.name))

    def __repr__(self) -> str:
        return self.name


# Return a new object each time: `equinox.tree_at` distinguishes nodes of a tree by identity.
jax.tree_util.register_pytree_node(Prior, lambda prior: ((), prior.name), lambda name, _: Prior(name))
FREE, FIXED = Prior("FREE"), Prior("FIXED")


class Weighted(eqx.Module):
    """Unknown with prior `value` and standard deviation `sigma` (its own units, arrays allowed).

    A vector may have a full `covariance` matrix instead: (3, 3), or for positions and points (n, 3, 3), one each. For
    `exterior.camera_from_object` the value is rotation matrices, the sigma refers to small rotations in the camera
    frame (rad). Joint priors of several parameters: `observations.KnownParameters`.
    """

    value: Float[ArrayLike, "..."] | float
    sigma: Float[ArrayLike, "..."] | float
    covariance: Float[ArrayLike, "..."] | None

    def __init__(self, value, sigma=None, *, covariance=None):
        if (sigma is None) == (covariance is None):
            raise ValueError("Weighted needs a value and either its sigma or its covariance")
        self.value, self.covariance = value, covariance
        self.sigma = sigma if covariance is None else np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))

    def __repr__(self) -> str:
        return f"Weighted({number_word(self.value)}, sigma {number_word(self.sigma)})"

    _repr_html_ = fields_html


class Unknowns(eqx.Module):
    """Parameters of a block: per camera, image, point, mount and strip; and of a laser scanner.

    `exterior` has a leading axis over the images and `points` (m) over the points of the block, in its order. `more`
    contains further declared parameters (`jaxphoto.parameters`) by kind and owner, `{"camera_rates": {"kodak":
    rates}}`. The owner of parameters of the whole block is "".
    """

    interior: dict[str, InteriorOrientation] = eqx.field(converter=ordered)
    exterior: ExteriorOrientation
    points: Float[ArrayLike, "points 3"] = eqx.field(converter=from_list)
    mounts: dict[str, Mount] = eqx.field(converter=ordered)
    strips: dict[str, StripBias] = eqx.field(converter=ordered)
    scanner: Scanner | None = None
    more: dict[str, dict[str, AbstractParameters]] = eqx.field(default_factory=dict, converter=ordered)

    @property
    def words(self) -> dict[str, str]:
        """Return shared parameters, or their priors, by owner: {"camera kodak": "c_mm 34.25, xp_mm FIXED ..."}."""
        told = {
            f"camera {camera}": numbers_words({name: get_parameter(own, name) for name in parameter_names(own)})
            for camera, own in self.interior.items()
        }
        for kind, owners in self.tables.items():
            for owner, own in owners.items():
                numbers = {name: getattr(own, name) for name in dynamic_fields(type(own))}
                told[f"{kind} {owner}".strip()] = numbers_words(numbers)
        return told

    @property
    def _all_words(self) -> dict[str, str]:
        whole = {name: number_word(of(self)) for name, of in _WHOLE.items()}
        return self.words | whole

    def __repr__(self) -> str:
        return "Unknowns\n" + "\n".join(f"  {name}: {words}" for name, words in self._all_words.items())

    def _repr_html_(self) -> str:
        return html_of("Unknowns", self._all_words)

    @property
    def tables(self) -> dict[str, dict[str, Any]]:
        """Declared parameters (or their priors), by kind and owner."""
        scanner: dict[str, dict[str, Any]] = {} if self.scanner is None else {"scanner": {"": self.scanner}}
        return scanner | {"mounts": self.mounts, "strips": self.strips} | self.more

    def with_tables(self, tables: dict[str, dict[str, Any]]) -> "Unknowns":
        """Replace the declared parameters of all kinds."""
        own = dict(tables)
        scanner, mounts, strips = own.pop("scanner", {"": None})[""], own.pop("mounts"), own.pop("strips")
        return Unknowns(self.interior, self.exterior, self.points, mounts, strips, scanner, own)

    def in_order_of(self, like: "Unknowns") -> "Unknowns":
        """Sort cameras and owners as in `like`, to which the indices of observations refer.

        JAX sorts the keys of dictionaries that it flattens and unflattens.
        """
        interior = {name: self.interior[name] for name in like.interior}
        own = self.tables
        tables = {kind: {name: own[kind][name] for name in owners} for kind, owners in like.tables.items()}
        return dataclasses.replace(self, interior=interior).with_tables(tables)


def is_prior(tree: Any) -> bool:
    """Return True if a node of a tree of priors is a leaf."""
    return isinstance(tree, Prior | Weighted)


def check_prior(label: str, prior: Any) -> None:
    """Raise InputError, naming the parameter, unless `prior` is a prior."""
    if not is_prior(prior):
        given = " ".join(repr(prior).split())
        raise InputError(
            f"{label}: {given:.80} is not a prior; use FREE, FIXED (at the start value) or Weighted(value, sigma)"
        )


def late_cameras(start: Unknowns, priors: Unknowns) -> list[str]:
    """Return cameras of a rig whose delay is nonzero or not fixed: these need the motion of the rig.

    Raises InputError for a delay without a prior.
    """
    late, own = [], RigCamera.kind
    for name, camera in start.more.get(own, {}).items():
        prior = priors.more[own][name].delay  # type: ignore[attr-defined]
        check_prior(f"{own}[{name}].delay_s", prior)
        delay: Any = camera.delay  # type: ignore[attr-defined]
        if prior != FIXED or (not isinstance(delay, jax.core.Tracer) and np.any(delay != 0)):
            late.append(name)
    return late


def uniform_priors(unknowns: Unknowns, prior: Prior) -> Unknowns:
    """Return a tree of priors with the structure of `unknowns`, `prior` everywhere."""
    return jax.tree.map(lambda _: prior, unknowns)


def default_priors(unknowns: Unknowns) -> Unknowns:
    """Return priors: exterior orientation and object points FREE, all other parameters FIXED."""
    priors = uniform_priors(unknowns, FIXED)
    places = lambda u: (u.exterior.position, u.exterior.camera_from_object, u.points)  # noqa: E731
    return eqx.tree_at(places, priors, (FREE, FREE, FREE))


def weighted(name: str, start: Any, value: Any, sigma: Any) -> Weighted:
    """Return the prior of a parameter that was observed as `value` with `sigma`; arrays have the shape of its `start`.

    Raises InputError, which names the parameter, for invalid values.
    """
    shape, turns = np.shape(start), np.ndim(start) > 2
    for what, given, whole in (("value", value, shape), ("sigma", sigma, shape[:-1] if turns else shape)):
        known = to_numpy(given)
        if isinstance(known, jax.core.Tracer):
            continue
        if known.dtype.kind not in "iuf" or not np.isfinite(known).all():
            raise InputError(f"{name}: its {what} is {' '.join(str(given).split()):.60}: give a finite number")
        if what == "sigma" and (bad := known[known <= 0]).size:
            raise InputError(
                f"{name}: its sigma is {bad[0]:g}: give a positive one, or fix the parameter with fix({name!r})"
            )
        if known.shape != whole[len(whole) - known.ndim :]:
            more = f", or an array of the shape {whole}" if whole else ""
            raise InputError(f"{name}: its {what} is an array of the shape {known.shape}: give one number{more}")
    return Weighted(value, sigma)


# Parameters with one prior for all images or all points, by their names in `with_prior`.
_WHOLE: dict[str, Callable[[Unknowns], Any]] = {
    "position": lambda u: u.exterior.position,
    "rotation": lambda u: u.exterior.camera_from_object,
    "points": lambda u: u.points,
}


def with_prior(
    priors: Unknowns, name: str, prior_of: Callable[[Any], Any], start: Unknowns, of: str | None = None
) -> Unknowns:
    """Return `priors` with a new prior of the parameter `name`; `prior_of` computes it from the value in `start`.

    Names are the names of the interior orientation (`c` or `c_mm`, `k1` ...), the fields of declared parameters
    (`lever_arm`, `boresight`, `shift` ...), and `position`, `rotation` and `points` for all images and points. `of` is
    the owner, such as a camera or a strip; by default all owners of the parameter. Raises InputError if no owner has
    it.
    """
    if name in _WHOLE and of is not None:
        raise InputError(f"{name} has one prior for the whole block, not one of {of!r}: omit the owner")
    if name in _WHOLE:
        return eqx.tree_at(_WHOLE[name], priors, prior_of(_WHOLE[name](start)))
    known, label = [], table_name(name)
    interior, tables, done = dict(priors.interior), priors.tables, False
    for camera, own in interior.items():
        known += [(camera, one) for one in parameter_names(own)]
        if (camera, label) in known[-len(parameter_names(own)) :] and of in (None, camera):
            interior[camera] = set_parameter(own, label, prior_of(get_parameter(start.interior[camera], label)))
            done = True
    for kind, owners in tables.items():
        changed = dict(owners)
        for owner, own in owners.items():
            fields = dynamic_fields(type(own))
            known += [(owner, one) for one in fields]
            if name in fields and of in (None, owner):
                changed[owner] = dataclasses.replace(own, **{name: prior_of(getattr(start.tables[kind][owner], name))})
                done = True
        tables[kind] = changed
    if not done:
        whose = "" if of is None else f" of {of!r}"
        there = [one for owner, one in known if of in (None, owner)]
        if known and not there:
            raise InputError(
                f"unknown parameter owner {of!r}; use one of {', '.join(dict.fromkeys(o for o, _ in known))}"
            )
        raise InputError(
            f"unknown parameter {name!r}{whose}; choose among {', '.join(dict.fromkeys([*there, *_WHOLE]))}"
        )
    return dataclasses.replace(priors, interior=interior).with_tables(tables)
