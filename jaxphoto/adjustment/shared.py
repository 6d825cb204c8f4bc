"""The parameters that images share, cameras, scanner, mounts and strips: their order, names and priors."""

from collections.abc import Iterable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, parameter_names
from jaxphoto.georeferencing import Mount, Scanner, StripBias
from jaxphoto.unknowns import Prior, Unknowns, Weighted

SCANNER = "l:"
"""Who owns the parameters of the scanner: there is one scanner."""


class _Cameras(Protocol):
    """Cameras of one model."""

    names: tuple[str, ...]


class Entry(NamedTuple):
    """One shared parameter."""

    owner: str
    """Whose it is: `c:kodak`, `m:` a mount, `s:` a strip, or `SCANNER`."""
    label: str
    prior: object


def shared_vector(unknowns: Unknowns, groups: Iterable[_Cameras]) -> list:
    """All shared parameters as a list of scalars: cameras by group, then scanner, mounts, strips."""
    cameras = [leaf for g in groups for name in g.names for leaf in jax.tree.leaves(unknowns.interior[name])]
    mounts = [v for m in unknowns.mounts.values() for v in (*m.lever_arm, *m.boresight, m.time_offset)]
    strips = [v for s in unknowns.strips.values() for v in (*s.shift, *s.drift)]
    scanner = [] if unknowns.scanner is None else [v for vector in scanner_vectors(unknowns.scanner) for v in vector]
    return cameras + scanner + mounts + strips


def scanner_vectors(scanner: Scanner) -> list:
    """Boresight, then the shifts of the lidar strips."""
    return [scanner.boresight, *scanner.shifts.values()]


def shared_entries(block: Block, priors: Unknowns, groups: Iterable[_Cameras]) -> list[Entry]:
    """All shared parameters in the order of `shared_vector`.

    Raises ValueError for a prior that is none.
    """
    entries = []
    for name in (n for g in groups for n in g.names):
        labels = _leaf_names(block.start.unknowns.interior[name])
        leaves = jax.tree.leaves(priors.interior[name], is_leaf=lambda x: isinstance(x, Weighted))
        entries += [
            Entry(f"c:{name}", f"interior[{name}].{label}", leaf) for label, leaf in zip(labels, leaves, strict=True)
        ]
    if priors.scanner is not None:
        vectors: dict[str, tuple[str, ...]] = {"scanner.boresight_{}_rad": ("right", "forward", "up")}
        vectors |= {f"scanner[{name}].shift_{{}}_m": tuple("XYZ") for name in priors.scanner.shifts}
        for (label, axes), prior in zip(vectors.items(), scanner_vectors(priors.scanner), strict=True):
            each = zip(axes, _components(prior), strict=True)
            entries += [_checked(Entry(SCANNER, label.format(axis), prior)) for axis, prior in each]
    for kind, items, names in (("mounts", priors.mounts, _MOUNT), ("strips", priors.strips, _STRIP)):
        for name, item in items.items():
            for label, prior in zip(names, spread(item), strict=True):
                entries.append(_checked(Entry(f"{kind[0]}:{name}", f"{kind}[{name}].{label}", prior)))
    return entries


def _checked(entry: Entry) -> Entry:
    if not isinstance(entry.prior, Prior | Weighted):
        raise ValueError(f"{entry.label}: {entry.prior!r} is no prior; use FREE, FIXED or Weighted")
    return entry


_MOUNT = (
    *(f"lever_arm_{axis}_m" for axis in ("right", "forward", "up")), *(f"boresight_{axis}_rad" for axis in "xyz"),
    "time_offset_s",
)  # fmt: skip
_STRIP = (*(f"shift_{axis}_m" for axis in "XYZ"), *(f"drift_{axis}_m_per_s" for axis in "XYZ"))
MOUNT_SIZE, STRIP_SIZE = len(_MOUNT), len(_STRIP)


def spread(item: Mount | StripBias | Scanner) -> list[object]:
    """One prior per number of a mount's, strip's or scanner's tree of priors."""
    if isinstance(item, Scanner):
        return [p for vector in scanner_vectors(item) for p in _components(vector)]
    if isinstance(item, Mount):
        return [*_components(item.lever_arm), *_components(item.boresight), item.time_offset]
    return [*_components(item.shift), *_components(item.drift)]


def _components(prior: object) -> list[object]:
    if not isinstance(prior, Weighted):
        return [prior] * 3
    traced = any(isinstance(x, jax.core.Tracer) for x in (prior.value, prior.sigma))
    xp: Any = jnp if traced else np
    value, sigma = xp.broadcast_to(prior.value, 3), xp.broadcast_to(prior.sigma, 3)
    return [Weighted(v, s) for v, s in zip(value, sigma, strict=True)]


def _leaf_names(interior: InteriorOrientation) -> list[str]:
    """Parameter names in the order of the tree's leaves; a constant keeps its field's name."""
    estimable = dict(zip(("c", "x_p", "y_p"), parameter_names(interior), strict=False))
    paths = jax.tree_util.tree_flatten_with_path(interior)[0]
    return [estimable.get(path[-1].name, path[-1].name) for path, _ in paths]
