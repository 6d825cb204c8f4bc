"""The block: observations as rows, and who observed what.

A row of `Rows` is (who, axis, value, sigma). "Vertical control" is then rows with axis 2: there is no NaN and no
infinite sigma, and the redundancy is a count. Units are metres, radians and millimetres on the image.
"""

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.arrays import Numbers, joined, still
from jaxphoto.camera import Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import NOMINAL, Corrections, Exposure, Mount, StripBias, direct_orientation
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.unknowns import Unknowns

AXES = ("X", "Y", "Z")
ATTITUDE_AXES = ("roll", "pitch", "yaw")


class ImageRows(eqx.Module):
    """Measured image coordinates (mm, from the image centre) of `point` in `image`, sorted by point."""

    image: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "n"]
    xy: Float[Numbers, "n 2"]
    sigma: Float[Numbers, "n 2"]


class Rows(eqx.Module):
    """One scalar each: `who` (index of a point or an image), `axis` (0, 1, 2), `value` and `sigma`."""

    who: Int[np.ndarray, "n"]
    axis: Int[np.ndarray, "n"]
    value: Float[Numbers, "n"]
    sigma: Float[Numbers, "n"]

    @staticmethod
    def none() -> "Rows":
        """No rows."""
        return Rows(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0))

    @staticmethod
    def joined(*parts: "Rows") -> "Rows":
        """The rows of all `parts`, in this order."""
        who, axis, value, sigma = (joined(field) for field in zip(*(p.fields for p in parts), strict=True))
        return Rows(who, axis, value, sigma)  # type: ignore[arg-type]

    def take(self, chosen: np.ndarray) -> "Rows":
        """The rows that `chosen` (an index or a mask) names."""
        return Rows(self.who[chosen], self.axis[chosen], still(self.value)[chosen], still(self.sigma)[chosen])

    @property
    def fields(self) -> tuple:
        """who, axis, value, sigma."""
        return self.who, self.axis, self.value, self.sigma


class Attitudes(eqx.Module):
    """Observed roll, pitch, yaw (rad, all three) of `image` with their sigmas (rad)."""

    image: Int[np.ndarray, "n"]
    roll_pitch_yaw: Float[Numbers, "n 3"]
    sigma: Float[Numbers, "n 3"]

    @staticmethod
    def none() -> "Attitudes":
        """No rows."""
        return Attitudes(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)))


class Distances(eqx.Module):
    """Scale bars: the distance (m) between two points."""

    points: Int[np.ndarray, "n 2"]
    value: Float[Numbers, "n"]
    sigma: Float[Numbers, "n"]

    @staticmethod
    def none() -> "Distances":
        """No rows."""
        return Distances(np.zeros((0, 2), int), np.zeros(0), np.zeros(0))


class SurfaceRows(eqx.Module):
    """Points observed to lie on the surface that a laser scanner measured: on the plane through `foot` (m).

        normal . (X - foot + shift) + turn . boresight = 0

    with standard deviation `sigma` (m), and the shift of the lidar strip and the boresight of `Unknowns.scanner`, where
    the block has one. `turn` (m) is by how much a unit of boresight has raised `foot` along `normal`
    (`georeferencing.raised_by_boresight`).
    """

    point: Int[np.ndarray, "n"]
    strip: Int[np.ndarray, "n"]
    """Of `Unknowns.scanner.shifts`, in their order; 0 in a block without a scanner."""
    foot: Float[Numbers, "n 3"]
    normal: Float[Numbers, "n 3"]
    turn: Float[Numbers, "n 3"]
    sigma: Float[Numbers, "n"]

    @staticmethod
    def none() -> "SurfaceRows":
        """No rows."""
        return SurfaceRows(*(np.zeros(0, int),) * 2, *(np.zeros((0, 3)),) * 3, np.zeros(0))

    def take(self, chosen: np.ndarray) -> "SurfaceRows":
        """The rows that `chosen` (an index or a mask) names."""
        return jax.tree.map(lambda v: still(v)[chosen], self)


@dataclasses.dataclass(frozen=True)
class Datum:
    """How position, orientation and scale are fixed where observations leave them open.

    `control`: they must not be open. `minimal`: just enough coordinates of points held at their start values.
    `inner`: inner constraints over all points, all images or the points named (`over`); `scale` None means
    "constrain the scale if it is open".
    """

    kind: Literal["control", "minimal", "inner"] = "control"
    over: Literal["points", "images"] | tuple[str, ...] = "points"
    scale: bool | None = None


class Motion(eqx.Module):
    """How the GNSS/IMU moves at each exposure, for a time offset to act on (`georeferencing.Exposure`)."""

    velocity: Float[Numbers, "images 3"]
    """In the object frame, m/s."""
    rate: Float[Numbers, "images 3"]
    """About the body's right, forward and up axes, rad/s."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """The object frame of a block, and how to come back to the frame of its files.

    `local`, `enu`: Cartesian, as the files give it. `grid`: map-grid coordinates taken as they stand, which is no
    Cartesian frame. `epsg`: files in the EPSG system `code`, with heights of the EPSG system `vertical` (None: above
    the ellipsoid) and yaw from true or grid north, were brought to the local east-north-up frame whose origin is
    (longitude, latitude in degrees, ellipsoidal height in m).
    """

    kind: Literal["local", "enu", "grid", "epsg"] = "local"
    code: int | None = None
    vertical: int | None = None
    yaw: Literal["true", "grid"] = "true"
    origin: tuple[float, float, float] | None = None

    @property
    def map(self) -> MapFrame:
        """To and from the map coordinates of the files; of kind `epsg` only."""
        if self.code is None or self.origin is None:
            raise ValueError(f"only a frame of kind epsg with an origin has map coordinates, this is {self}")
        return MapFrame(self.code, self.vertical, self.origin)


class Start(eqx.Module):
    """Approximate unknowns, and which images and points they are truly known for.

    The arrays of unknown images and points hold zeros (identity rotations) until approximations are found.
    """

    unknowns: Unknowns
    image_known: np.ndarray
    point_known: np.ndarray


class Block(eqx.Module):
    """A block of images: ids, observations, and what is known and free beforehand.

    Index arrays refer to `images`, `points`, `strips` in their order. `start` and `priors` are what
    `jaxphoto.adjust` uses unless told otherwise. Check points never enter an adjustment.
    """

    title: str = eqx.field(static=True)
    images: tuple[str, ...] = eqx.field(static=True)
    points: tuple[str, ...] = eqx.field(static=True)
    sensors: dict[str, Sensor] = eqx.field(static=True)
    image_camera: tuple[str, ...] = eqx.field(static=True)
    image_mount: tuple[str, ...] = eqx.field(static=True)
    image_strip: tuple[str, ...] = eqx.field(static=True)
    image_time: Float[Numbers, "images"]
    image_points: ImageRows
    control: Rows
    fixed: Rows
    check: Rows
    stations: Rows
    attitudes: Attitudes
    distances: Distances
    datum: Datum = eqx.field(static=True)
    start: Start
    priors: Unknowns
    motion: Motion | None = None
    frame: Frame = eqx.field(static=True, default=Frame())
    corrections: Corrections = eqx.field(static=True, default=Corrections())
    surfaces: SurfaceRows = eqx.field(default_factory=SurfaceRows.none)


class SensorRows(eqx.Module):
    """What GNSS and IMU recorded of the images that have both a whole position and an attitude; one entry an image.

    `mount`, `bias` and `exposure` have a leading axis over these images.
    """

    image: Int[np.ndarray, "n"]
    station: Float[Numbers, "n 3"]
    station_sigma: Float[Numbers, "n 3"]
    roll_pitch_yaw: Float[Numbers, "n 3"]
    attitude_sigma: Float[Numbers, "n 3"]
    mount: Mount
    bias: StripBias
    exposure: Exposure


def sensor_rows(block: Block, unknowns: Unknowns) -> SensorRows:
    """Stations and attitudes of `block` by image, with the mounts and strips of `unknowns`."""
    station = np.full((len(block.images), 3), -1)
    station[block.stations.who, block.stations.axis] = np.arange(len(block.stations.who))
    attitude = np.full(len(block.images), -1)
    attitude[block.attitudes.image] = np.arange(len(block.attitudes.image))
    image = np.flatnonzero((station >= 0).all(1) & (attitude >= 0))
    rows, turn = station[image], attitude[image]
    mount, bias = mountings(block, unknowns)
    mount, bias, exposure = jax.tree.map(lambda v: still(v)[image], (mount, bias, exposures(block)))
    return SensorRows(
        image=image,
        station=still(block.stations.value)[rows],
        station_sigma=still(block.stations.sigma)[rows],
        roll_pitch_yaw=still(block.attitudes.roll_pitch_yaw)[turn],
        attitude_sigma=still(block.attitudes.sigma)[turn],
        mount=mount,
        bias=bias,
        exposure=exposure,
    )


@eqx.filter_jit
def direct_exterior(rows: SensorRows) -> ExteriorOrientation:
    """`georeferencing.direct_orientation` of all images of `rows`."""
    of_each = jax.vmap(lambda r: direct_orientation(r.station, r.roll_pitch_yaw, r.mount, r.bias, r.exposure))
    return of_each(rows)


def mountings(block: Block, unknowns: Unknowns) -> tuple[Mount, StripBias]:
    """Mount and strip bias of every image, with a leading axis over the images; zeros where an image has none.

    Where a camera's x axis points is part of `exposures`: a stack needs mounts of one kind.
    """
    none = jnp.zeros(3)
    mounts = {name: Mount(m.lever_arm, m.boresight, m.time_offset) for name, m in unknowns.mounts.items()}
    return (
        _by_name(mounts, block.image_mount, Mount(none, none)),
        _by_name(unknowns.strips, block.image_strip, StripBias(none, none)),
    )


def _by_name(table: dict, names: tuple[str, ...], absent):
    """The tree of each of `names` in one tree with a leading axis; `absent` where the table lacks it."""
    place = {name: k for k, name in enumerate(table)}
    index = np.array([place.get(name, len(place)) for name in names], int)
    return jax.tree.map(lambda *v: joined([still(x)[None] for x in v])[index], *table.values(), absent)


def exposures(block: Block) -> Exposure:
    """What is known of every exposure besides its observations, with a leading axis over the images."""
    none = np.zeros((len(block.images), 3))
    motion = block.motion if block.motion is not None else Motion(none, none)
    mounts = block.start.unknowns.mounts
    nominal = np.stack([mounts[name].nominal if name in mounts else NOMINAL["forward"] for name in block.image_mount])
    return Exposure(block.image_time, motion.velocity, motion.rate, nominal)  # type: ignore[arg-type]
