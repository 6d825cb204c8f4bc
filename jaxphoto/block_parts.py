"""Parts of a block other than observations: datum, sensor motion, frame, start values."""

import dataclasses
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.short_repr import pretty_repr
from jaxphoto.static_values import StaticArray
from jaxphoto.unknowns import Unknowns


@pretty_repr
@dataclasses.dataclass(frozen=True)
class Datum:
    """Definition of position, orientation and scale where observations leave them undetermined.

    `control`: the observations must determine them. `minimal`: the minimum number of point coordinates fixed at their
    start values. `inner`: inner constraints over all points, all images or the named points (`over`); `scale` None
    means "constrain the scale if it is undetermined".
    """

    kind: Literal["control", "minimal", "inner"] = "control"
    over: Literal["points", "images"] | tuple[str, ...] = "points"
    scale: bool | None = None


@pretty_repr
class Motion(eqx.Module):
    """Motion of the GNSS/IMU at each exposure, for time offsets (`georeferencing.Exposure`)."""

    velocity: Float[ArrayLike, "images 3"]
    """In the object frame, m/s."""
    rate: Float[ArrayLike, "images 3"]
    """About the body's right, forward and up axes, rad/s."""


@pretty_repr
class Temperatures(eqx.Module):
    """Camera temperature at each exposure, for `camera.ThermalRates`."""

    celsius: Float[ArrayLike, "images"]
    """NaN if unknown: the reference temperature is assumed."""
    reference_c: float = eqx.field(static=True)
    """Temperature to which the interior orientation refers."""

    @property
    def above(self) -> Float[ArrayLike, "images"]:
        """Temperature difference from the reference (K)."""
        return jnp.where(jnp.isnan(self.celsius), 0.0, self.celsius - self.reference_c)


@pretty_repr
@dataclasses.dataclass(frozen=True)
class Frame:
    """Object frame of a block, and the conversion to the frame of its files.

    `local`, `enu`: Cartesian, as in the files. `grid`: map-grid coordinates without conversion, which is not a
    Cartesian frame. `epsg`: files in the EPSG system `code`, with heights of the EPSG system `vertical` (None: above
    the ellipsoid) and yaw from true or grid north, converted to the local east-north-up frame whose origin is
    (longitude, latitude in degrees, ellipsoidal height in m).
    """

    kind: Literal["local", "enu", "grid", "epsg"] = "local"
    code: int | None = None
    vertical: int | None = None
    yaw: Literal["true", "grid"] = "true"
    origin: tuple[float, float, float] | None = None

    @property
    def map(self) -> MapFrame:
        """Conversion to and from the map coordinates of the files; for kind `epsg` only."""
        if self.code is None or self.origin is None:
            raise ValueError(f"{self} has no map coordinates; use a frame of kind epsg with an origin")
        return MapFrame(self.code, self.vertical, self.origin)


@pretty_repr
class Start(eqx.Module):
    """Approximate unknowns, and masks of images and points with known values.

    Arrays of unknown images and points are zero (identity rotations) until approximations are computed.
    """

    unknowns: Unknowns
    image_known: np.ndarray = eqx.field(converter=StaticArray)
    point_known: np.ndarray = eqx.field(converter=StaticArray)
