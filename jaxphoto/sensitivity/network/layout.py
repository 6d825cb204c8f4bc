"""A photogrammetric network on paper: where cameras and ground points are to be, and with which weights.

A `Layout` has what a covariance needs and nothing that was measured. A design is any tree of numbers (headings,
heights, the place of a control point, shares of a budget), and a pure function of the user makes a `Layout` of it.
Frames, signs and units: docs/conventions.md.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.arrays import Numbers
from jaxphoto.camera import InteriorOrientation, Sensor, parameter_names
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError


class Layout(eqx.Module):
    """Images of one camera over ground points, with the weights of everything that is to be observed.

    A weight is 1 / sigma^2, zero for what is not observed, and may be traced: a budget can be shared out. Weights of
    fewer axes than named are those of all. The interior parameters in `free` (names as in block.toml) are unknown, the
    others held; so are all exterior orientations and points.
    """

    interior: InteriorOrientation
    exterior: ExteriorOrientation
    points: Float[Array, "points 3"]
    """m; control points among them."""
    image_weight: Float[Numbers, "..."] | float
    """Of both image coordinates, by image; 1 / mm^2."""
    control_weight: Float[Numbers, "..."] | float = 0.0
    """Of X, Y, Z by point; 1 / m^2."""
    station_weight: Float[Numbers, "..."] | float = 0.0
    """Of X, Y, Z of the projection centre by image; 1 / m^2."""
    attitude_weight: Float[Numbers, "..."] | float = 0.0
    """Of roll, pitch, yaw by image, the camera's x axis pointing forward; 1 / rad^2."""
    sensor: Sensor = eqx.field(static=True, kw_only=True)
    free: tuple[str, ...] = eqx.field(static=True, default=("c_mm", "xp_mm", "yp_mm"))
    edge_mm: float = eqx.field(static=True, default=1.0)
    """Over this width about the edge of the format, half of it inside, the weight of an image point falls smoothly from
    full to none: a layout can be differentiated where points come into an image."""

    def __check_init__(self) -> None:
        known = parameter_names(self.interior)
        if unknown := [name for name in self.free if name not in known]:
            raise InputError(f"{unknown[0]} is no parameter of this camera; choose among {', '.join(known)}")
        if not self.edge_mm > 0:
            raise InputError(f"edge_mm is the positive width of the edge of the format, got {self.edge_mm}")

    @property
    def by_image(self) -> tuple[Float[Array, "images"], Float[Array, "images 3"], Float[Array, "images 3"]]:
        """Weights of image coordinates, of stations and of attitudes, for every image."""
        n = len(self.exterior.position)
        weights = (self.image_weight, (n,)), (self.station_weight, (n, 3)), (self.attitude_weight, (n, 3))
        image, station, attitude = (jnp.broadcast_to(jnp.asarray(w, float), shape) for w, shape in weights)
        return image, station, attitude

    @property
    def by_point(self) -> Float[Array, "points 3"]:
        """Weights of control coordinates, for every point."""
        return jnp.broadcast_to(jnp.asarray(self.control_weight, float), self.points.shape)
