"""What a block holds besides its observations: datum, motion of the sensors, frame, start values."""

import dataclasses
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import Numbers
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.short_repr import shown
from jaxphoto.static_values import StaticArray
from jaxphoto.unknowns import Unknowns


@shown
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


@shown
class Motion(eqx.Module):
    """How the GNSS/IMU moves at each exposure, for a time offset to act on (`georeferencing.Exposure`)."""

    velocity: Float[Numbers, "images 3"]
    """In the object frame, m/s."""
    rate: Float[Numbers, "images 3"]
    """About the body's right, forward and up axes, rad/s."""


@shown
class Temperatures(eqx.Module):
    """Of the camera at each exposure, for `camera.ThermalRates`."""

    celsius: Float[Numbers, "images"]
    """NaN where it is not known: there the interior orientation is taken to be that of the reference."""
    reference_c: float = eqx.field(static=True)
    """At which the interior orientation holds."""

    @property
    def above(self) -> Float[Numbers, "images"]:
        """Kelvins above the reference."""
        return jnp.where(jnp.isnan(self.celsius), 0.0, self.celsius - self.reference_c)


@shown
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


@shown
class Start(eqx.Module):
    """Approximate unknowns, and which images and points they are truly known for.

    The arrays of unknown images and points hold zeros (identity rotations) until approximations are found.
    """

    unknowns: Unknowns
    image_known: np.ndarray = eqx.field(converter=StaticArray)
    point_known: np.ndarray = eqx.field(converter=StaticArray)
