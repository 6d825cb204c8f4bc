"""Block: observations as rows, with the images and points they refer to.

Observations are rows (`jaxphoto.observations`). Vertical control consists of rows with axis 2: neither NaN nor infinite
sigmas occur, and the redundancy is a count. Units are metres, radians and millimetres on the image.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.arrays import ArrayLike, joined, to_numpy
from jaxphoto.block_edits import BlockEdits
from jaxphoto.block_from_arrays import block_fields
from jaxphoto.block_parts import Datum, Frame, Motion, Start, Temperatures
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import NOMINAL, Corrections, Exposure, Mount, StripBias, direct_orientation
from jaxphoto.observations import (
    AbstractObservations,
    Attitudes,
    CameraPositions,
    ControlCoordinates,
    Distances,
    ImagePoints,
    KnownParameters,
    SurfaceRows,
)
from jaxphoto.short_repr import block_html, block_repr, from_upstairs
from jaxphoto.static_values import StaticDict
from jaxphoto.unknowns import FREE, Unknowns

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Block(BlockEdits):
    """Block of images: ids, observations, start values and priors.

    Index arrays refer to `images`, `points`, `strips` in their order. `jaxphoto.adjust` uses `start` and `priors` if no
    others are given. Check points never enter an adjustment.
    """

    title: str = eqx.field(static=True)
    images: tuple[str, ...] = eqx.field(static=True)
    points: tuple[str, ...] = eqx.field(static=True)
    sensors: dict[str, Sensor] = eqx.field(static=True, converter=StaticDict)
    image_camera: tuple[str, ...] = eqx.field(static=True)
    image_mount: tuple[str, ...] = eqx.field(static=True)
    image_strip: tuple[str, ...] = eqx.field(static=True)
    image_time: Float[ArrayLike, "images"]
    image_points: ImagePoints
    control: ControlCoordinates
    fixed: ControlCoordinates
    check: ControlCoordinates
    stations: CameraPositions
    attitudes: Attitudes
    distances: Distances
    datum: Datum = eqx.field(static=True)
    start: Start
    priors: Unknowns
    motion: Motion | None = None
    frame: Frame = eqx.field(static=True, default=Frame())
    corrections: Corrections = eqx.field(static=True, default=Corrections())
    surfaces: SurfaceRows = eqx.field(default_factory=SurfaceRows.none)
    more: tuple[AbstractObservations | KnownParameters, ...] = ()
    """Observations of further kinds, and joint prior information on parameters."""
    flight_time: Float[ArrayLike, "images"] | None = None
    """Seconds from the middle of the flight; `image_time` is from the middle of the strip. None: equal."""
    middle_s: float = eqx.field(static=True, default=0.0)
    """Middle of the flight in the time scale of the files (s)."""
    temperatures: Temperatures | None = None
    """Camera temperatures; None: unknown, and the cameras do not change with temperature."""
    partitions: dict[str, tuple[str, ...]] = eqx.field(static=True, default_factory=dict, converter=StaticDict)
    """Partitions: owners of parameters other than cameras, mounts and strips, such as intervals of time. For each
    partition, the part of each image ("" for none).
    """
    converted_from: str = eqx.field(static=True, default="")
    """Format and file of another program from which it was converted; "" for none."""

    def __check_init__(self) -> None:
        for field, kind in (
            ("stations", CameraPositions),
            *((name, ControlCoordinates) for name in ("control", "fixed", "check")),
        ):
            given = getattr(self, field)
            if isinstance(given, AbstractObservations) and not isinstance(given, kind):
                raise BlockError(f"Block.{field} must be {kind.__name__}, got {type(given).__name__}")

    @property
    def observations(self) -> tuple[AbstractObservations, ...]:
        """Return all observations except image points, by kind."""
        further = (rows for rows in self.more if isinstance(rows, AbstractObservations))
        return (self.stations, self.attitudes, self.control, self.surfaces, self.distances, *further)

    @property
    def prior_warnings(self) -> list[str]:
        """Return warnings about the prior information."""
        return [known.doubt for known in self.more if isinstance(known, KnownParameters) and known.doubt]

    @property
    def named_observations(self) -> dict[str, AbstractObservations]:
        """Return image points and all other rows by group name in results; empty groups are omitted."""
        return {self.image_points.group: self.image_points, **named_rows(self.observations)}

    def with_observations(self, rows: Mapping[str, AbstractObservations]) -> "Block":
        """Return a copy with some of `named_observations` replaced by other rows."""
        new = {id(old): rows[name] for name, old in self.named_observations.items() if name in rows}
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        changed: dict[str, Any] = {name: new[id(value)] for name, value in fields.items() if id(value) in new}
        return dataclasses.replace(self, **changed, more=tuple(new.get(id(value), value) for value in self.more))

    def owners(self, owner: str) -> tuple[str, ...]:
        """Return the owner of each image's parameters of kind `owner`, such as "camera"; "" if it has none.

        Raises BlockError for a partition that the block does not have.
        """
        known = {
            "image": self.images,
            "camera": self.image_camera,
            "mount": self.image_mount,
            "strip": self.image_strip,
            "block": ("",) * len(self.images),
            # A laser scanner belongs to the block, not to an image.
            "lidar": ("none",) * len(self.images),
            "knot": ("none",) * len(self.images),
        } | self.partitions
        if owner not in known:
            raise BlockError(
                f"parameters belong to the {owner} of an image, but the block has no such partition; give "
                f'Block.partitions {{"{owner}": (...)}}, or one of {", ".join(known)}'
            )
        return known[owner]

    def plot(self, ax: "Axes | None" = None, *, in_3d: bool = False) -> "Axes":
        """Plot the start values, in plan or in space; returns the matplotlib axes, new ones unless given."""
        return from_upstairs("plot_block")(self, ax, in_3d=in_3d)

    __repr__ = block_repr

    def _repr_html_(self) -> str:
        return block_html(self, {f"known of {name}": words for name, words in self.priors.words.items()})

    @staticmethod
    @functools.wraps(block_fields)
    def of(*args: Any, **kwargs: Any) -> "Block":
        """Create a block from arrays and tables: see `block_fields`."""
        return Block(**block_fields(*args, **kwargs))


def empty_block(title: str) -> Block:
    """Return an empty block, for observations that need neither images nor points."""
    places, known = np.zeros((0, 3)), np.zeros(0, bool)
    start = Unknowns({}, ExteriorOrientation(places, np.zeros((0, 3, 3))), places, {}, {})  # type: ignore[arg-type]
    priors = Unknowns({}, ExteriorOrientation(FREE, FREE), FREE, {}, {})  # type: ignore[arg-type]
    none = ControlCoordinates.none()
    return Block(
        title, (), (), {}, (), (), (), np.zeros(0), ImagePoints.none(), none, none, none, CameraPositions.none(),
        Attitudes.none(), Distances.none(), Datum(), Start(start, known, known), priors,
    )  # fmt: skip


def named_rows(groups: Iterable[AbstractObservations]) -> dict[str, AbstractObservations]:
    """Return non-empty groups by name, numbered if several share a name."""
    named: dict[str, AbstractObservations] = {}
    for rows in groups:
        if len(rows):
            taken = sum(name.split("#")[0] == rows.group for name in named)
            named[rows.group if not taken else f"{rows.group}#{taken + 1}"] = rows
    return named


class SensorRows(eqx.Module):
    """GNSS and IMU records of the images that have both a full position and an attitude; one entry per image.

    `mount`, `bias` and `exposure` have a leading axis over these images.
    """

    image: Int[np.ndarray, "n"]
    station: Float[ArrayLike, "n 3"]
    station_sigma: Float[ArrayLike, "n 3"]
    roll_pitch_yaw: Float[ArrayLike, "n 3"]
    attitude_sigma: Float[ArrayLike, "n 3"]
    mount: Mount
    bias: StripBias
    exposure: Exposure


def sensor_rows(block: Block, unknowns: Unknowns) -> SensorRows:
    """Return stations and attitudes of `block` by image, with the mounts and strips of `unknowns`."""
    station = np.full((len(block.images), 3), -1)
    station[block.stations.who, block.stations.axis] = np.arange(len(block.stations.who))
    attitude = np.full(len(block.images), -1)
    attitude[block.attitudes.image] = np.arange(len(block.attitudes.image))
    image = np.flatnonzero((station >= 0).all(1) & (attitude >= 0))
    rows, turn = station[image], attitude[image]
    mount, bias = mountings(block, unknowns)
    mount, bias, exposure = jax.tree.map(lambda v: to_numpy(v)[image], (mount, bias, exposures(block)))
    return SensorRows(
        image=image,
        station=to_numpy(block.stations.value)[rows],
        station_sigma=to_numpy(block.stations.sigma)[rows],
        roll_pitch_yaw=to_numpy(block.attitudes.roll_pitch_yaw)[turn],
        attitude_sigma=to_numpy(block.attitudes.sigma)[turn],
        mount=mount,
        bias=bias,
        exposure=exposure,
    )


@eqx.filter_jit
def direct_exterior(rows: SensorRows) -> ExteriorOrientation:
    """Apply `georeferencing.direct_orientation` to all images of `rows`."""
    of_each = jax.vmap(lambda r: direct_orientation(r.station, r.roll_pitch_yaw, r.mount, r.bias, r.exposure))
    return of_each(rows)


def mountings(block: Block, unknowns: Unknowns) -> tuple[Mount, StripBias]:
    """Return mount and strip bias of every image, with a leading axis over the images; zeros if an image has none.

    The direction of the camera's x axis is part of `exposures`: stacking requires mounts of one class.
    """
    none = jax.device_put(np.zeros(3))
    mounts = {name: Mount(m.lever_arm, m.boresight, m.time_offset) for name, m in unknowns.mounts.items()}
    return (
        _by_name(mounts, block.image_mount, Mount(none, none)),
        _by_name(unknowns.strips, block.image_strip, StripBias(none, none)),
    )


def _by_name(table: dict, names: tuple[str, ...], absent):
    """Stack the trees of `names` along a leading axis; `absent` replaces missing ones."""
    place = {name: k for k, name in enumerate(table)}
    index = np.array([place.get(name, len(place)) for name in names], int)
    return jax.tree.map(lambda *v: joined([to_numpy(x)[None] for x in v])[index], *table.values(), absent)


def bent_cameras(block: Block, unknowns: Unknowns) -> dict[str, InteriorOrientation] | None:
    """Return the interior orientations at all exposures, by camera (with a leading axis over its images).

    None if no camera changes: no rolling shutter, no drift during the flight.
    """
    bending = []
    for owners in unknowns.tables.values():
        for first in list(owners.values())[:1]:
            if first.modifies_interior:
                absent = jax.tree.map(jnp.zeros_like, first)
                bending.append(_by_name(owners, block.owners(first.owner), absent))
    if not bending:
        return None

    def of_one(interior: InteriorOrientation, parameters: list, exposure: Exposure) -> InteriorOrientation:
        for own in parameters:
            interior = own.interior(interior, exposure)
        return jax.tree.map(jnp.asarray, interior)

    taken = jax.tree.map(jnp.asarray, exposures(block))
    at_each = jax.vmap(of_one, (None, 0, 0))
    return {name: at_each(interior, bending, taken) for name, interior in unknowns.interior.items()}


def exposures(block: Block) -> Exposure:
    """Return the unobserved properties of every exposure, with a leading axis over the images."""
    none = np.zeros((len(block.images), 3))
    motion = block.motion if block.motion is not None else Motion(none, none)
    mounts = block.start.unknowns.mounts
    each = [mounts[name].nominal if name in mounts else NOMINAL["forward"] for name in block.image_mount]
    nominal = np.array(each).reshape(-1, 3, 3)
    flight_time = block.image_time if block.flight_time is None else block.flight_time
    height = np.array([block.sensors[camera].height_mm for camera in block.image_camera])
    above = np.zeros(len(block.images)) if block.temperatures is None else block.temperatures.above
    known: Any = (block.image_time, motion.velocity, motion.rate, nominal, flight_time, height, above)
    return Exposure(*known)
