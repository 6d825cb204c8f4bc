"""How a part was oriented and weighted: features, matches, what was left out, variance components."""

from collections.abc import Iterator

import numpy as np

from jaxphoto.report.document import Element, Heading, Paragraph, Rows
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.flight.part import PartReport
from jaxphoto.report.orientation import orientation_sentences


def orientation_section(report: PartReport) -> Iterator[Element]:
    """Counts by photograph and pair, and the sentences of the orientation and of its positions."""
    yield Heading("How it was oriented")
    part = report.part
    counts = {
        "features of a photograph": np.array([len(xy) for xy in part.matched.xy_mm]),
        "image points of a photograph": report.images["n_image_points"].to_numpy(),
        "matches of a pair": np.array([len(p.features) for p in part.matched.pairs]),
    }
    rows = tuple(
        (name, str(len(n)), *(f"{v:.0f}" for v in (n.min(), np.median(n), n.max(), n.mean())))
        for name, n in counts.items()
        if len(n)
    )
    yield Rows(("number of", "of", "least", "median", "most", "mean"), rows)
    said = [*orientation_sentences(part.oriented.report), *(part.placed.sentences if part.placed else ())]
    yield from (Paragraph(as_sentence(s)) for s in said)


def weights_section(report: PartReport) -> Iterator[Element]:
    """By what the standard deviations that were given were multiplied."""
    yield Heading("Weights")
    found, adjusted = report.part.components, report.part.adjusted
    yield Paragraph(
        f"Sigma naught {float(adjusted.sigma0):.4g} (1 is expected of sigmas that are right), redundancy "
        f"{adjusted.redundancy}; {sum(adjusted.n_observations.values())} observations, "
        f"{sum(adjusted.n_unknowns.values())} unknowns, {int(adjusted.steps)} iterations. "
        f"{as_sentence(adjusted.outcome.value)}"
    )
    if not found:
        yield Paragraph("No variance components: standard deviations are as they were given.")
        return
    rows = tuple(
        (label, str(found.observations[k]), f"{found.redundancy[k]:.1f}", *_factor(found.factor[k], found.sigma[k]))
        if found.supported[k]
        else (label, str(found.observations[k]), f"{found.redundancy[k]:.1f}", "as given", "")
        for k, label in enumerate(found.labels)
    )
    columns = ("variance components of", "observations", "redundancy", "sigmas times", "variance times")
    yield Rows(columns, rows)


def _factor(factor: float, sigma: float) -> tuple[str, str]:
    return f"{factor**0.5:.3g}", f"{factor:.3g} +- {sigma:.2g}"
