"""Maps of numbers over the format of a camera, and a picture as part of a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import Sensor
from jaxphoto.report.plots import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def format_maps(
    sensor: Sensor, cells_mm: Float[np.ndarray, "cells 2"], shown: Mapping[str, Float[np.ndarray, cells]]
) -> Figure:
    """One map beside the other, each under its name."""
    figure = new_figure(4.8 * len(shown), 3.9)
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    for axes, (name, values) in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown.items(), strict=True):
        coloured = axes.tricontourf(*cells_mm.T, values, levels=12, cmap="viridis")
        figure.colorbar(coloured, ax=axes, shrink=0.85)
        axes.plot([-w, w, w, -w, -w], [-h, -h, h, h, -h], color="0.4", lw=0.8)
        axes.set_title(name, loc="left", fontsize=10)
        axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    return figure


def png_of(figure: Figure) -> tuple[bytes, str]:
    """A picture as the content of a file, and as what an HTML page shows."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png")
    return drawn.getvalue(), png_uri(drawn.getvalue())


def png_uri(png: bytes) -> str:
    """A PNG as what an HTML page shows."""
    return "data:image/png;base64," + base64.b64encode(png).decode()
