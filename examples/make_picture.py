"""Draw the picture of the README: the example block, its image residuals and its correlations.

    python examples/make_picture.py [PNG]

The default is docs/images/cross_block.png.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxphoto import Tables, adjust, read_block

HERE = Path(__file__).resolve().parent
BLUE, RED, GREEN, GREY = "#1f5fa8", "#c0392b", "#2e7d32", "0.72"


def main(path: Path) -> None:
    """Adjust the example and draw three panels."""
    tables = Tables(adjust(read_block(HERE / "cross_block")))
    figure = Figure(figsize=(11.5, 3.9), dpi=110, layout="constrained")
    layout, residuals, correlation = figure.subplots(1, 3, width_ratios=(1, 1.25, 1.15))
    draw_layout(layout, tables)
    draw_residuals(residuals, tables)
    draw_correlation(correlation, tables)
    for axes in (layout, residuals, correlation):
        axes.tick_params(labelsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Software": None})


def draw_layout(axes, tables: Tables) -> None:
    """Plan: exposures in their strips, points."""
    block, unknowns = tables.adjusted.block, tables.adjusted.unknowns
    points, stations = np.asarray(unknowns.points), np.asarray(unknowns.exterior.position)
    axes.plot(*points[:, :2].T, ".", ms=3, color=GREY, label="tie point")
    for strip in dict.fromkeys(block.image_strip):
        mine = np.array([s == strip for s in block.image_strip])
        axes.plot(*stations[mine, :2].T, "-", lw=0.8, color=BLUE, alpha=0.5)
    axes.plot(*stations[:, :2].T, "+", ms=7, color=BLUE, label="exposure")
    axes.plot(*points[np.unique(block.control.who), :2].T, "^", ms=5, color=RED, label="control point")
    axes.plot(*points[np.unique(block.check.who), :2].T, "s", ms=4, mfc="none", color=GREEN, label="check point")
    axes.set(xlabel="X [m]", ylabel="Y [m]", xlim=(-1800, 1800), ylim=(-1800, 1800), aspect="equal")
    axes.set_title("block", fontsize=10)
    axes.legend(fontsize=6.5, loc="lower left", handletextpad=0.2, borderpad=0.3)


def draw_residuals(axes, tables: Tables) -> None:
    """Residual vectors of all images over the format."""
    adjusted = tables.adjusted
    rows, sensor = adjusted.block.image_points, adjusted.block.sensors["kodak"]
    table = tables.residuals
    of_images = table[table["group"] == "image_points"]
    v = np.stack([of_images.loc[of_images["axis"] == a, "residual"].to_numpy() for a in "xy"])
    arrows = axes.quiver(
        *np.asarray(rows.xy).T, *v, angles="xy", scale_units="xy", scale=0.006, width=0.0022, color=BLUE
    )
    axes.quiverkey(arrows, 0.85, 1.045, 0.01, "10 µm", labelpos="E", fontproperties={"size": 8})
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    axes.plot([-w, w, w, -w, -w], [-h, -h, h, h, -h], color="0.4", lw=0.8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]")
    axes.set_title("image residuals", fontsize=10)
    axes.set_aspect("equal")


def draw_correlation(axes, tables: Tables) -> None:
    """Mean |rho| of exterior and interior orientation over the images."""
    summary = tables.correlation_summary
    mean = summary.pivot(index="exterior", columns="interior", values="mean_abs_rho")
    mean = mean.loc[summary["exterior"].unique(), summary["interior"].unique()]
    axes.imshow(mean, vmin=0, vmax=1, cmap="Blues", aspect="auto")
    axes.set_xticks(range(mean.shape[1]), [name.removesuffix("_mm") for name in mean.columns])
    axes.set_yticks(range(mean.shape[0]), mean.index)
    for i, j in np.ndindex(mean.shape):
        value = mean.iloc[i, j]
        axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=8, color="white" if value > 0.6 else "black")
    axes.set_title("mean |correlation| of EOP and IOP", fontsize=10)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE.parent / "docs" / "images" / "cross_block.png")
