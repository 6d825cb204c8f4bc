"""A bundle of rays: the grid in the image that it starts from, and the interior orientation that makes it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.arrays import Numbers
from jaxphoto.camera import InteriorOrientation, Sensor, get_parameter, parameter_names, set_parameter


def image_grid(
    sensor: Sensor, columns: int = 15, rows: int = 11, extent_mm: tuple[float, float] | None = None
) -> Float[np.ndarray, "points 2"]:
    """Measured image points (mm from the image centre) of a regular grid, row by row from the lower left.

    `columns` x `rows` points reach from edge to edge of the format, or of a centred rectangle `extent_mm` (width and
    height). Raises ValueError for fewer than 2 columns or rows, and for an extent that is not positive.
    """
    if columns < 2 or rows < 2:
        raise ValueError(f"a grid has 2 columns and 2 rows at least, got {columns} x {rows}")
    width, height = extent_mm if extent_mm is not None else (sensor.width_mm, sensor.height_mm)
    if not (width > 0 and height > 0):
        raise ValueError(f"the extent of a grid is positive, got {width:g} x {height:g} mm")
    x, y = np.linspace(-width / 2, width / 2, columns), np.linspace(-height / 2, height / 2, rows)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def image_rays(interior: InteriorOrientation, points: Float[Numbers, "points 2"]) -> Float[Array, "points 3"]:
    """The bundle of rays: (x', y', -c) in mm, in the camera frame, of measured image points (mm from the centre).

    x' is the distortion-free coordinate from the principal point, on the virtual image plane at distance c, whatever
    the projection: that of rays within 90 degrees of the axis.
    """

    def ray(xy):
        u, v, w = interior.direction_from_ideal(interior.ideal_from_measured(xy))
        longer = -interior.c / w
        return jnp.stack([u * longer, v * longer, -jnp.asarray(interior.c, float)])

    return jax.vmap(ray)(jnp.asarray(points, float))


def parameter_vector(interior: InteriorOrientation) -> Float[Array, "parameters"]:
    """The values of `jaxphoto.camera.parameter_names`, in their order and units."""
    return jnp.stack([jnp.asarray(get_parameter(interior, name), float) for name in parameter_names(interior)])


def with_parameters(interior: InteriorOrientation, vector: Float[Array, "parameters"]) -> InteriorOrientation:
    """`interior` with the values of a `parameter_vector`; constants of its model stay."""
    for name, value in zip(parameter_names(interior), vector, strict=True):
        interior = set_parameter(interior, name, value)
    return interior
