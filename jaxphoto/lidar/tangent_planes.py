"""Tangent planes of a cloud's surface, on which points are observed to lie."""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int, Integer

from jaxphoto.lidar.grid import Grid, nearest
from jaxphoto.lidar.height_settings import HeightSettings
from jaxphoto.lidar.heights import Method, heights_at


class TangentPlanes(eqx.Module):
    """Planes at places; NaN where the cloud does not determine the surface (see `heights_at`)."""

    foot: Float[np.ndarray, "places 3"]
    """Point on the surface above or below the place (m)."""
    normal: Float[np.ndarray, "places 3"]
    """Unit vectors, upwards."""
    sigma: Float[np.ndarray, "places"]
    """Standard deviation of the surface along the normal (m)."""
    flag: Integer[np.ndarray, "places"]
    """Sums of `HeightFlag`."""
    nearest: Int[np.ndarray, "places"]
    """Laser point nearest to the place, in the order of the cloud."""


def tangent_planes(
    grid: Grid, xy: Float[np.ndarray, "places 2"], method: Method, settings: HeightSettings
) -> TangentPlanes:
    """Return the tangent planes of the surface at places X, Y (m).

    With the gradient g of the surface, the normal is (-g, 1) / sqrt(1 + g.g), and its height error is projected
    accordingly. Raises what `heights_at` raises.
    """
    heights = heights_at(grid, xy, method, settings)
    normal = np.column_stack([-heights.gradient, np.ones(len(xy))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[np.isnan(heights.z)] = np.nan
    found = nearest(grid, xy, 1).index[:, 0]
    return TangentPlanes(
        np.column_stack([xy, heights.z]),
        normal,
        np.asarray(heights.sigma) * normal[:, 2],
        np.asarray(heights.flag),
        np.asarray(grid.order)[found],
    )
