"""The photographs of a flight one by one, those that are not used, and how sure orientations are."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd

from jaxphoto.report.document import DocumentPicture, Element, Heading, Paragraph, Pictures, Rows
from jaxphoto.report.error_ellipses import draw_error_ellipses
from jaxphoto.report.flight.part import PartReport

# Rows of a table that is still read; of more photographs those with the largest residuals.
_MOST = 150
_WORST = 50


def lost_section(left_out: Mapping[str, str], spoilt: Mapping[str, str]) -> Iterator[Element]:
    """Every photograph that is not used, and why."""
    yield Heading("Photographs that are not used")
    rows = [(name, why.removeprefix(f"{name}: ")) for name, why in {**spoilt, **left_out}.items()]
    if rows:
        yield Rows(("photograph", "reason"), tuple(rows))
    else:
        yield Paragraph("None: all are oriented.")


def exterior_section(report: PartReport) -> Iterator[Element]:
    """Standard deviations of positions and attitudes."""
    yield Heading("Exterior orientation")
    table = report.tables.exterior
    rows = []
    for name, unit in ((n, u) for n, u in zip(_EXTERIOR, (*[report.unit] * 3, *["deg"] * 3), strict=True)):
        sigma = table[f"sigma_{name}"]
        if not np.isfinite(sigma).any():
            rows.append((name.split("_")[0], unit, *["not known"] * 3, ""))
            continue
        k = int(np.nanargmax(sigma))
        rows.append((name.split("_")[0], unit, *(f"{v:.3g}" for v in (sigma.min(), sigma.median(), sigma.max())),
                     table["image"].iloc[k]))  # fmt: skip
    yield Rows(("standard deviation of", "unit", "least", "median", "largest", "photograph"), tuple(rows))
    yield Paragraph("A posteriori. All orientations are in result/exterior.csv.")
    draw = partial(draw_error_ellipses, tables=report.tables, unit=report.unit)
    yield Pictures((DocumentPicture(draw, "Error ellipses of the projection centres in plan, enlarged", 4.2),))
    further = report.tables.georeferencing
    if len(further):
        cells = ((p["parameter"], f"{p['value']:.6g}", f"{p['sigma']:.2g}") for p in further.to_dict("records"))
        yield Rows(("estimated besides", "value", "sigma"), tuple(cells))


_EXTERIOR = ("X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg")


def photographs_section(reports: Sequence[PartReport]) -> Iterator[Element]:
    """A row each: image points, residual, offset of its position, height and pixel on the ground, part."""
    yield Heading("All photographs")
    tables = []
    for number, r in enumerate(reports, 1):
        height, gsd = (r.coverage.height_m, r.coverage.gsd_m) if r.coverage else (np.nan, np.nan)
        tables.append(r.images.assign(height=height, gsd=gsd, part=number))
    table = pd.concat(tables, ignore_index=True)
    if len(table) > _MOST:
        yield Paragraph(f"The {_WORST} of {len(table)} with the largest residuals; images.csv has all.")
        table = table.nlargest(_WORST, "rms_px")
    shown = {
        "image points": table["n_image_points"].map("{:d}".format),
        "rms [px]": table["rms_px"].map("{:.2f}".format),
        **{f"d{axis} [m]": table[f"d{axis}_m"].map("{:+.3f}".format) for axis in "XYZ"},
        "position": table["position"],
        "height [m]": table["height"].map("{:.2f}".format),
        "pixel [cm]": (100 * table["gsd"]).map("{:.2f}".format),
        "part": table["part"].map(str),
    }
    # What no photograph has is no column.
    kept = {name: v.replace({"nan": "", "+nan": ""}) for name, v in shown.items() if name != "part" or len(reports) > 1}
    kept = {name: v for name, v in kept.items() if not v.isin(["", "none"]).all()}
    yield Rows(("photograph", *kept), tuple(zip(table["image"], *kept.values(), strict=True)))
