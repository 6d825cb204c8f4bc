"""What a flight shows of the ground: overlap, height, pixel size, area; in words and as pictures."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.report.document import DocumentPicture, Element, Heading, Paragraph, Pictures, Rows
from jaxphoto.report.flight.part import PartReport
from jaxphoto.statistics.block_geometry import Coverage

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Rays beyond which points are counted together.
_MOST_RAYS = 15
# Photographs that see a place, of the table of areas.
_SEEN_BY = (1, 2, 3, 5, 9)
_HECTARE = 1e4


def flight_words(coverage: Coverage | None, block: Block) -> dict[str, str]:
    """The flight in words; `coverage` is None where the block has no metres."""
    if coverage is None:
        return {"map system": "none: the block has a frame and a scale of its own"}
    height, gsd = np.nanmedian(coverage.height_m), np.nanmedian(coverage.gsd_m)
    code = block.frame.code
    return {
        "map system": f"EPSG:{code}, adjusted in a local frame" if code else "the local system of the control",
        "height over ground": f"{height:.4g} m (median), pixel there {100 * gsd:.3g} cm",
        "area": f"{coverage.area_m2(2) / _HECTARE:.3g} ha seen by two photographs or more",
    }


def coverage_section(report: PartReport) -> Iterator[Element]:
    """Areas by overlap, ranges of height and pixel, a map, and how many rays points have."""
    yield Heading("Coverage and overlap")
    found, adjusted = report.coverage, report.part.adjusted
    rays = DocumentPicture(partial(draw_rays, adjusted=adjusted), "Number of points by number of rays", 4.2)
    if found is None:
        yield Paragraph("The block has a frame and a scale of its own: no heights, pixel sizes or areas are known.")
        yield Pictures((rays,))
        return
    low, middle, high = np.nanpercentile(found.height_m, [0, 50, 100])
    yield Paragraph(
        f"Height over ground {middle:.4g} m (median; {low:.4g} to {high:.4g} m), pixel on the ground "
        f"{100 * np.nanmedian(found.gsd_m):.3g} cm ({100 * np.nanmin(found.gsd_m):.3g} to "
        f"{100 * np.nanmax(found.gsd_m):.3g} cm)."
    )
    areas = tuple((f"{n} or more", f"{found.area_m2(n) / _HECTARE:.3g} ha") for n in _SEEN_BY)
    yield Rows(("photographs that see a place", "area"), areas)
    yield Pictures(
        (
            DocumentPicture(
                partial(draw_overlap, coverage=found, adjusted=adjusted),
                f"Map of how many photographs see each place of the ground, {found.seen_by.max()} at most",
                4.2,
            ),
            rays,
        )
    )


def draw_overlap(axes: Axes, coverage: Coverage, adjusted: Adjustment) -> None:
    """How many photographs see each cell of the ground."""
    seen = np.ma.masked_less(coverage.seen_by, 1)
    x, y = (np.append(v - coverage.step_m / 2, v[-1] + coverage.step_m / 2) for v in (coverage.x, coverage.y))
    shown = axes.pcolormesh(x, y, seen, cmap="viridis")
    axes.figure.colorbar(shown, ax=axes, label="photographs", shrink=0.8)
    station = np.asarray(adjusted.unknowns.exterior.position)
    axes.plot(station[:, 0], station[:, 1], "w+", ms=5, mew=0.8)
    axes.set(xlabel="X [m]", ylabel="Y [m]", aspect="equal")
    axes.set_title("photographs that see a place", loc="left", fontsize=9)


def draw_rays(axes: Axes, adjusted: Adjustment) -> None:
    """How many points have how many rays."""
    number = np.bincount(np.minimum(np.bincount(adjusted.structure.point), _MOST_RAYS), minlength=_MOST_RAYS + 1)
    axes.bar(np.arange(2, _MOST_RAYS + 1), number[2:], color="tab:blue")
    axes.set(xlabel=f"rays of a point ({_MOST_RAYS}: or more)", ylabel="points", yscale="log")
    axes.set_title("points by number of rays", loc="left", fontsize=9)
