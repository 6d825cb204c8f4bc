"""Control and check points of a flight: how far each is off, and what positional accuracy that means."""

from collections.abc import Iterator
from functools import partial

import numpy as np
from jaxtyping import Float

from jaxphoto.procedures.control import ControlledBlock
from jaxphoto.report.control import rmse, surveyed_points
from jaxphoto.report.document import DocumentPicture, Element, Heading, Paragraph, Pictures, Rows
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.flight.part import PartReport
from jaxphoto.report.plots import draw_check_points
from jaxphoto.report.positional_accuracy import accuracy_sentences
from jaxphoto.report.tables import Tables

_STATES = ("control", "check")


def surveyed_section(report: PartReport) -> Iterator[Element]:
    """Statistics by state, the class of accuracy, pictures, and every point."""
    yield Heading("Control and check points")
    if not report.part.controlled:
        why = f" ({report.part.no_control})" if report.part.no_control else ""
        yield Paragraph(
            f"No surveyed points are used{why}: nothing outside the photographs and their positions judges this block. "
            "Points measured independently (--control, role check) would."
        )
        return
    yield from surveyed_elements(report.part.controlled, report.tables)


def surveyed_elements(found: ControlledBlock, tables: Tables) -> Iterator[Element]:
    """The same without a heading."""
    state = np.array(found.state, object)
    rows = []
    for what in _STATES:
        off = found.off_m[state == what]
        if not len(off):
            continue
        spread = (axis_cell(d, r) for d, r in zip(off.T, rmse(found, what), strict=True))
        rows.append((what, str(len(off)), *spread))
    yield Rows(("points", "n", *(f"d{axis}: mean / sd / rms [m]" for axis in "XYZ")), tuple(rows))
    for sentences in (found.sentences, accuracy_sentences(tables.tested_accuracy)):
        if sentences:
            yield Paragraph(" ".join(map(as_sentence, sentences)))
    if len(tables.check_points):
        yield Pictures(
            tuple(
                DocumentPicture(
                    partial(draw_check_points, tables=tables, upright=up),
                    f"Discrepancies at check points, surveyed minus computed, in {'height' if up else 'plan'}", 4.0,
                )
                for up in (False, True)
            )
        )  # fmt: skip
    yield _points(found)


def axis_cell(off_m: Float[np.ndarray, " points"], rms_m: float) -> str:
    """Mean, standard deviation and rms of the points that have the axis; "-" is what one point does not tell."""
    known = off_m[np.isfinite(off_m)]
    if not len(known):
        return ""
    sd = f"{np.std(known, ddof=1):.3f}" if len(known) > 1 else "-"
    return f"{known.mean():+.3f} / {sd} / {rms_m:.3f}"


def _points(found: ControlledBlock) -> Rows:
    """Every point, with the root mean square of its marks."""
    rows = []
    for k, p in enumerate(surveyed_points(found).to_dict("records")):
        marks = found.marks_px[found.marks.point == k]
        px = float(np.sqrt(np.mean(marks**2))) if len(marks) else np.nan
        w = [p[f"w_{axis}"] for axis in "XYZ" if np.isfinite(p[f"w_{axis}"])]
        off = (_number(p[f"d{axis}_m"], "+.3f") for axis in "XYZ")
        told = _number(max(w, default=np.nan), ".1f"), _number(px, ".2f")
        rows.append((p["point"], p["role"], p["state"], str(p["n_marks"]), *off, *told))
    columns = ("point", "role", "state", "marks", "dX [m]", "dY [m]", "dZ [m]", "largest w", "marks, rms [px]")
    return Rows(columns, tuple(rows))


def _number(value: float, digits: str) -> str:
    return f"{value:{digits}}" if np.isfinite(value) else ""
