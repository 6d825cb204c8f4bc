"""A certificate of calibration: what German and European practice states of a camera, and what nobody told.

The order is that of certificates after DIN 18740 and of EuroSDR's reports on camera calibration: camera, flight,
conditions, method, interior orientation, distortion, precision over the format, correlations, stability, inputs. No
conformity is claimed by it. Nothing of the hour in which it is written is in it: the same inputs give the same bytes.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from jaxphoto.camera import constant_names, get_parameter, parameter_names, parameter_unit
from jaxphoto.errors import camera_words
from jaxphoto.report.certificate_conditions import condition_rows, flight_rows
from jaxphoto.report.certificate_figures import draw_correlations, draw_curve, draw_map
from jaxphoto.report.certified import Certified
from jaxphoto.report.change import change_verdict
from jaxphoto.report.digits import of_p, of_sigma, with_sigma
from jaxphoto.report.document import Document, DocumentPicture, Element, Heading, Paragraph, Pictures, Rows
from jaxphoto.report.findings import as_sentence, symbol
from jaxphoto.report.made import option_word
from jaxphoto.report.rolling_shutter import readout_of
from jaxphoto.report.source_words import assumed_pixels
from jaxphoto.stability import LEVEL, NORMAL_95, Method, change, distortion_curve, frame_sigma, image_grid
from jaxphoto.statistics.correlation import high_pairs
from jaxphoto.writing.inputs import digest_of_all

_COLUMNS, _ROWS = 15, 11
_SHARED = (
    "Both are of the same photographs, or share some of them: they cannot but agree, and that nothing has changed is "
    "not shown. Compare with a calibration by other photographs."
)
# Steps of the table of distortion: every second of the curve.
_EVERY = 3
_HIGH = 0.9
# What the user of a calibration may estimate anew, so that errors of the camera go into it.
_GIVEN_UP: tuple[tuple[Method, str], ...] = (
    ("zrot", "position and attitude known"),
    ("rot", "attitude estimated anew"),
)


def certificate_of(given: Certified) -> Document:
    """The certificate. Raises InputError for a camera that folds inside its format, and what `change` raises."""
    elements = [e for section in _SECTIONS for e in section(given)]
    sha = digest_of_all(_all_inputs(given))
    model = next((f"{c.camera} {c.serial}".strip() for c in given.conditions if c.camera), "")
    title = f"Certificate of calibration: {model or camera_words(given.camera)}"
    return Document(title, f"inputs SHA-256 {sha[:16]}" if given.all_inputs else "inputs not told", tuple(elements))


def _statement(given: Certified) -> Iterator[Element]:
    colour, findings = given.summary.get("verdict"), _findings(given)
    worst = [text for level, text in findings if level == "alarm"]
    if given.covariance is None:
        yield Paragraph("Not to be signed: nothing of this camera was estimated, or no correlations are kept.", "alarm")
    elif colour == "red":
        why = f" The first: {worst[0]}" if worst else ""
        yield Paragraph(f"Not to be signed: the verdict on the adjustment is red.{why}", "verdict red")
    elif colour == "amber":
        n = sum(level == "warning" for level, _ in findings)
        those = "1 reservation, which is" if n == 1 else f"{n} reservations, which are"
        yield Paragraph(f"Calibrated with {those} listed under Findings.", "verdict amber")
    elif axes := ", ".join(given.shifted_axes):
        yield Paragraph(f"Calibrated; check points are shifted in {axes}: see there before signing.", "verdict amber")
    else:
        yield Paragraph("Calibrated; no test of the adjustment objects.", "verdict green")
    if given.sigma_factor > 1:
        yield Paragraph(
            f"Neighbouring rays err alike: standard deviations and bands of this certificate are those of the "
            f"adjustment times {given.sigma_factor:.2f}."
        )


def _camera(given: Certified) -> Iterator[Element]:
    yield Heading("Camera")
    s = given.sensor
    said = partial(_one, given.conditions)
    yield _names(
        ("make", said("make")),
        ("model", said("model")),
        ("serial number", said("serial")),
        ("lens", said("lens")),
        ("serial number of the lens", said("lens_serial")),
        ("firmware", said("firmware")),
        ("format", f"{s.width_px} x {s.height_px} pixels, {s.width_mm:.4g} x {s.height_mm:.4g} mm"),
        ("pixel", f"{1e3 * s.pixel_mm:.5g} µm (scale of all lengths below; not calibrated)"),
        ("called in the block", given.camera),
    )
    yield from assumed_pixels({given.camera: s})


def _flight(given: Certified) -> Iterator[Element]:
    yield Heading("Flight and conditions")
    yield _names(*flight_rows(given), *condition_rows(given.conditions))


def _method(given: Certified) -> Iterator[Element]:
    yield Heading("Method")
    of = given.summary
    n = of.get("n_observations", {})
    counts = ", ".join(f"{v} of {k.replace('_', ' ')}" for k, v in n.items() if k != "total" and v)
    options = ", ".join(f"{k} {option_word(v)}" for k, v in dict(of.get("method", {})).items())
    versions = ", ".join(f"{k} {v}" for k, v in dict(of.get("versions", {})).items())
    distortion, projection = given.interior.distortion.name, given.interior.projection.name
    yield _names(
        ("adjustment", "self-calibrating bundle adjustment by least squares, all covariances exact"),
        ("model", f"projection {projection}, distortion {distortion} (docs/models.md)"),
        ("observations", f"{counts}; redundancy {of.get('redundancy', 'not told')}"),
        ("sigma naught", _number(of.get("sigma0"), "{:.4g}") + " (1 is expected of sigmas that are right)"),
        ("outcome", str(of.get("outcome", "not told"))),
        ("options", options or "not told"),
        ("software", versions or "not told"),
    )


def _interior(given: Certified) -> Iterator[Element]:
    yield Heading("Interior orientation")
    names = parameter_names(given.interior)
    sigmas = np.zeros(len(names)) if given.covariance is None else np.sqrt(np.diagonal(given.covariance))
    rows = []
    for name, sigma in zip(names, sigmas * given.sigma_factor, strict=True):
        value = float(get_parameter(given.interior, name))
        if sigma > 0 or value:
            told = (with_sigma(value, sigma), of_sigma(sigma) or "held", parameter_unit(given.interior, name))
            rows.append((name, *told, _in_px(given, name, sigma)))
    rows += [
        (n, f"{float(get_parameter(given.interior, n)):.8g}", "constant", parameter_unit(given.interior, n), "")
        for n in constant_names(given.interior)
    ]
    readout = dict(given.summary.get("georeferencing", {})).get(readout_of(given.camera), {})
    value, sigma = readout.get("value"), readout.get("sigma")
    if isinstance(value, int | float) and isinstance(sigma, int | float):
        rows.append(("readout_ms", with_sigma(value, sigma), of_sigma(sigma), "ms", ""))
    yield Rows(("parameter", "value", "sigma", "unit", "in pixels: value, sigma"), tuple(rows))
    yield Paragraph(
        "x_p to the right and y_p up from the centre of the format; the unit 1 is that of a number without one "
        "(docs/models.md). Standard deviations are a posteriori."
    )


def _distortion(given: Certified) -> Iterator[Element]:
    yield Heading("Distortion")
    curve = distortion_curve(given.interior, given.sensor, given.covariance)
    factor = given.sigma_factor
    picture = DocumentPicture(
        lambda axes: draw_curve(axes, curve, factor),
        f"Curve of radial distortion, {1e3 * np.abs(curve.radial).max():.3g} µm at most, with its 95 % band",
    )
    yield Pictures((picture,))
    rows = []
    for k in range(0, len(curve.r), _EVERY):
        band = "" if curve.sigma is None else f"{1e3 * NORMAL_95 * factor * curve.sigma[k]:.3f}"
        rows.append((f"{curve.r[k]:.3f}", f"{1e3 * curve.radial[k]:.3f}", band, f"{1e3 * curve.other[k]:.3f}"))
    columns = ("distance [mm]", "radial [µm]", "95 % within +- [µm]", "decentring, affinity [µm]")
    yield Rows(columns, tuple(rows))
    yield Paragraph(
        "Measured minus ideal, from the principal point, for the calibrated c; mean of 36 directions. The band holds "
        "at each distance by itself and follows from the covariance of all parameters."
    )


def _precision(given: Certified) -> Iterator[Element]:
    yield Heading("Precision over the format")
    if given.covariance is None:
        yield Paragraph("Not known: no covariance.")
        return
    points = image_grid(given.sensor, _COLUMNS, _ROWS)
    per_mm = given.sigma_factor / given.sensor.pixel_mm
    found = [(words, per_mm * frame_sigma(given.interior, given.covariance, points, how)) for how, words in _GIVEN_UP]
    panels = [
        DocumentPicture(
            partial(draw_map, sensor=given.sensor, cells_mm=points, values=sigma, title=f"sigma [px], {words}"),
            f"Map of standard deviations over the format, {sigma.min():.2g} to {sigma.max():.2g} pixels, {words}",
        )
        for words, sigma in found
    ]
    if given.band:
        b = given.band
        panels.append(
            DocumentPicture(
                partial(
                    draw_map, sensor=given.sensor, cells_mm=b.cells_mm, values=b.band_px, title="95 % by halves [px]"
                ),
                f"Map of the radius that holds 95 % of the errors by halves, {b.band_px.min():.2g} to "
                f"{b.band_px.max():.2g} pixels",
            )
        )
    yield Pictures(tuple(panels))
    rows = tuple((w, f"{s.min():.3g}", f"{np.median(s):.3g}", f"{s.max():.3g}") for w, s in found)
    yield Rows(("root mean square error of a ray [px]", "least", "median", "most"), rows)
    if given.band:
        yield Paragraph(
            f"Random halves of the block ({given.band.input.file}): standard deviations are to be multiplied by "
            f"{given.band.factor:.2f} +- {given.band.sigma_factor:.2f}; the third map has 95 % of the errors."
        )
    else:
        yield Paragraph("By the covariance of the adjustment; no halves of the block were compared (jaxphoto halves).")


def _correlations(given: Certified) -> Iterator[Element]:
    yield Heading("Correlations")
    if given.covariance is None:
        yield Paragraph("Not known: no covariance.")
        return
    sigma = np.sqrt(np.diagonal(given.covariance))
    free = np.flatnonzero(sigma > 0)
    names = [parameter_names(given.interior)[k] for k in free]
    rho = given.covariance[np.ix_(free, free)] / sigma[free, None] / sigma[free]
    high = [f"{symbol(a)} and {symbol(b)} {r:+.3f}" for a, b, r in high_pairs(names, rho, _HIGH)]
    said = f"Above {_HIGH}: {', '.join(high)}." if high else f"None is above {_HIGH}."
    yield Pictures(
        (DocumentPicture(lambda axes: draw_correlations(axes, names, rho), f"Matrix of correlations. {said}", 3.6),)
    )
    yield Paragraph(f"{said} Only together do parameters that are so correlated mean anything.")
    if given.with_exterior:
        table: dict[str, dict[str, str]] = {}
        for c in given.with_exterior:
            table.setdefault(c.interior, {})[c.exterior] = f"{c.mean_abs:.2f} ({c.max_abs:.2f})"
        across = tuple(dict.fromkeys(c.exterior for c in given.with_exterior))
        rows = tuple((p, *(of.get(e, "") for e in across)) for p, of in table.items())
        yield Rows(("mean (largest) |rho| over the images", *across), rows)


def _stability(given: Certified) -> Iterator[Element]:
    yield Heading("Stability since the last calibration")
    last = given.last
    if last is None:
        yield Paragraph("No earlier calibration was given (--last).")
        return
    points = image_grid(given.sensor, _COLUMNS, _ROWS)
    widened = None if given.covariance is None else given.covariance * given.sigma_factor**2
    found = change(last.interior, given.interior, points, (last.covariance, widened))
    yield Paragraph(f"Compared with {last.name} (first: that, second: this).")
    if last.shared:
        yield Paragraph(_SHARED)
    for sentence in change_verdict(found, given.sensor):
        yield Paragraph(as_sentence(sentence))
    offset = found.offset_mm / given.sensor.pixel_mm
    yield Pictures(
        (
            DocumentPicture(
                partial(draw_map, sensor=given.sensor, cells_mm=points, values=offset, title="offset of rays [px]"),
                f"Map of the offsets of rays since the last calibration, at most {offset.max():.2g} pixels",
            ),
            DocumentPicture(
                partial(
                    draw_map, sensor=given.sensor, cells_mm=points, values=found.offset_mm / found.limit_mm,
                    title=f"over what {100 * LEVEL:.0f} % stay below",
                ),
                "Map of the same over the limit for one and the same camera",
            ),
        )
    )  # fmt: skip
    rows = tuple(
        (p.parameter, with_sigma(p.first, p.sigma), with_sigma(p.second, p.sigma),
         with_sigma(p.difference, p.sigma), of_sigma(p.sigma), p.unit, of_p(p.p_value))
        for p in found.parameters if p.sigma > 0
    )  # fmt: skip
    if rows:
        yield Rows(("parameter", "last", "this", "difference", "sigma of it", "unit", "p"), rows)


def _accuracy(given: Certified) -> Iterator[Element]:
    yield Heading("Check points")
    said = given.summary.get("positional_accuracy")
    if not said:
        yield Paragraph("None: no positional accuracy was tested.")
    for sentence in said if isinstance(said, list) else []:
        yield Paragraph(str(sentence))


def _found(given: Certified) -> Iterator[Element]:
    yield Heading("Findings")
    findings = _findings(given)
    if not findings:
        yield Paragraph("None.")
    for level, text in findings:
        yield Paragraph(f"{level.capitalize()}: {text}.", level)


def _inputs(given: Certified) -> Iterator[Element]:
    yield Heading("Inputs")
    files = _all_inputs(given)
    if not files:
        yield Paragraph("Not told: the results were written without hashes of their inputs; adjust anew.")
        return
    if not given.all_inputs:
        yield Paragraph(
            "These are not all: the results were written without hashes of their inputs, and nothing can be said of "
            "whether they come again; adjust anew."
        )
    else:
        again = "The same inputs, options and software give the numbers of this certificate to the printed digit."
        yield Paragraph(
            f"SHA-256 of all {len(files)} together ({digest_of_all(files)}) is that of the lines below as sha256sum "
            "writes them, in the order of their names."
            + (f" {again}" if given.summary.get("method") else " The options are not told.")
        )
    yield Rows(
        ("file", "bytes", "SHA-256"), tuple((f.file, str(f.n_bytes) if f.n_bytes else "", f.sha256) for f in files)
    )


def _signature(given: Certified) -> Iterator[Element]:
    yield Heading("Signature")
    yield _names(*((what, "_" * 40) for what in ("calibrated by", "place and date", "signature")))


_SECTIONS = (
    _statement, _camera, _flight, _method, _interior, _distortion, _precision, _correlations, _stability, _accuracy,
    _found, _inputs, _signature,
)  # fmt: skip


def _in_px(given: Certified, name: str, sigma: float) -> str:
    if not name.endswith("_mm"):
        return ""
    pixel = given.sensor.pixel_mm
    value = float(get_parameter(given.interior, name)) / pixel
    return with_sigma(value, sigma / pixel) + (f", {of_sigma(sigma / pixel)}" if sigma else "")


def _all_inputs(given: Certified) -> list:
    more = [part.input for part in (given.last, given.band) if part is not None]
    return sorted({*given.inputs, *more})


def _findings(given: Certified) -> list[tuple[str, str]]:
    found = given.summary.get("findings", [])
    return [(str(f.get("level", "")), str(f.get("text", ""))) for f in found if isinstance(f, dict)]


def _one(conditions: Sequence, field: str) -> str:
    """What all photographs say of the camera; several where they differ."""
    said = list(dict.fromkeys(getattr(c, field) for c in conditions if getattr(c, field)))
    if not conditions:
        return "not told: no photographs were read"
    return ", ".join(said) or "not said by the photographs"


def _names(*rows: tuple[str, str]) -> Rows:
    return Rows(("", ""), rows)


def _number(value: Any, digits: str) -> str:
    return digits.format(value) if isinstance(value, int | float) else "not told"
