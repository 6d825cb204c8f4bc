"""The structure of a block's normal equations: who meets whom, made once on the host as index arrays.

    unknowns    eop (6 per image: X, Y, Z, small rotation), shared (interior orientation, mounts, strips; only what
                is not FIXED), points (3 per point)
    colours     each image touches few shared unknowns; unknowns of different cameras, mounts or strips carry the
                same colour, so one seed differentiates all of them at once
    pairs       two image rows of one point fill one 6 x 6 block of the reduced normal matrix; the list is sorted
                by block, so the sum over points is a sorted segment sum

All arrays are arguments of the compiled functions, never constants in them: a new block of the same shapes
compiles nothing.
"""

import dataclasses
from collections.abc import Iterable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment.lists import check_rows, chunks_of, pairs_of, point_classes, rows_by_image
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, parameter_names
from jaxphoto.georeferencing import Corrections, Mount, StripBias
from jaxphoto.unknowns import FIXED, Prior, Unknowns, Weighted


class CameraGroup(eqx.Module):
    """Cameras of one model: their parameters are rows of one table, so one `vmap` serves them all."""

    names: tuple[str, ...] = eqx.field(static=True)
    treedef: jax.tree_util.PyTreeDef = eqx.field(static=True)
    offset: int = eqx.field(static=True)
    camera: Int[np.ndarray, "rows"]
    """Camera (within the group) of each of the group's image rows."""
    free_leaves: tuple[int, ...] = eqx.field(static=True)
    rows: Int[np.ndarray, "rows"] | None
    """The group's image rows, or None where there is one group and they are all rows."""


class Structure(eqx.Module):
    """Index arrays and sizes; see the module's head."""

    groups: tuple[CameraGroup, ...]
    mount_offset: int = eqx.field(static=True)
    strip_offset: int = eqx.field(static=True)
    n_images: int = eqx.field(static=True)
    n_points: int = eqx.field(static=True)
    corrections: Corrections = eqx.field(static=True)
    n_image_colours: int = eqx.field(static=True)
    n_colours: int = eqx.field(static=True)
    n_classes: int = eqx.field(static=True)
    unsort: Int[np.ndarray, "rows"] | None
    image: Int[np.ndarray, "rows"]
    point: Int[np.ndarray, "rows"]
    pair_a: Int[np.ndarray, "pairs"]
    pair_b: Int[np.ndarray, "pairs"]
    pair_block: Int[np.ndarray, "pairs"]
    image_rows: Int[np.ndarray, "images most"]
    """Image rows of each image, padded with the number of rows."""
    image_points: Int[np.ndarray, "images most"]
    """Their points."""
    chunk_a: Int[np.ndarray, "chunks size"]
    chunk_b: Int[np.ndarray, "chunks size"]
    chunk_block: Int[np.ndarray, "chunks"]
    block_row: Int[np.ndarray, "blocks"]
    block_column: Int[np.ndarray, "blocks"]
    free: Int[np.ndarray, "shared"]
    """Index, in the vector of all shared parameters, of each shared unknown."""
    column: Int[np.ndarray, "images colours"]
    """Shared unknown that a colour means for an image; the number of shared unknowns where it means none."""
    colour: Int[np.ndarray, "shared"]
    mount: Int[np.ndarray, "images"]
    strip: Int[np.ndarray, "images"]
    station_image: Int[np.ndarray, "stations"]
    station_axis: Int[np.ndarray, "stations"]
    attitude_image: Int[np.ndarray, "attitudes"]
    control_point: Int[np.ndarray, "control"]
    control_axis: Int[np.ndarray, "control"]
    distance_points: Int[np.ndarray, "distances 2"]
    point_class: Int[np.ndarray, "points"]
    weighted: Int[np.ndarray, "weighted"]
    """Shared unknown of each weighted prior."""
    eop_free: Float[np.ndarray, "6 images"]
    point_free: Float[np.ndarray, "3 points"]
    labels: tuple[str, ...] = eqx.field(static=True)
    """Parameter path of each shared unknown, such as `interior[kodak].c_mm`."""

    @property
    def n_shared(self) -> int:
        """Number of shared unknowns."""
        return len(self.free)


def shared_vector(unknowns: Unknowns, groups: tuple[CameraGroup, ...]) -> list:
    """All shared parameters as a list of scalars: cameras by group, then mounts, then strips."""
    cameras = [leaf for g in groups for name in g.names for leaf in jax.tree.leaves(unknowns.interior[name])]
    mounts = [v for m in unknowns.mounts.values() for v in (*m.lever_arm, *m.boresight, m.time_offset)]
    strips = [v for s in unknowns.strips.values() for v in (*s.shift, *s.drift)]
    return cameras + mounts + strips


def interior_of(group: CameraGroup, table) -> InteriorOrientation:
    """The group's interior orientations from its table of parameters, one column a parameter."""
    return jax.tree.unflatten(group.treedef, table)


def structure_of(block: Block, priors: Unknowns) -> Structure:
    """Everything about the adjustment of `block` that does not depend on a measured value."""
    image, point = np.asarray(block.image_points.image), np.asarray(block.image_points.point)
    check_rows(image, point)
    camera_names = np.array(block.image_camera)

    groups, unsort = _groups(block, camera_names[image])
    entries = _shared_entries(block, priors, groups)
    mount_offset = sum(len(g.names) * g.treedef.num_leaves for g in groups)
    free = np.array([k for k, e in enumerate(entries) if e.prior is not FIXED], dtype=np.int32)
    ranks: dict[str, int] = {}
    owners, colour = [], np.zeros(len(free), np.int32)
    for j, k in enumerate(free):
        owner = entries[k].owner
        colour[j] = ranks[owner] = ranks.get(owner, -1) + 1
        owners.append(owner)
    counts = [max((ranks[o] + 1 for o in ranks if o.startswith(kind)), default=0) for kind in ("c:", "m:", "s:")]
    base = {"c": 0, "m": counts[0], "s": counts[0] + counts[1]}
    colour += np.array([base[o[0]] for o in owners], np.int32) if owners else colour
    groups = tuple(_with_free(g, free) for g in groups)
    column = np.full((len(block.images), sum(counts)), len(free), np.int32)
    of_owner: dict[str, list[int]] = {}
    for j, o in enumerate(owners):
        of_owner.setdefault(o, []).append(j)
    for names, kind in ((block.image_camera, "c:"), (block.image_mount, "m:"), (block.image_strip, "s:")):
        for i, name in enumerate(names):
            for j in of_owner.get(kind + name, ()):
                column[i, colour[j]] = j

    pairs = pairs_of(image, point)
    point_free = np.ones((3, len(block.points))) * (priors.points is not FIXED)
    point_free[block.fixed.axis, block.fixed.who] = 0.0
    eop_free = np.ones((6, len(block.images)))
    eop_free[:3] *= priors.exterior.position is not FIXED
    eop_free[3:] *= priors.exterior.camera_from_object is not FIXED
    classes = point_classes(np.asarray(block.distances.points), len(block.points))
    return Structure(
        groups=groups,
        mount_offset=mount_offset,
        strip_offset=mount_offset + MOUNT_SIZE * len(priors.mounts),
        n_images=len(block.images),
        n_points=len(block.points),
        corrections=block.corrections,
        n_image_colours=counts[0],
        n_colours=sum(counts),
        n_classes=int(classes.max(initial=0)) + 1,
        unsort=unsort,
        image=image.astype(np.int32),
        point=point.astype(np.int32),
        pair_a=pairs[0],
        pair_b=pairs[1],
        pair_block=pairs[2],
        **rows_by_image(image, point, len(block.images), len(image)),
        **chunks_of(pairs[:3], len(image)),
        block_row=pairs[3],
        block_column=pairs[4],
        free=free,
        column=column,
        colour=colour,
        mount=_index(block.image_mount, priors.mounts),
        strip=_index(block.image_strip, priors.strips),
        station_image=np.asarray(block.stations.who, np.int32),
        station_axis=np.asarray(block.stations.axis, np.int32),
        attitude_image=np.asarray(block.attitudes.image, np.int32),
        control_point=np.asarray(block.control.who, np.int32),
        control_axis=np.asarray(block.control.axis, np.int32),
        distance_points=np.asarray(block.distances.points, np.int32).reshape(-1, 2),
        point_class=classes,
        weighted=np.array([j for j, k in enumerate(free) if isinstance(entries[k].prior, Weighted)], np.int32),
        eop_free=eop_free,
        point_free=point_free,
        labels=tuple(entries[k].label for k in free),
    )


def _index(names: tuple[str, ...], table: Iterable[str]) -> np.ndarray:
    """Place of each name in the table; one past the end where the table lacks it."""
    place = {name: k for k, name in enumerate(table)}
    return np.array([place.get(n, len(place)) for n in names], np.int32)


class _Entry(eqx.Module):
    """One shared parameter: whose it is (`c:kodak`), what it is called, its prior."""

    owner: str
    label: str
    prior: object


def _is_prior(x: object) -> bool:
    return isinstance(x, Weighted)


def _groups(block: Block, row_camera: np.ndarray) -> tuple[tuple[CameraGroup, ...], np.ndarray | None]:
    by_model: dict[jax.tree_util.PyTreeDef, list[str]] = {}
    for name, interior in block.start.unknowns.interior.items():
        by_model.setdefault(jax.tree.structure(interior), []).append(name)
    groups, offset, sequence = [], 0, []
    for treedef, names in by_model.items():
        place = {name: k for k, name in enumerate(names)}
        rows = np.flatnonzero(np.isin(row_camera, names)).astype(np.int32)
        ordered = np.array(sorted(names))
        camera = np.array([place[n] for n in ordered], np.int32)[np.searchsorted(ordered, row_camera[rows])]
        groups.append(CameraGroup(tuple(names), treedef, offset, camera, (), rows if len(by_model) > 1 else None))
        offset += len(names) * treedef.num_leaves
        sequence.append(rows)
    unsort = np.argsort(np.concatenate(sequence)).astype(np.int32) if len(groups) > 1 else None
    return tuple(groups), unsort


def _with_free(group: CameraGroup, free: np.ndarray) -> CameraGroup:
    """The group with its list of parameters that are free in any of its cameras."""
    m = group.treedef.num_leaves
    own = free[(free >= group.offset) & (free < group.offset + m * len(group.names))] - group.offset
    return dataclasses.replace(group, free_leaves=tuple(sorted({int(k) % m for k in own})))


def _shared_entries(block: Block, priors: Unknowns, groups: tuple[CameraGroup, ...]) -> list[_Entry]:
    entries = []
    for name in (n for g in groups for n in g.names):
        labels = _leaf_names(block.start.unknowns.interior[name])
        leaves = jax.tree.leaves(priors.interior[name], is_leaf=_is_prior)
        entries += [
            _Entry(f"c:{name}", f"interior[{name}].{label}", leaf) for label, leaf in zip(labels, leaves, strict=True)
        ]
    for kind, items, names in (("mounts", priors.mounts, _MOUNT), ("strips", priors.strips, _STRIP)):
        for name, item in items.items():
            for label, prior in zip(names, spread(item), strict=True):
                if not isinstance(prior, Prior | Weighted):
                    raise ValueError(f"{kind}[{name}].{label}: {prior!r} is no prior; use FREE, FIXED or Weighted")
                entries.append(_Entry(f"{kind[0]}:{name}", f"{kind}[{name}].{label}", prior))
    return entries


_MOUNT = (
    *(f"lever_arm_{axis}_m" for axis in ("right", "forward", "up")), *(f"boresight_{axis}_rad" for axis in "xyz"),
    "time_offset_s",
)  # fmt: skip
_STRIP = (*(f"shift_{axis}_m" for axis in "XYZ"), *(f"drift_{axis}_m_per_s" for axis in "XYZ"))
MOUNT_SIZE, STRIP_SIZE = len(_MOUNT), len(_STRIP)


def spread(item: Mount | StripBias) -> list[object]:
    """One prior per number of a mount's or strip's tree of priors."""
    if isinstance(item, Mount):
        return [*_components(item.lever_arm), *_components(item.boresight), item.time_offset]
    return [*_components(item.shift), *_components(item.drift)]


def _components(prior: object) -> list[object]:
    if not isinstance(prior, Weighted):
        return [prior] * 3
    value, sigma = np.broadcast_to(prior.value, 3), np.broadcast_to(prior.sigma, 3)
    return [Weighted(v, s) for v, s in zip(value, sigma, strict=True)]


def _leaf_names(interior: InteriorOrientation) -> list[str]:
    """Parameter names in the order of the tree's leaves; a constant keeps its field's name."""
    estimable = dict(zip(("c", "x_p", "y_p"), parameter_names(interior), strict=False))
    paths = jax.tree_util.tree_flatten_with_path(interior)[0]
    return [estimable.get(path[-1].name, path[-1].name) for path, _ in paths]
