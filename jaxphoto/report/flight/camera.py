"""The calibrated camera: its parameters, its distortion, what goes with what."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names
from jaxphoto.report.alike import with_alike
from jaxphoto.report.certificate_figures import draw_correlations, draw_curve
from jaxphoto.report.digits import of_sigma, with_sigma
from jaxphoto.report.document import DocumentPicture, Element, Heading, Paragraph, Pictures, Rows
from jaxphoto.report.findings import as_sentence, symbol
from jaxphoto.report.flight.part import PartReport
from jaxphoto.report.flight.source import FlightSource
from jaxphoto.report.ground import ground_findings
from jaxphoto.report.rolling_shutter import SEEN, readout_of, shutter_findings
from jaxphoto.report.source_words import assumed_pixels
from jaxphoto.stability import distortion_curve
from jaxphoto.statistics.correlation import high_pairs

HIGH = 0.9
_FIRST = ("c_mm", "xp_mm", "yp_mm")


def interior_rows(report: PartReport, start: InteriorOrientation | None) -> Rows:
    """Every parameter, and the readout of a rolling shutter: where it began, what came out, how sure, in pixels, and
    whether it differs from zero."""
    adjusted, alike = report.part.adjusted, report.part.oriented.report.alike
    table = with_alike(report.tables.interior, adjusted, alike)
    table = table[table["sigma"].notna() | (table["value"] != 0)]
    rows = []
    for p in table.to_dict("records"):
        name, sigma, pixel = p["parameter"], p["sigma_alike"], adjusted.block.sensors[p["camera"]].pixel_mm
        began = f"{float(get_parameter(start, name)):.6g}" if start and name in parameter_names(start) else ""
        estimated = np.isfinite(p["sigma"])
        rows.append(
            (
                name,
                began,
                with_sigma(p["value"], p["sigma"]),
                of_sigma(p["sigma"]) if estimated else "held",
                of_sigma(sigma) if estimated else "",
                p["unit"],
                _with(p["value"] / pixel, sigma / pixel) if estimated and name.endswith("_mm") else "",
                {True: "yes", False: "no"}.get(p["significant"], ""),
            )
        )
    further = report.tables.georeferencing
    names = [readout_of(camera) for camera in adjusted.unknowns.interior]
    for p in further[further["parameter"].isin(names)].to_dict("records"):
        seen = "yes" if abs(p["value"]) >= SEEN * p["sigma"] else "no"
        rows.append(("readout_ms", "", with_sigma(p["value"], p["sigma"]), of_sigma(p["sigma"]), "", "ms", "", seen))
    columns = ("parameter", "began at", "value", "sigma", "sigma alike", "unit", "in pixels", "significant")
    return Rows(columns, tuple(rows))


def camera_sentences(report: PartReport) -> Iterator[str]:
    """c, x_p and y_p with their standard deviations, and the readout of a rolling shutter, as a screen shows them."""
    table = report.tables.interior
    found = table[table["sigma"].notna() & table["parameter"].isin(_FIRST)]
    each = zip(found["parameter"], found["value"], found["sigma"], strict=True)
    told = [f"{symbol(name)} = {_with(value, sigma)}" for name, value, sigma in each]
    if told:
        yield f"{', '.join(told)} mm"
    yield from (finding.text for finding in shutter_findings(report.tables))


def _with(value: float, sigma: float) -> str:
    return f"{with_sigma(value, sigma)} +- {of_sigma(sigma)}"


def camera_section(report: PartReport, source: FlightSource) -> Iterator[Element]:
    """Parameters, what was known of the lens, and distortion."""
    yield Heading("Interior orientation")
    ((name, interior),) = report.part.adjusted.unknowns.interior.items()
    sensor, alike = report.part.adjusted.block.sensors[name], report.part.oriented.report.alike
    yield Paragraph(
        f"{sensor.width_px} x {sensor.height_px} pixels of {1e3 * sensor.pixel_mm:.4g} µm; projection "
        f"{interior.projection.name}, distortion {interior.distortion.name} (docs/models.md). {source.camera_from}"
    )
    yield from assumed_pixels({name: sensor})
    yield interior_rows(report, source.start)
    if source.start is not None:
        share = 100 * (float(interior.c) / float(source.start.c) - 1)
        yield Paragraph(f"The principal distance is {share:+.2f} % from where it began.")
    yield Paragraph(
        "Lengths in mm, x to the right and y up from the centre of the format. Sigma is a posteriori; sigma alike is "
        f"that with what the rays say of it times {alike:.2g}, because neighbouring rays err alike."
        if report.sigma_factor > 1
        else "Lengths in mm, x to the right and y up from the centre of the format. Sigma is a posteriori; sigma alike "
        "differs from it where neighbouring rays err alike, which they hardly do here."
    )
    yield from (Paragraph(as_sentence(s)) for s in report.part.lens)
    covariance = report.tables.covariance.of_interior(name, parameter_names(interior))
    curve = distortion_curve(interior, sensor, covariance)
    most = np.abs(curve.radial).max()
    yield Heading("Distortion and correlations")
    c = report.tables.correlations[name]
    panels = [
        DocumentPicture(
            lambda axes: draw_curve(axes, curve, report.sigma_factor),
            f"Curve of radial distortion, {1e3 * most:.3g} µm or {most / sensor.pixel_mm:.3g} px at most, with its "
            "95 % band",
            3.6,
        )
    ]
    if c.parameters:
        panels.append(
            DocumentPicture(
                lambda axes: draw_correlations(axes, list(c.parameters), c.interior),
                "Matrix of correlations of the interior orientation", 3.6,
            )
        )  # fmt: skip
    yield Pictures(tuple(panels))
    yield from map(Paragraph, correlation_sentences(report, name))


def correlation_sentences(report: PartReport, camera: str) -> Iterator[str]:
    """Which parameters mean something only together, within the camera, with the photographs, with the ground."""
    c = report.tables.correlations[camera]
    if not c.parameters:
        yield "Nothing of the camera was estimated, so nothing goes with it."
        return
    pairs = high_pairs(c.parameters, c.interior, HIGH)
    told = ", ".join(f"{symbol(a)} with {symbol(b)} {rho:+.3f}" for a, b, rho in pairs)
    yield (
        f"Within the camera, above {HIGH:g}: {told}. A change of one makes good for the other: only together do they "
        "mean anything."
        if pairs
        else f"Within the camera no correlation is above {HIGH:g}."
    )
    if len(c.images):
        i, j = np.unravel_index(int(c.mean_abs.argmax()), c.mean_abs.shape)
        image = c.images[int(np.abs(c.exterior[:, i, j]).argmax())]
        yield (
            f"With the exterior orientation it is highest of {symbol(c.parameters[j])} with {c.eop_names[i]}: "
            f"{c.mean_abs[i, j]:.2f} on average over the photographs, {c.max_abs[i, j]:.3f} at most ({image})."
        )
    yield from (as_sentence(f.text) for f in ground_findings(report.tables))
