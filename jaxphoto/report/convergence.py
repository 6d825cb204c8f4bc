"""How an adjustment converged, step by step, and what ended it."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from jaxphoto.adjustment import TOLERANCE, Adjustment, Outcome
from jaxphoto.errors import counted
from jaxphoto.report.convergence_table import convergence_table
from jaxphoto.report.document import DocumentPicture, Element, Heading, Paragraph, Pictures, rows_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Rows and ticks that are still read.
_SHOWN = 40
# Ratio of sigmas naught from which on powers of ten are what they are read by.
_MUCH = 3.0


def convergence_words(adjusted: Adjustment) -> str:
    """What ended the iteration, with the numbers that it was told by."""
    course, n = adjusted.course, int(adjusted.steps)
    if course is None or not n:
        return ""
    refused = int((course.accepted == 0).sum())
    again = f", {refused} of them refused and tried again with more damping" if refused else ""
    bent = int(((course.bent > 0) & (course.accepted > 0)).sum())
    along = f", {bent} of them along a curve (weakly determined unknowns)" if bent else ""
    said = f"{counted(n, 'step')}{along}{again}"
    last = course.length[-1] if len(course.length) == n else np.nan
    if adjusted.outcome is Outcome.CONVERGED:
        return f"{said}. The last moved no unknown by more than {last:.1e} of its standard deviation: that ended it."
    if adjusted.outcome is Outcome.STEPS:
        moved = f"; the last would still move unknowns by up to {last:.2g} of their sigmas" if np.isfinite(last) else ""
        return f"{said}, which is the limit (--max-steps){moved}."
    return f"{said}. {adjusted.outcome.value.partition(': ')[2]}."


def convergence_section(adjusted: Adjustment) -> Iterator[Element]:
    """Sentence, pictures and table; nothing of what was not iterated."""
    table = convergence_table(adjusted)
    if table.empty:
        return
    yield Heading("Convergence")
    yield Paragraph(convergence_words(adjusted))
    panels = (
        DocumentPicture(partial(draw_sigma_naught, adjusted=adjusted), "sigma naught before each step, and at the end"),
        DocumentPicture(partial(draw_steps, adjusted=adjusted), "length of each step, and where it is short enough"),
    )
    yield Pictures(panels)
    yield rows_of(table.tail(_SHOWN).rename(columns={"length": "step in sigmas"}))


def draw_sigma_naught(axes: Axes, adjusted: Adjustment) -> None:
    """Sigma naught before each step and at the end, on a logarithmic axis where it changes by much."""
    sigma0 = convergence_table(adjusted)["sigma0"].to_numpy(float)
    axes.plot(np.arange(len(sigma0)), sigma0, "o-", ms=4, color="tab:blue")
    low, high = np.nanmin(sigma0), np.nanmax(sigma0)
    if high > _MUCH * low:
        axes.set_yscale("log")
    else:
        # No finer than sigma naught is read.
        axes.set_ylim(min(low, 0.98 * high), max(high, 1.02 * low))
    axes.set(xlabel="steps taken", ylabel="sigma naught")
    axes.set_title("sigma naught", loc="left", fontsize=9)
    axes.locator_params(axis="x", integer=True)


def draw_steps(axes: Axes, adjusted: Adjustment) -> None:
    """Length of each step in standard deviations, those that were refused hollow, and the length that ends it."""
    table = convergence_table(adjusted).dropna(subset="length")
    length, taken = table["length"].to_numpy(float), (table["taken"] == "yes").to_numpy()
    k = np.arange(1, len(length) + 1)
    axes.semilogy(k, length, "-", lw=1, color="tab:blue")
    axes.semilogy(k[taken], length[taken], "o", ms=4, color="tab:blue", label="taken")
    if not taken.all():
        axes.semilogy(k[~taken], length[~taken], "o", ms=5, mfc="none", color="tab:orange", label="refused")
    axes.axhline(TOLERANCE, ls="--", color="0.4", label="near enough")
    axes.set(xlabel="step", ylabel="largest move [sigmas]")
    axes.set_title("step", loc="left", fontsize=9)
    axes.locator_params(axis="x", integer=True)
    axes.legend(fontsize=7)
