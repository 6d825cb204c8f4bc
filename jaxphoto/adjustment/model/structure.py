"""Structure of a block's normal equations as index arrays, built once on the host.

    unknowns    eop (6 per image: X, Y, Z, small rotation), shared (interior orientation, mounts, strips; only what
                is not FIXED; interior orientations first), points (3 per point)
    colours     an image depends on few shared unknowns; unknowns of different cameras, mounts or strips share a
                colour, so one tangent vector differentiates all of them
    groups      all observations except image rows, see `observed_groups`
    rays        image rows, each of one image and one point; computations use a `layout.padded.PaddedStructure`,
                with images and points ordered for a small bandwidth

All arrays are arguments of the compiled functions, never constants: a new block of the same shapes needs no
compilation.
"""

import abc
import dataclasses
from collections.abc import Mapping
from typing import NamedTuple, Self

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment.model.camera_groups import (
    CameraGroup,
    camera_groups,
    n_parameters,
    places_of_cameras,
    with_free,
)
from jaxphoto.adjustment.model.observed_groups import (
    ObservedGroup,
    RowsAtPoints,
    group_of,
    observations_of,
    weighted_parameters,
)
from jaxphoto.adjustment.model.parameter_tables import (
    JointPrior,
    ParameterTable,
    SharedParameter,
    shared_entries,
    tables_of,
)
from jaxphoto.block import Block
from jaxphoto.devices import AXIS
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import Corrections
from jaxphoto.losses import AbstractLoss, LinearisedLoss
from jaxphoto.observations import PRIORS, AbstractObservations, ImagePoints
from jaxphoto.short_repr import pretty_repr
from jaxphoto.unknowns import FIXED, Unknowns


class AbstractStructure(eqx.Module):
    """Index arrays and sizes, in the order of the block or padded."""

    groups: tuple[CameraGroup, ...]
    tables: tuple[ParameterTable, ...]
    """Declared parameters, in their order after the camera parameters."""
    n_images: int = eqx.field(static=True)
    n_points: int = eqx.field(static=True)
    corrections: Corrections = eqx.field(static=True)
    n_interior: int = eqx.field(static=True)
    """Number of shared unknowns that image rows involve (cameras and the parameters that modify them); they come first.
    """
    n_image_colours: int = eqx.field(static=True)
    free: Int[np.ndarray, "shared"]
    """Index of each shared unknown in the vector of shared parameters."""
    column: Int[np.ndarray, "images colours"]
    """Shared unknown of each colour and image; the number of shared unknowns if there is none. Colours of image rows
    come first.
    """
    colour: Int[np.ndarray, "shared"]
    observed: tuple[ObservedGroup, ...]
    """Observations except image rows, and prior information."""
    image_loss: AbstractLoss | LinearisedLoss | None
    """Loss of image rows if it is not quadratic."""
    eop_free: Float[np.ndarray, "6 images"]
    point_free: Float[np.ndarray, "3 points"]

    def with_losses(self, losses: Mapping[str, AbstractLoss]) -> Self:
        """Replace the losses by group name."""

        def of(name: str, numbers: int) -> AbstractLoss | None:
            return losses[name].for_rows_of(numbers) if name in losses else None

        observed = tuple(dataclasses.replace(g, loss=of(g.name, g.components)) for g in self.observed)
        return dataclasses.replace(self, observed=observed, image_loss=of(ImagePoints.group, len(ImagePoints.axes)))

    @property
    def has_losses(self) -> bool:
        """True if any group has a loss that is not quadratic."""
        return self.image_loss is not None or any(g.loss is not None for g in self.observed)

    @property
    def with_linearised_losses(self) -> Self:
        """Replace losses by their linearisation, for normal equations."""
        of = lambda loss: None if loss is None else LinearisedLoss(loss)  # noqa: E731
        observed = tuple(dataclasses.replace(g, loss=of(g.loss)) for g in self.observed)
        return dataclasses.replace(self, observed=observed, image_loss=of(self.image_loss))

    @property
    @abc.abstractmethod
    def shards(self) -> int:
        """Number of devices over which points are sharded."""

    @property
    def n_shared(self) -> int:
        """Number of shared unknowns."""
        return len(self.free)

    @property
    def n_cameras(self) -> int:
        """Number of parameters of all cameras: the first elements of the vector of shared parameters."""
        return n_parameters(self.groups)

    @property
    def coupled(self) -> tuple[ObservedGroup, ...]:
        """Groups whose rows couple points."""
        return tuple(g for g in self.observed if g.elimination == "coupled")

    @property
    def with_shared(self) -> tuple[ObservedGroup, ...]:
        """Groups of rows stored by point that involve shared unknowns."""
        return tuple(g for g in self.observed if isinstance(g.rows, RowsAtPoints) and g.place)

    @property
    def n_coupled(self) -> int:
        """Number of observations in `coupled`."""
        return sum(g.components * g.n_rows for g in self.coupled)

    @property
    def modifies_interior(self) -> bool:
        """True if the interior orientation differs between images of a camera."""
        return any(t.modifies_interior for t in self.tables)


@pretty_repr
class Structure(AbstractStructure):
    """Structure in the order of the block; see the module docstring."""

    image: Int[np.ndarray, "rows"]
    """Image and point of each image row."""
    point: Int[np.ndarray, "rows"]
    labels: tuple[str, ...] = eqx.field(static=True)
    """Parameter path of each shared unknown, such as `interior[kodak].c_mm`."""

    @property
    def shards(self) -> int:
        """Number of devices: always 1."""
        return 1


def total(x, s: AbstractStructure):
    """Return the sum over all devices."""
    return jax.lax.psum(x, AXIS) if s.shards > 1 else x


class ObservedRows(NamedTuple):
    """Observations except image points, and the order of the shared parameters."""

    cameras: tuple[CameraGroup, ...]
    tables: tuple[ParameterTable, ...]
    entries: list[SharedParameter]
    together: list[JointPrior]
    """Joint priors of several parameters."""
    named: list[tuple[str, AbstractObservations]]
    """Rows by group name."""

    @property
    def camera_names(self) -> list[str]:
        """All cameras, model by model."""
        return [name for g in self.cameras for name in g.names]


def observed_in(block: Block, priors: Unknowns) -> ObservedRows:
    """Return the observations of `block` and `priors`, and the shared parameters.

    Raises InputError or BlockError for invalid priors and rows.
    """
    cameras = camera_groups(block, np.array(block.image_camera))
    tables = tables_of(block, block.start.unknowns, n_parameters(cameras))
    entries, together = shared_entries(block, priors, [name for g in cameras for name in g.names], tables)
    named = observations_of(block, priors, together, [e.label for e in entries])
    weighted = weighted_parameters([e.prior for e in entries], together)
    return ObservedRows(cameras, tables, entries, together, named + [(PRIORS, weighted)] * (len(weighted) > 0))


def structure_of(block: Block, priors: Unknowns, observed: ObservedRows | None = None) -> Structure:
    """Build the part of the adjustment of `block` that does not depend on measured values.

    `observed` is the result of `observed_in(block, priors)`, if already computed.
    """
    image, point = np.asarray(block.image_points.image), np.asarray(block.image_points.point)
    _check_rows(image, point)
    if len(np.unique(np.asarray(block.control.who) * 3 + np.asarray(block.control.axis))) < len(block.control.who):
        raise ValueError("control has duplicate coordinates of a point: keep one row of each")
    given = observed_in(block, priors) if observed is None else observed
    tables, entries = given.tables, given.entries
    free = np.array([k for k, e in enumerate(entries) if e.prior != FIXED], dtype=np.int32)
    unknown_of = np.full(len(entries) + 1, len(free), np.int32)
    unknown_of[free] = np.arange(len(free))
    colour, column, n_image_colours = _colours(block, given, free)
    bent = sum(t.size * len(t.owners) for t in tables if t.modifies_interior)
    n_interior = int((free < n_parameters(given.cameras) + bent).sum())
    cameras = places_of_cameras(given.cameras)
    groups = tuple(group_of(name, rows, tables, cameras, unknown_of, len(free)) for name, rows in given.named)

    point_free = np.ones((3, len(block.points))) * (priors.points != FIXED)
    point_free[block.fixed.axis, block.fixed.who] = 0.0
    _check_coupled(block, groups, point, point_free)
    eop_free = np.ones((6, len(block.images)))
    eop_free[:3] *= priors.exterior.position != FIXED
    eop_free[3:] *= priors.exterior.camera_from_object != FIXED
    return Structure(
        groups=tuple(with_free(g, free, tables) for g in given.cameras),
        tables=tables,
        n_images=len(block.images),
        n_points=len(block.points),
        corrections=block.corrections,
        n_interior=n_interior,
        n_image_colours=n_image_colours,
        image=image.astype(np.int32),
        point=point.astype(np.int32),
        free=free,
        column=column,
        colour=colour,
        observed=groups,
        image_loss=None,
        eop_free=eop_free,
        point_free=point_free,
        labels=tuple(entries[k].label for k in free),
    )


def _check_rows(image: np.ndarray, point: np.ndarray) -> None:
    """Raise ValueError if image rows are not sorted by point or contain a point of an image twice."""
    if (np.diff(point) < 0).any():
        raise ValueError("the rows of image_points must be sorted by point: reorder them by np.argsort(point)")
    key = point.astype(np.int64) * (int(image.max(initial=0)) + 1) + image
    if len(np.unique(key)) < len(key):
        raise ValueError("image_points has a point twice in one image: keep one row of each")


def _check_coupled(block: Block, groups: tuple[ObservedGroup, ...], point: np.ndarray, point_free: np.ndarray) -> None:
    """Raise BlockError for a point that only coupled rows observe: it cannot be eliminated."""
    own = (point_free == 0).all(axis=0)
    own[point] = True
    for g in groups:
        if g.elimination == "point":
            own[g.point] = True
    for g in groups:
        if g.elimination == "coupled" and not own[g.point].all():
            name = block.points[int(g.point[~own[g.point]][0])]
            raise BlockError(
                f"point {name} is determined by {g.name} only: measure it in an image, add control, or remove it"
            )


def _colours(block: Block, given: ObservedRows, free: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the colour of each shared unknown, the unknown of each colour and image, and the number of image-row
    colours.

    Unknowns of one owner have different colours; unknowns of two owners of a kind share colours.
    """
    owners = [given.entries[k].owner for k in free]
    rank, seen = np.zeros(len(free), np.int32), dict.fromkeys(owners, -1)
    for j, o in enumerate(owners):
        rank[j] = seen[o] = seen[o] + 1
    kinds = {"c": block.image_camera} | {
        t.kind: tuple(t.owners[k] if k < len(t.owners) else None for k in t.of_image) for t in given.tables
    }
    base, count = {}, 0
    n_image_colours = 0
    modifies_interior = {t.kind for t in given.tables if t.modifies_interior}
    for kind, names in kinds.items():
        base[kind] = count
        if not any(name is not None for name in names):
            # No image depends on the scanner.
            continue
        count += max((seen[o] + 1 for o in seen if o.split(":")[0] == kind), default=0)
        if kind == "c" or kind in modifies_interior:
            n_image_colours = count
    colour = np.array([base[o.split(":")[0]] + r for o, r in zip(owners, rank, strict=True)], np.int32)
    column = np.full((len(block.images), count), len(free), np.int32)
    of_owner: dict[str, list[int]] = {}
    for j, o in enumerate(owners):
        of_owner.setdefault(o, []).append(j)
    for kind, names in kinds.items():
        for i, name in enumerate(names):
            for j in of_owner.get(f"{kind}:{name}", ()):
                column[i, colour[j]] = j
    return colour, column, n_image_colours
