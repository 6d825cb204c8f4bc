"""The block: observations as rows, and who observed what.

A row of `Rows` is (who, axis, value, sigma). "Vertical control" is then rows with axis 2: there is no NaN and no
infinite sigma, and the redundancy is a count. Units are metres, radians and millimetres on the image.
"""

import dataclasses
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.arrays import Numbers
from jaxphoto.camera import Sensor
from jaxphoto.georeferencing import NOMINAL, Corrections, Exposure
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
    Cartesian frame. `epsg`: files in the system `code` with heights of `vertical` were brought to the local
    east-north-up frame whose origin is (longitude, latitude in degrees, ellipsoidal height in m).
    """

    kind: Literal["local", "enu", "grid", "epsg"] = "local"
    code: int | None = None
    vertical: int | None = None
    origin: tuple[float, float, float] | None = None


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


def exposures(block: Block) -> Exposure:
    """What is known of every exposure besides its observations, with a leading axis over the images."""
    still = np.zeros((len(block.images), 3))
    motion = block.motion if block.motion is not None else Motion(still, still)
    mounts = block.start.unknowns.mounts
    nominal = np.stack([mounts[name].nominal if name in mounts else NOMINAL["forward"] for name in block.image_mount])
    return Exposure(block.image_time, motion.velocity, motion.rate, nominal)  # type: ignore[arg-type]
