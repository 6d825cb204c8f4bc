"""Maps of numbers over the format of a camera, and a picture as part of a page."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import Sensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_format_map(
    axes: Axes, sensor: Sensor, cells_mm: Float[np.ndarray, "cells 2"], name: str, values: Float[np.ndarray, cells]
) -> None:
    """A map over the format, coloured between its cells; `name` says what is shown, with its unit."""
    if np.ptp(values) > 0:
        coloured = axes.tricontourf(cells_mm[:, 0], cells_mm[:, 1], values, levels=12, cmap="viridis")
        axes.figure.colorbar(coloured, ax=axes, shrink=0.85, label=name)
    outline(axes, sensor)
    axes.set_title(name, loc="left", fontsize=10)


def outline(axes: Axes, sensor: Sensor) -> None:
    """The format of a camera on axes of millimetres from its centre."""
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    axes.plot([-w, w, w, -w, -w], [-h, -h, h, h, -h], color="0.4", lw=0.8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")


def png_of(figure: Figure) -> tuple[bytes, str]:
    """A picture as the content of a file, and as what an HTML page shows."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png")
    return drawn.getvalue(), png_uri(drawn.getvalue())


def png_uri(png: bytes) -> str:
    """A PNG as what an HTML page shows."""
    return "data:image/png;base64," + base64.b64encode(png).decode()
