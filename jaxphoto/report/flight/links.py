"""How photographs hang together: the network of those with common points, and its weakest links."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.errors import few
from jaxphoto.report.document import DocumentPicture, Element, Heading, Paragraph, Pictures, Rows
from jaxphoto.report.flight.part import PartReport
from jaxphoto.statistics.block_geometry import ImageLinks, WeakLink, image_links, weak_links

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = 5
# Of a class: more lines than these hide one another.
_LINES = 2000
_CLASSES = 5
# Share of the picture that lines may cover, which is so many points (of 1/72 inch) across: where photographs are linked
# with dozens of others, all lines are thinner.
_INK, _ACROSS = 0.5, 200.0
_THINNEST = 0.05


def links_section(report: PartReport) -> Iterator[Element]:
    """A picture of the network in plan, and where it would come apart first."""
    adjusted = report.part.adjusted
    links = image_links(adjusted)
    weak = weakest(adjusted, links)
    images = adjusted.block.images
    yield Heading("Links between photographs")
    of_one = np.bincount(np.concatenate([links.first, links.second]), minlength=len(images))
    yield Paragraph(
        f"{len(links.common)} pairs of photographs have points in common, {np.median(links.common):.0f} in the median; "
        f"a photograph is linked with {np.median(of_one):.0f} others, {images[int(of_one.argmin())]} with the fewest "
        f"({of_one.min()})."
    )
    yield Pictures(
        (
            DocumentPicture(
                partial(draw_network, adjusted=adjusted, links=links, weak=weak, unit=report.unit),
                f"Network of photographs in plan, {len(links.common)} links by their common points; weakest in red",
                4.4,
            ),
            DocumentPicture(partial(draw_strength, links=links), "Number of links by their common points"),
        )
    )
    yield Paragraph(
        "Of the strongest links that join all photographs these are the weakest: there the block would come apart "
        "first. Any other pair across has no more common points; points on both sides are those of all pairs across."
    )
    rows = tuple(
        (images[w.first], images[w.second], str(w.common), str(w.across), few([images[k] for k in w.side]))
        for w in weak
    )
    yield Rows(("photograph", "photograph", "common points", "points on both sides", "smaller side"), rows)


def weakest(adjusted: Adjustment, links: ImageLinks) -> list[WeakLink]:
    """Where the network would come apart first."""
    return weak_links(adjusted, links, _SHOWN)


def draw_network(axes: Axes, adjusted: Adjustment, links: ImageLinks, weak: list[WeakLink], unit: str = "m") -> None:
    """Stations in plan, and lines the wider and darker the more points two photographs share; the weakest in red.

    Of a class of many links an even part is drawn, which title and legend say.
    """
    station = np.asarray(adjusted.unknowns.exterior.position)[:, :2]
    limits = strength_classes(links.common)
    # Dark lines above light ones.
    lines = []
    for k, low in enumerate(limits):
        high = limits[k + 1] if k + 1 < len(limits) else np.inf
        own, one_in = thinned((links.common >= low) & (links.common < high))
        name = f"{low} or more" if np.isinf(high) else f"{low} to {high - 1}"
        lines.append((own, k / max(len(limits) - 1, 1), name if one_in == 1 else f"{name}: 1 in {one_in}"))
    way = np.linalg.norm(station[links.second] - station[links.first], axis=1)
    size = max(float(np.ptp(station, axis=0).max()), 1e-9)
    ink = sum(float(way[own].sum()) * _width(strong) for own, strong, _ in lines) / (size * _ACROSS)
    thinner = min(1.0, _INK / ink) if ink > 0 else 1.0
    for own, strong, name in lines:
        ends = np.stack([station[links.first[own]], station[links.second[own]], np.full((len(own), 2), np.nan)], axis=1)
        width = max(_THINNEST, thinner * _width(strong))
        axes.plot(*ends.reshape(-1, 2).T, "-", color=str(0.85 - 0.75 * strong), lw=width, label=name)
    for k, w in enumerate(weak):
        label = "weakest" if k == 0 else None
        axes.plot(*station[[w.first, w.second]].T, "--", color="tab:red", lw=1.2, label=label)
    axes.plot(*station.T, "o", ms=3, color="tab:blue")
    axes.legend(fontsize=6, title="common points", title_fontsize=6, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes.set(xlabel=f"X [{unit}]", ylabel=f"Y [{unit}]")
    shown, n = sum(len(own) for own, _, _ in lines), len(links.common)
    part = f": {shown} of {n} links" if shown < n else ""
    axes.set_title(f"photographs and their common points{part}", loc="left", fontsize=9)
    axes.set_aspect("equal", adjustable="datalim")


def _width(strong: float) -> float:
    """Of a line, in points, before all are made thinner alike."""
    return 0.3 + 2 * strong


def thinned(of_class: Bool[np.ndarray, pairs]) -> tuple[Int[np.ndarray, shown], int]:
    """Which links of a class are drawn, from all of its photographs alike, and that they are one in how many."""
    own = np.flatnonzero(of_class)
    one_in = max(1, -(-len(own) // _LINES))
    return own[::one_in], one_in


def strength_classes(common: Int[np.ndarray, pairs]) -> list[int]:
    """From how many common points on each class of links is, the weakest first: from 1, by about the same factor."""
    return sorted({int(v) for v in np.geomspace(1, max(common.max() / 2, 1), _CLASSES).round()})


def draw_strength(axes: Axes, links: ImageLinks) -> None:
    """How many links have how many common points."""
    edges = np.unique(np.geomspace(1, max(links.common.max(), 2) + 1, 16).round())
    number, _ = np.histogram(links.common, edges)
    axes.bar(edges[:-1], number, width=np.diff(edges), align="edge", color="tab:blue", edgecolor="white", lw=0.5)
    axes.set(xscale="log", xlabel="common points of two photographs", ylabel="pairs")
    axes.set_title("how strong links are", loc="left", fontsize=9)
