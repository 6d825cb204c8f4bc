"""Error ellipses of projection centres in plan, enlarged; colours say how sure their heights are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxphoto.report.plots import panels
from jaxphoto.report.tables import Tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Of the median ellipse's longer half axis, as a part of the block's extent: neighbours hardly overlap.
_AXIS = 0.03


def ellipse_axes(
    covariance: Float[np.ndarray, "n 2 2"],
) -> tuple[Float[np.ndarray, n], Float[np.ndarray, n], Float[np.ndarray, n]]:
    """Half axes a >= b of the curves d' covariance^-1 d = 1, and the direction of a from X towards Y (rad)."""
    variance, axes = np.linalg.eigh(covariance)
    # What is held comes out as zero or, by rounding, below it.
    b, a = np.sqrt(np.maximum(variance, 0.0)).T
    return a, b, np.arctan2(axes[:, 1, 1], axes[:, 0, 1])


def ellipses_figure(tables: Tables) -> Figure:
    """Standard error ellipses of the projection centres of all images."""
    figure, ((axes,),) = panels(6.4, 5.1, right=0.3)
    draw_error_ellipses(axes, tables)
    return figure


def draw_error_ellipses(axes: Axes, tables: Tables, unit: str = "m") -> None:
    """The same in a panel; a posteriori, of one sigma (39 % of errors in plan lie within)."""
    # Here, as in plots.py.
    from matplotlib.collections import EllipseCollection

    own = tables.covariance.positions * float(tables.covariance.variance_factor)
    at = np.asarray(tables.adjusted.unknowns.exterior.position)
    axes.plot(*at[:, :2].T, "+", ms=4, color="0.4")
    title = "error ellipses of projection centres"
    known = np.flatnonzero(np.isfinite(own).all(axis=(1, 2)))
    a, b, turn = ellipse_axes(own[known][:, :2, :2])
    if (a > 0).any():
        extent = max(float(np.ptp(at[:, :2], axis=0).max()), float(np.median(a[a > 0])))
        factor = max(1.0, float(f"{_AXIS * extent / np.median(a[a > 0]):.0e}"))
        drawn = EllipseCollection(
            2 * factor * a, 2 * factor * b, np.degrees(turn), units="xy", offsets=at[known, :2],
            offset_transform=axes.transData, array=np.sqrt(np.maximum(own[known, 2, 2], 0.0)),
            cmap="cividis", alpha=0.7,
        )  # fmt: skip
        axes.add_collection(drawn)
        reach = factor * a[:, None] * np.ones(2)
        axes.update_datalim(np.concatenate([at[known, :2] - reach, at[known, :2] + reach]))
        axes.autoscale_view()
        axes.figure.colorbar(drawn, ax=axes, shrink=0.8, label=f"sigma of Z [{unit}]")
        title += f", {factor:,.0f} times; largest {a.max():.2g} {unit}"
    axes.set(xlabel=f"X [{unit}]", ylabel=f"Y [{unit}]")
    axes.set_title(title, loc="left", fontsize=9)
    axes.set_aspect("equal", adjustable="datalim")
