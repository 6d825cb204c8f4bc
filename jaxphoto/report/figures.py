"""The pictures of the report of an adjustment, one by one, for notebooks: each takes and returns matplotlib axes.

`ax` are any axes that matplotlib made; where there are none, those of a new figure. `camera` may be left out where the
block has one camera.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from jaxphoto.block_edits import one_camera
from jaxphoto.camera import parameter_names
from jaxphoto.errors import InputError
from jaxphoto.report.certificate_figures import draw_band, draw_curve
from jaxphoto.report.convergence import draw_sigma_naught, draw_steps
from jaxphoto.report.error_ellipses import draw_error_ellipses
from jaxphoto.report.object_points import draw_angles, draw_sigmas
from jaxphoto.report.plots import (
    axes_or_new,
    draw_check_points,
    draw_density,
    draw_exterior_correlation,
    draw_interior_correlation,
    draw_mean_residuals,
    draw_residuals,
)
from jaxphoto.report.residual_plots import draw_residuals_by_radius, draw_station_residuals
from jaxphoto.report.sigma_map import draw_sigma_map
from jaxphoto.report.tables import Tables
from jaxphoto.stability import DistortionCurve, distortion_curve
from jaxphoto.statistics.sigma_map import sigma_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def _drawn(draw: Callable[[Axes, Tables, str], object], tables: Tables, camera: str | None, ax: Axes | None) -> Axes:
    ax = axes_or_new(ax)
    draw(ax, tables, one_camera(tables.adjusted.block, camera))
    return ax


def plot_residuals(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Image residuals over the format of a camera, all images together."""
    return _drawn(draw_residuals, tables, camera, ax)


def plot_mean_residuals(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Means of the residuals by cell of the format: what all images have in common."""
    return _drawn(draw_mean_residuals, tables, camera, ax)


def plot_density(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """How many image points lie in each cell of the format."""
    return _drawn(draw_density, tables, camera, ax)


def plot_residuals_by_radius(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Mean radial and tangential residuals by distance from the principal point, with bars of two sigmas."""
    return _drawn(draw_residuals_by_radius, tables, camera, ax)


def plot_station_residuals(tables: Tables, ax: Axes | None = None) -> Axes:
    """Residuals of camera stations in the order of the flight. Raises InputError where none was observed."""
    if not len(tables.adjusted.block.stations.who):
        raise InputError("the block has no observed stations to be drawn")
    ax = axes_or_new(ax)
    draw_station_residuals(ax, tables)
    return ax


def plot_check_points(tables: Tables, ax: Axes | None = None, *, upright: bool = False) -> Axes:
    """Discrepancies at check points, surveyed minus computed: in plan, or in height where `upright`.

    Raises InputError where there are no check points.
    """
    if not len(tables.check_points):
        raise InputError("the block has no check points to be drawn")
    ax = axes_or_new(ax)
    draw_check_points(ax, tables, upright)
    return ax


def plot_interior_correlation(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Correlation of the interior orientation with itself."""
    return _drawn(draw_interior_correlation, tables, camera, ax)


def plot_exterior_correlation(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Mean absolute correlation of exterior and interior orientation over the images."""
    return _drawn(draw_exterior_correlation, tables, camera, ax)


def plot_error_ellipses(tables: Tables, ax: Axes | None = None) -> Axes:
    """Standard error ellipses of the projection centres in plan, enlarged; their colours are sigmas in height."""
    ax = axes_or_new(ax)
    draw_error_ellipses(ax, tables)
    return ax


def plot_convergence(tables: Tables, ax: Axes | None = None, *, steps: bool = False) -> Axes:
    """Sigma naught by iteration, or the length of each of the `steps`. Raises InputError where nothing was iterated."""
    if tables.adjusted.course is None:
        raise InputError("of this adjustment no iteration is known: adjust the block to draw its convergence")
    ax = axes_or_new(ax)
    (draw_steps if steps else draw_sigma_naught)(ax, tables.adjusted)
    return ax


def plot_intersection_angles(tables: Tables, ax: Axes | None = None) -> Axes:
    """How many object points have rays that meet at which angle."""
    ax = axes_or_new(ax)
    draw_angles(ax, tables.object_points["angle_deg"].dropna().to_numpy())
    return ax


def plot_point_sigmas(tables: Tables, ax: Axes | None = None) -> Axes:
    """How many object points have which standard deviation, by axis."""
    ax, points = axes_or_new(ax), tables.object_points
    draw_sigmas(ax, points[points["n_images"] > 0], "m")
    return ax


def plot_sigma_map(
    tables: Tables, camera: str | None = None, ax: Axes | None = None, *, distance_m: float = float("inf")
) -> Axes:
    """How sure the camera is of where it sees a point at a distance, over its format (`jaxphoto.sigma_map`)."""
    name = one_camera(tables.adjusted.block, camera)
    one = sigma_map(tables.adjusted, name, distance_m=distance_m)
    return draw_sigma_map(axes_or_new(ax), tables.adjusted.block.sensors[name], one)


def plot_distortion(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Radial distortion against the distance from the principal point, with its 95 % band, and the rest of it."""
    ax = axes_or_new(ax)
    draw_curve(ax, curve_of(tables, camera), 1.0)
    return ax


def plot_distortion_band(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Half the width of the 95 % band of the radial distortion against the distance from the principal point."""
    ax = axes_or_new(ax)
    draw_band(ax, curve_of(tables, camera))
    return ax


def curve_of(tables: Tables, camera: str | None = None) -> DistortionCurve:
    """The distortion of a camera by distance, with its standard deviations a posteriori."""
    name, a = one_camera(tables.adjusted.block, camera), tables.adjusted
    interior = a.unknowns.interior[name]
    covariance = tables.covariance.of_interior(name, parameter_names(interior))
    return distortion_curve(interior, a.block.sensors[name], covariance)


# All that is defined here, for the rooms that show it.
__all__ = [name for name in dir() if name.startswith("plot_")]
