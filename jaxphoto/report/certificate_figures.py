"""The panels of a certificate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import Sensor
from jaxphoto.report.plots import drawn
from jaxphoto.stability import NORMAL_95, DistortionCurve

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_curve(axes: Axes, curve: DistortionCurve, factor: float) -> None:
    """Radial distortion in micrometres with the band of 95 %, and what is not radial."""
    um = 1e3
    if curve.sigma is not None:
        half = um * NORMAL_95 * factor * curve.sigma
        axes.fill_between(
            curve.r, um * curve.radial - half, um * curve.radial + half, color="#9ecae1", label="95 % band", lw=0
        )
    axes.plot(curve.r, um * curve.radial, "-", color="#08519c", label="radial")
    axes.plot(curve.r, um * curve.other, "--", color="#d95f02", label="decentring, affinity (RMS)")
    axes.axhline(0, color="0.6", lw=0.6)
    axes.set(xlabel="distance from the principal point [mm]", ylabel="measured - ideal [µm]")
    axes.set_title("distortion", loc="left", fontsize=9)
    axes.legend(fontsize=7)


def draw_band(axes: Axes, curve: DistortionCurve) -> None:
    """Half the width of the band by itself: beside the distortion it is often thinner than the line."""
    if curve.sigma is not None:
        axes.plot(curve.r, 1e3 * NORMAL_95 * curve.sigma, "-", color="#08519c")
    axes.set(xlabel="distance from the principal point [mm]", ylabel="95 % within +- [µm]", ylim=(0, None))
    axes.set_title("how sure the radial distortion is", loc="left", fontsize=9)


def draw_map(
    axes: Axes, sensor: Sensor, cells_mm: Float[np.ndarray, "cells 2"], values: Float[np.ndarray, cells], title: str
) -> None:
    """Numbers over the format as colours that differ in brightness, too, with lines that tell them."""
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    if np.ptp(values) > 1e-9 * max(np.abs(values).max(), 1e-300):
        coloured = axes.tricontourf(cells_mm[:, 0], cells_mm[:, 1], values, levels=10, cmap="cividis")
        bar = axes.figure.colorbar(coloured, ax=axes, shrink=0.8)
        bar.ax.tick_params(labelsize=7)
    else:
        axes.text(0, 0, f"{values.mean():.3g} everywhere", ha="center", fontsize=8)
    axes.plot([-w, w, w, -w, -w], [-h, -h, h, h, -h], color="0.4", lw=0.8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.set_title(title, loc="left", fontsize=9)


def draw_correlations(axes: Axes, names: list[str], rho: Float[np.ndarray, "n n"]) -> None:
    """Correlation coefficients as numbers on colours from blue to orange."""
    axes.imshow(rho, vmin=-1, vmax=1, cmap="PuOr", aspect="auto")
    axes.set_xticks(range(len(names)), list(map(drawn, names)), rotation=45, ha="right", fontsize=7)
    axes.set_yticks(range(len(names)), list(map(drawn, names)), fontsize=7)
    for i, j in np.ndindex(rho.shape):
        colour = "white" if abs(rho[i, j]) > 0.6 else "black"
        axes.text(j, i, f"{rho[i, j]:.2f}", ha="center", va="center", fontsize=6, color=colour)
    axes.set_title("correlation of the interior orientation", loc="left", fontsize=9)
