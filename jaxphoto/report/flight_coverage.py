"""What a flight shows of the ground: overlap, rays a point, height, pixel size, area; in words and as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.report.plots import new_figure
from jaxphoto.statistics.coverage import Coverage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Rays beyond which points are counted together.
_MOST_RAYS = 15


def flight_words(coverage: Coverage | None, block: Block) -> dict[str, str]:
    """The flight in words; `coverage` is None where the block has no metres."""
    if coverage is None:
        return {"map system": "none: the block has a frame and a scale of its own"}
    height, gsd = np.nanmedian(coverage.height_m), np.nanmedian(coverage.gsd_m)
    code = block.frame.code
    return {
        "map system": f"EPSG:{code}, adjusted in a local frame" if code else "the local system of the control",
        "height over ground": f"{height:.4g} m (median), pixel there {100 * gsd:.3g} cm",
        "area": f"{coverage.area_m2(2) / 1e4:.3g} ha seen by two photographs or more",
    }


def coverage_figure(coverage: Coverage, adjusted: Adjustment) -> Figure:
    """How many photographs see each cell of the ground, and how many rays the points have."""
    figure = new_figure(9.6, 4.2)
    plan, rays = figure.subplots(1, 2, width_ratios=(2, 1))
    seen = np.ma.masked_less(coverage.seen_by, 1)
    drawn = plan.pcolormesh(coverage.x, coverage.y, seen, cmap="viridis", shading="nearest")
    figure.colorbar(drawn, ax=plan, label="photographs")
    station = np.asarray(adjusted.unknowns.exterior.position)
    plan.plot(station[:, 0], station[:, 1], "w+", ms=5, mew=0.8)
    plan.set(xlabel="X [m]", ylabel="Y [m]", aspect="equal")
    plan.set_title("photographs that see a place", loc="left", fontsize=10)
    number = np.bincount(np.minimum(np.bincount(adjusted.structure.point), _MOST_RAYS), minlength=_MOST_RAYS + 1)
    rays.bar(np.arange(2, _MOST_RAYS + 1), number[2:], color="tab:blue")
    rays.set(xlabel=f"rays of a point ({_MOST_RAYS}: or more)", ylabel="points", yscale="log")
    rays.set_title("rays", loc="left", fontsize=10)
    return figure
