"""Shared parameters (of cameras and declared ones): order, names and priors."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxphoto.arrays import ArrayLike, is_traced
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.parameters import dynamic_fields, filled, form_of, leaves_in_order, numbers_of, size_of, unit_of
from jaxphoto.unknowns import Unknowns, Weighted, check_prior


class ParameterTable(eqx.Module):
    """Declared parameters of one kind: one row per owner."""

    kind: str = eqx.field(static=True)
    owners: tuple[str, ...] = eqx.field(static=True)
    form: Any = eqx.field(static=True)
    """Constructor argument of `parameters.filled`."""
    offset: int = eqx.field(static=True)
    """Index of the first parameter in the vector of shared parameters."""
    size: int = eqx.field(static=True)
    modifies_interior: bool = eqx.field(static=True)
    """True if the parameters modify the interior orientation of their images."""
    units: tuple[str, ...] = eqx.field(static=True)
    """Unit suffix of each parameter name; "" if it has none."""
    of_images: bool = eqx.field(static=True)
    """True if the parameters belong to images."""
    of_image: Int[np.ndarray, "images"]
    """Owner of each image; the number of owners if it has none."""

    def numbers_at(self, owner: np.ndarray, nowhere: int) -> Int[np.ndarray, "size n"]:
        """Return the indices of the parameters of owners; `nowhere` if there is none."""
        own = self.offset + self.size * owner + np.arange(self.size)[:, None]
        return np.where(owner < len(self.owners), own, nowhere)

    def all_owners(self, shared: Array) -> Any:
        """Return the parameters of all owners along the last axis, followed by zeros for a missing owner."""
        numbers = shared[self.offset : self.offset + self.size * len(self.owners)].reshape(-1, self.size)
        return filled(self.form, jnp.concatenate([numbers, jnp.zeros((1, self.size))]).T)


class SharedParameter(NamedTuple):
    """One shared parameter."""

    owner: str
    """Owner, unique over all kinds: `c:kodak`, `mounts:NAME`, `strips:NAME`."""
    label: str
    prior: object


class JointPrior(NamedTuple):
    """Prior with a full covariance matrix. `parameters` are indices into the vector of shared parameters."""

    parameters: np.ndarray
    value: Any
    covariance: Any


def tables_of(block: Block, unknowns: Unknowns, offset: int) -> tuple[ParameterTable, ...]:
    """Return the declared parameters of a block in order: parameters that modify cameras, parameters that rows at
    points involve, others.
    """
    met = {kind for rows in block.observations if "image" not in dict(rows.indices()) for kind in rows.block_parameters}
    given = [(kind, owners) for kind, owners in unknowns.tables.items() if owners]

    def rank(item: tuple[str, dict]) -> int:
        kind, owners = item
        return 0 if next(iter(owners.values())).modifies_interior else 1 if kind in met or kind == "scanner" else 2

    tables = []
    for kind, owners in sorted(given, key=rank):
        first = next(iter(owners.values()))
        form = form_of(first)
        place = {name: k for k, name in enumerate(owners)}
        of_image = np.array([place.get(name, len(place)) for name in block.owners(first.owner)], np.int32)
        units = tuple(unit_of(label) for label in first.labels(""))
        some = bool((of_image < len(place)).any())
        tables.append(
            ParameterTable(
                kind, tuple(owners), form, offset, size_of(form), bool(first.modifies_interior), units, some, of_image
            )
        )
        offset += tables[-1].size * len(owners)
    return tuple(tables)


def shared_vector(unknowns: Unknowns, cameras: Iterable[str], tables: Sequence[ParameterTable]) -> list:
    """Return all shared parameters as a list of scalars: cameras first, then declared parameters."""
    of_cameras = [leaf for name in cameras for leaf in jax.tree.leaves(unknowns.interior[name])]
    known = unknowns.tables
    return of_cameras + [v for t in tables for name in t.owners for v in numbers_of(known[t.kind][name])]


def unknowns_from(shared: ArrayLike, like: Unknowns, tables: Sequence[ParameterTable]) -> Unknowns:
    """Replace the declared parameters of `like` by the values in the vector of shared parameters."""
    found: dict[str, dict[str, Any]] = {kind: {} for kind in like.tables}
    for t in tables:
        for k, name in enumerate(t.owners):
            own = shared[t.offset + k * t.size : t.offset + (k + 1) * t.size]
            found[t.kind][name] = filled(form_of(like.tables[t.kind][name]), own)
    return like.with_tables({kind: {name: found[kind][name] for name in of} for kind, of in like.tables.items()})


def shared_entries(
    block: Block, priors: Unknowns, cameras: Iterable[str], tables: Sequence[ParameterTable]
) -> tuple[list[SharedParameter], list[JointPrior]]:
    """Return all shared parameters in the order of `shared_vector`, and joint priors.

    Raises InputError for an invalid prior and for an incomplete tree of priors.
    """
    entries: list[SharedParameter] = []
    together: list[JointPrior] = []
    for name in cameras:
        interior = block.start.unknowns.interior[name]
        treedef: Any = jax.tree.structure(interior)
        labels, leaves = _leaf_names(interior), treedef.flatten_up_to(priors.interior[name])
        for label, prior in zip(labels, leaves, strict=True):
            entries.append(_checked(SharedParameter(f"c:{name}", f"interior[{name}].{label}", prior)))
    for t in tables:
        for name in t.owners:
            known: Any = block.start.unknowns.tables[t.kind][name]
            given: Any = priors.tables.get(t.kind, {}).get(name)
            if type(given) is not type(known):
                found = "lack" if given is None else f"have {type(given).__name__} for"
                raise InputError(
                    f"the priors {found} {t.kind}[{name}], which the start values have: "
                    f"give a {type(known).__name__} of priors"
                )
            labels = iter(known.labels(name))
            for prior, value in zip(_leaves(given, known), leaves_in_order(known), strict=True):
                own = [next(labels) for _ in range(np.size(value))]
                if isinstance(prior, Weighted) and prior.covariance is not None:
                    together.append(JointPrior(len(entries) + np.arange(len(own)), prior.value, prior.covariance))
                entries += [
                    _checked(SharedParameter(f"{t.kind}:{name}", label, each))
                    for label, each in zip(own, _components(prior, len(own)), strict=True)
                ]
    return entries, together


def scalar_priors(priors: Any, like: Any) -> list:
    """Return the prior of each scalar of the declared parameters `like`."""
    pairs = zip(_leaves(priors, like), leaves_in_order(like), strict=True)
    return [each for prior, value in pairs for each in _components(prior, np.size(value))]


def _leaves(priors: Any, like: Any) -> list:
    """Return the priors of parameters, one per field (or dict entry) of `like`."""
    found = []
    for name in dynamic_fields(type(like)):
        prior, value = getattr(priors, name), getattr(like, name)
        found += [prior[key] for key in value] if isinstance(value, dict) else [prior]
    return found


def _checked(entry: SharedParameter) -> SharedParameter:
    check_prior(entry.label, entry.prior)
    return entry


def _components(prior: object, n: int) -> list[object]:
    """Return one prior for each of `n` scalars."""
    if not isinstance(prior, Weighted):
        return [prior] * n
    traced = is_traced((prior.value, prior.sigma))
    xp: Any = jnp if traced else np
    value, sigma = xp.broadcast_to(prior.value, n), xp.broadcast_to(prior.sigma, n)
    return [Weighted(v, s) for v, s in zip(value, sigma, strict=True)]


def _leaf_names(interior: InteriorOrientation) -> list[str]:
    """Return parameter names in the order of the tree's leaves; constants use the name of their field."""
    estimable = dict(zip(("c", "xp", "yp"), parameter_names(interior), strict=False))
    paths = jax.tree_util.tree_flatten_with_path(interior)[0]
    return [estimable.get(path[-1].name, path[-1].name) for path, _ in paths]
