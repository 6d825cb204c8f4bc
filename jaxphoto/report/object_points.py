"""Object points: by how many rays, at which angles, how sure they are."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from jaxphoto.report.digits import of_sigma
from jaxphoto.report.document import DocumentPicture, Element, Heading, Paragraph, Pictures, Rows
from jaxphoto.report.plots import log_ticks
from jaxphoto.report.tables import Tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Of the table: numbers of rays from each to below the next.
_FROM = (2, 3, 4, 6, 11, 21)
# Below it, an error of a ray is tens of times as much in depth.
_SMALL_DEG = 2.0


def points_section(tables: Tables, unit: str = "m") -> Iterator[Element]:
    """Rays, angles and standard deviations of the points that images measured, as a table and pictures."""
    yield Heading("Object points")
    table = tables.object_points
    table = table[table["n_images"] > 0]
    if table.empty:
        yield Paragraph("No image measured a point.")
        return
    angle = table["angle_deg"]
    rows = []
    for low, high in zip(_FROM, (*_FROM[1:], np.inf), strict=True):
        of = table[(table["n_images"] >= low) & (table["n_images"] < high)]
        if len(of):
            name = str(low) if high == low + 1 else f"{low} to {high - 1}" if np.isfinite(high) else f"{low} or more"
            rows.append((name, *_row(of, len(table))))
    rows.append(("all", *_row(table, len(table))))
    columns = ("rays", "points", "share", "median angle [deg]", *(f"median sigma {a} [{unit}]" for a in "XYZ"))
    yield Rows(columns, tuple(rows))
    small = int((angle < _SMALL_DEG).sum())
    in_z = table["sigma_Z_m"][table["sigma_Z_m"] > 0]
    sigmas = (
        f"Standard deviations are a posteriori; 95 % of points have less than {in_z.quantile(0.95):.3g} {unit} in Z."
        if len(in_z)
        else "All of them are held."
    )
    yield Paragraph(
        f"A point has {table['n_images'].mean():.2f} rays on average. The angle is the largest between two rays of a "
        f"point; of {small or 'no'} points it is below {_SMALL_DEG:g} degrees. {sigmas}"
    )
    angles = DocumentPicture(partial(draw_angles, angle=angle.dropna().to_numpy()), "Histogram of intersection angles")
    scatter = DocumentPicture(
        partial(draw_sigmas, table=table, unit=unit), f"Histograms of standard deviations of points in {unit}"
    )
    yield Pictures((angles, scatter) if len(in_z) else (angles,))


def _row(of: pd.DataFrame, n: int) -> tuple[str, ...]:
    sigmas = (of_sigma(of[f"sigma_{axis}_m"].median()) for axis in "XYZ")
    return str(len(of)), f"{100 * len(of) / n:.1f} %", f"{of['angle_deg'].median():.1f}", *sigmas


def draw_angles(axes: Axes, angle: np.ndarray) -> None:
    """How many points have their widest rays at which angle."""
    axes.hist(angle, bins=45, color="tab:blue")
    axes.set(xlabel="largest angle between rays [deg]", ylabel="points")
    axes.set_title("intersection angles", loc="left", fontsize=9)


def draw_sigmas(axes: Axes, table: pd.DataFrame, unit: str) -> None:
    """How many points have which standard deviation, by axis, up to that which 99 % keep."""
    sigma = table[[f"sigma_{a}_m" for a in "XYZ"]].to_numpy()
    known = sigma[np.isfinite(sigma) & (sigma > 0)]
    if len(known):
        low, high = np.percentile(known, [0.5, 99])
        bins = np.geomspace(low, high, 40)
        for k, (axis, line) in enumerate(zip("XYZ", ("-", "--", ":"), strict=True)):
            axes.hist(sigma[:, k], bins=bins.tolist(), histtype="step", ls=line, label=axis)
        log_ticks(axes)
        axes.legend(fontsize=7)
    axes.set(xlabel=f"sigma [{unit}]", ylabel="points")
    axes.set_title("standard deviations of points", loc="left", fontsize=9)
