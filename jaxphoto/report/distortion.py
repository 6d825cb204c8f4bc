"""Plots of the lens distortion of an adjusted camera: curve, 95 % band, uncertainty."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jaxphoto.block_edits import one_camera
from jaxphoto.camera import parameter_names
from jaxphoto.report.plots import axes_or_new, title
from jaxphoto.report.tables import Tables
from jaxphoto.stability import NORMAL_95, DistortionCurve, distortion_curve

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def distortion_of(tables: Tables, camera: str | None = None) -> DistortionCurve:
    """Return the distortion curve of a camera by radial distance, with a posteriori standard deviations."""
    name, a = one_camera(tables.adjusted.block, camera), tables.adjusted
    interior = a.unknowns.interior[name]
    covariance = tables.covariance.of_interior(name, parameter_names(interior))
    return distortion_curve(interior, a.block.sensors[name], covariance)


def plot_distortion(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw radial distortion by distance from the principal point with its 95 % band, and the non-radial distortion."""
    ax = axes_or_new(ax)
    draw_distortion(ax, distortion_of(tables, camera))
    return ax


def draw_distortion(axes: Axes, curve: DistortionCurve, factor: float = 1.0) -> None:
    """Draw radial distortion (um) with its 95 % band times `factor`, and the non-radial distortion."""
    um = 1e3
    if curve.sigma is not None:
        half = um * NORMAL_95 * factor * curve.sigma
        band = um * curve.radial - half, um * curve.radial + half
        axes.fill_between(curve.r, *band, color="#9ecae1", label="95 % band", lw=0)
    axes.plot(curve.r, um * curve.radial, "-", color="#08519c", label="radial")
    axes.plot(curve.r, um * curve.other, "--", color="#d95f02", label="decentring, affinity (RMS)")
    axes.axhline(0, color="0.6", lw=0.6)
    axes.set(xlabel="distance from the principal point [mm]", ylabel="measured - ideal [µm]")
    title(axes, "distortion")
    axes.legend(fontsize=7)


def plot_distortion_band(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the half width of the 95 % band of the radial distortion.

    In a plot of the curve the band is often thinner than the line.
    """
    ax, curve = axes_or_new(ax), distortion_of(tables, camera)
    if curve.sigma is not None:
        ax.plot(curve.r, 1e3 * NORMAL_95 * curve.sigma, "-", color="#08519c")
    ax.set(xlabel="distance from the principal point [mm]", ylabel="95 % within +- [µm]", ylim=(0, None))
    title(ax, "uncertainty of the radial distortion")
    return ax
