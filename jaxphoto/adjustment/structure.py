"""The structure of a block's normal equations: who meets whom, made once on the host as index arrays.

    unknowns    eop (6 per image: X, Y, Z, small rotation), shared (interior orientation, mounts, strips; only what
                is not FIXED; interior orientations first), points (3 per point)
    colours     each image touches few shared unknowns; unknowns of different cameras, mounts or strips carry the
                same colour, so one seed differentiates all of them at once
    tiles       points with the images that see them, see `tiling`; laid out by `padding.pad_structure`, which also
                puts images and points in the order of the tiles: a padded structure is what is computed with

All arrays are arguments of the compiled functions, never constants in them: a new block of the same shapes
compiles nothing.
"""

import dataclasses
from collections.abc import Iterable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment.shared import MOUNT_SIZE, SCANNER, scanner_vectors, shared_entries
from jaxphoto.adjustment.tiling import check_rows
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation
from jaxphoto.georeferencing import Corrections
from jaxphoto.unknowns import FIXED, Unknowns, Weighted

AXIS = "tiles"
"""Mesh axis along which tiles and their points are dealt out to devices."""


class CameraGroup(eqx.Module):
    """Cameras of one model: their parameters are rows of one table, so one `vmap` serves them all."""

    names: tuple[str, ...] = eqx.field(static=True)
    treedef: jax.tree_util.PyTreeDef = eqx.field(static=True)
    offset: int = eqx.field(static=True)
    camera: Int[np.ndarray, "images"]
    """Camera (within the group) of each image; 0 where the image's camera is of another group."""
    member: Bool[np.ndarray, "images"]
    """Whether the image's camera is of this group."""
    free_leaves: tuple[int, ...] = eqx.field(static=True)


class Tiles(eqx.Module):
    """The tiles of a padded structure, and the lists that bring their sums to the reduced normal matrix.

    Tiles are cut into equal chunks (leading axis), so that the sums of one chunk are all that is held at a time. Empty
    slots have the last image, which nothing depends on.
    """

    image: Int[np.ndarray, "chunks tiles m"]
    per_tile: int = eqx.field(static=True)
    """Points of a tile, P."""
    groups: Int[np.ndarray, "chunks"]
    """How many groups of `at_once` tiles hold the points of each chunk: the first ones; the others are padding."""
    at_once: int = eqx.field(static=True)
    """Tiles that are computed with at a time: few enough for the cache of a core, enough to be worth its while."""
    pair_tile: Int[np.ndarray, "chunks pairs"]
    """Tile within its chunk of each pair of images of a tile that meet (first image not before second)."""
    pair_images: Int[np.ndarray, "chunks pairs 2"]
    """The two within the tile."""
    pair_block: Int[np.ndarray, "chunks pairs"]
    """Which of the chunk's blocks the pair adds to; sorted."""
    block: Int[np.ndarray, "chunks blocks 3"]
    """Column block of the band, and image row (of two column blocks) and image column in it."""
    columns: int = eqx.field(static=True)
    """Column blocks of the reduced matrix, K."""
    shards: int = eqx.field(static=True)
    """Devices that the chunks are dealt out to, in equal parts."""

    @property
    def few(self) -> bool:
        """Whether a device computes with all its tiles at a time: what is made of them is worth keeping."""
        return self.image.shape[:2] == (1, self.at_once)


class Structure(eqx.Module):
    """Index arrays and sizes; see the module's head."""

    groups: tuple[CameraGroup, ...]
    scanner_offset: int = eqx.field(static=True)
    """The first parameter of the scanner in the vector of all shared parameters: that after the cameras'."""
    mount_offset: int = eqx.field(static=True)
    strip_offset: int = eqx.field(static=True)
    n_images: int = eqx.field(static=True)
    n_points: int = eqx.field(static=True)
    corrections: Corrections = eqx.field(static=True)
    n_interior: int = eqx.field(static=True)
    """Shared unknowns that belong to cameras: the first ones."""
    n_scanner: int = eqx.field(static=True)
    """Those that belong to the scanner: the next."""
    n_image_colours: int = eqx.field(static=True)
    n_colours: int = eqx.field(static=True)
    n_classes: int = eqx.field(static=True)
    image: Int[np.ndarray, "rows"]
    """Image and point of each image row. Empty in a padded structure, whose rows are the slots of its tiles."""
    point: Int[np.ndarray, "rows"]
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
    """Point and axis of each observed control coordinate. Empty in a padded structure: there every coordinate has a
    value and a standard deviation."""
    control_axis: Int[np.ndarray, "control"]
    surface_point: Int[np.ndarray, "surfaces"]
    """Point of each row of a surface. Empty in a padded structure, whose rows are listed by point."""
    surface_strip: Int[np.ndarray, "surfaces"]
    """Lidar strip of each row. Of a padded structure (rows, points), rows being the most that a point has."""
    distance_points: Int[np.ndarray, "distances 2"]
    point_class: Int[np.ndarray, "points"]
    weighted: Int[np.ndarray, "weighted"]
    """Shared unknown of each weighted prior."""
    eop_free: Float[np.ndarray, "6 images"]
    point_free: Float[np.ndarray, "3 points"]
    labels: tuple[str, ...] = eqx.field(static=True)
    """Parameter path of each shared unknown, such as `interior[kodak].c_mm`."""
    tiles: Tiles | None
    """Of a padded structure."""

    @property
    def in_tiles(self) -> Tiles:
        """The tiles of a padded structure."""
        assert self.tiles is not None, "not a padded structure"
        return self.tiles

    @property
    def n_border(self) -> int:
        """Shared unknowns that meet points: those of cameras and scanner."""
        return self.n_interior + self.n_scanner

    @property
    def n_shared(self) -> int:
        """Number of shared unknowns."""
        return len(self.free)


def total(x, s: Structure):
    """The sum over all devices."""
    return jax.lax.psum(x, AXIS) if s.tiles is not None and s.tiles.shards > 1 else x


def interior_of(group: CameraGroup, table) -> InteriorOrientation:
    """The group's interior orientations from its table of parameters, one column a parameter."""
    return jax.tree.unflatten(group.treedef, table)


def structure_of(block: Block, priors: Unknowns) -> Structure:
    """Everything about the adjustment of `block` that does not depend on a measured value."""
    image, point = np.asarray(block.image_points.image), np.asarray(block.image_points.point)
    check_rows(image, point)
    camera_names = np.array(block.image_camera)

    groups = _groups(block, camera_names)
    if len(np.unique(np.asarray(block.control.who) * 3 + np.asarray(block.control.axis))) < len(block.control.who):
        raise ValueError("control holds a coordinate of a point twice: keep one row of each")
    entries = shared_entries(block, priors, groups)
    scanner_offset = sum(len(g.names) * g.treedef.num_leaves for g in groups)
    lidar = [] if priors.scanner is None else scanner_vectors(priors.scanner)
    mount_offset = scanner_offset + 3 * len(lidar)
    free = np.array([k for k, e in enumerate(entries) if e.prior is not FIXED], dtype=np.int32)
    ranks: dict[str, int] = {}
    owners, colour = [], np.zeros(len(free), np.int32)
    for j, k in enumerate(free):
        owner = entries[k].owner
        colour[j] = ranks[owner] = ranks.get(owner, -1) + 1
        owners.append(owner)
    counts = [max((ranks[o] + 1 for o in ranks if o.startswith(kind)), default=0) for kind in ("c:", "m:", "s:")]
    base = {"c": 0, "m": counts[0], "s": counts[0] + counts[1]}
    # No image meets the scanner: one colour, the last, is enough for all of it.
    colour = np.array([sum(counts) if o == SCANNER else base[o[0]] + c for o, c in zip(owners, colour, strict=True)])
    colour = colour.astype(np.int32)
    counts.append(int(SCANNER in owners))
    groups = tuple(_with_free(g, free) for g in groups)
    column = np.full((len(block.images), sum(counts)), len(free), np.int32)
    of_owner: dict[str, list[int]] = {}
    for j, o in enumerate(owners):
        of_owner.setdefault(o, []).append(j)
    for names, kind in ((block.image_camera, "c:"), (block.image_mount, "m:"), (block.image_strip, "s:")):
        for i, name in enumerate(names):
            for j in of_owner.get(kind + name, ()):
                column[i, colour[j]] = j

    point_free = np.ones((3, len(block.points))) * (priors.points is not FIXED)
    point_free[block.fixed.axis, block.fixed.who] = 0.0
    eop_free = np.ones((6, len(block.images)))
    eop_free[:3] *= priors.exterior.position is not FIXED
    eop_free[3:] *= priors.exterior.camera_from_object is not FIXED
    classes = _point_classes(np.asarray(block.distances.points), len(block.points))
    return Structure(
        groups=groups,
        scanner_offset=scanner_offset,
        mount_offset=mount_offset,
        strip_offset=mount_offset + MOUNT_SIZE * len(priors.mounts),
        n_images=len(block.images),
        n_points=len(block.points),
        corrections=block.corrections,
        n_interior=int((free < scanner_offset).sum()),
        n_scanner=owners.count(SCANNER),
        n_image_colours=counts[0],
        n_colours=sum(counts),
        n_classes=int(classes.max(initial=0)) + 1,
        image=image.astype(np.int32),
        point=point.astype(np.int32),
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
        surface_point=np.asarray(block.surfaces.point, np.int32),
        surface_strip=np.asarray(block.surfaces.strip, np.int32),
        distance_points=np.asarray(block.distances.points, np.int32).reshape(-1, 2),
        point_class=classes,
        weighted=np.array([j for j, k in enumerate(free) if isinstance(entries[k].prior, Weighted)], np.int32),
        eop_free=eop_free,
        point_free=point_free,
        labels=tuple(entries[k].label for k in free),
        tiles=None,
    )


def _index(names: tuple[str, ...], table: Iterable[str]) -> np.ndarray:
    """Place of each name in the table; one past the end where the table lacks it."""
    place = {name: k for k, name in enumerate(table)}
    return np.array([place.get(n, len(place)) for n in names], np.int32)


def _groups(block: Block, image_camera: np.ndarray) -> tuple[CameraGroup, ...]:
    by_model: dict[jax.tree_util.PyTreeDef, list[str]] = {}
    for name, interior in block.start.unknowns.interior.items():
        by_model.setdefault(jax.tree.structure(interior), []).append(name)
    groups, offset = [], 0
    for treedef, names in by_model.items():
        member = np.isin(image_camera, names)
        ordered = np.array(sorted(names))
        place = np.array([names.index(n) for n in ordered], np.int32)
        camera = np.zeros(len(image_camera), np.int32)
        camera[member] = place[np.searchsorted(ordered, image_camera[member])]
        groups.append(CameraGroup(tuple(names), treedef, offset, camera, member, ()))
        offset += len(names) * treedef.num_leaves
    return tuple(groups)


def _with_free(group: CameraGroup, free: np.ndarray) -> CameraGroup:
    """The group with its list of parameters that are free in any of its cameras."""
    m = group.treedef.num_leaves
    own = free[(free >= group.offset) & (free < group.offset + m * len(group.names))] - group.offset
    return dataclasses.replace(group, free_leaves=tuple(sorted({int(k) % m for k in own})))


def _point_classes(pairs: np.ndarray, n_points: int) -> np.ndarray:
    """Greedy colouring: two points joined by a distance lie in different classes."""
    classes = np.zeros(n_points, np.int32)
    neighbours: dict[int, set[int]] = {}
    for a, b in pairs:
        neighbours.setdefault(int(a), set()).add(int(b))
        neighbours.setdefault(int(b), set()).add(int(a))
    done: set[int] = set()
    for p, around in neighbours.items():
        taken = {int(classes[q]) for q in around & done}
        classes[p] = next(k for k in range(len(taken) + 1) if k not in taken)
        done.add(p)
    return classes
