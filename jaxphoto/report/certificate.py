"""A certificate of calibration: camera, flight, conditions, method, results and inputs, with gaps stated.

The order follows certificates after DIN 18740 and EuroSDR's reports on camera calibration; no conformity is claimed. It
contains no time of writing: equal inputs give equal bytes.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation, Sensor, constant_names, get_parameter, parameter_names, parameter_unit
from jaxphoto.camera.conditions import Conditions
from jaxphoto.errors import camera_words
from jaxphoto.report.findings import as_sentence, symbol
from jaxphoto.report.formatting import of_sigma, with_sigma
from jaxphoto.report.page import Heading, Paragraph, Part, Plot, hash_table, option_word, page
from jaxphoto.report.plots import draw_distortion, draw_format_map, draw_matrix
from jaxphoto.report.results import assumed_pixels
from jaxphoto.report.stability import change_verdict, parameter_changes
from jaxphoto.report.verdict import readout_of
from jaxphoto.stability import LEVEL, NORMAL_95, Method, change, distortion_curve, frame_sigma, image_grid
from jaxphoto.statistics import AxisErrors
from jaxphoto.statistics.correlation import high_pairs
from jaxphoto.writing import InputFile, digest_of_all

_GRID = (15, 11)
# Every third row of the distortion curve is tabulated.
_EVERY = 3
_HIGH = 0.9
# What a user of the calibration estimates, which absorbs errors of the camera.
_ALIGNMENTS: tuple[tuple[Method, str], ...] = (
    ("zrot", "position and attitude known"),
    ("rot", "attitude re-estimated"),
)
_UNKNOWN = "not in the image files"
_QUANTITIES = (
    ("exposure", "exposure_s", "s"), ("f-number", "f_number", ""), ("sensitivity", "iso", "ISO"),
    ("focal length", "focal_length_mm", "mm (as stated by the lens)"), ("focus distance", "subject_distance_m", "m"),
    ("temperature", "temperature_c", "degrees Celsius"), ("relative humidity", "humidity_percent", "%"),
    ("air pressure", "pressure_hpa", "hPa"),
)  # fmt: skip


class LastCalibration(NamedTuple):
    """An earlier calibration of the same camera."""

    name: str
    interior: InteriorOrientation
    covariance: Float[np.ndarray, "q q"] | None
    input: InputFile
    """The file it was read from."""
    shared: bool = False
    """True if it has images in common with the certified one."""


class FormatBand(NamedTuple):
    """Split-half validation of the same camera (`jaxphoto halves`): 95 % of the errors over the image format."""

    cells_mm: Float[np.ndarray, "cells 2"]
    band_px: Float[np.ndarray, "cells"]
    factor: float
    sigma_factor: float
    input: InputFile


class ExteriorCorrelation(NamedTuple):
    """Correlation of an exterior with an interior parameter over all images."""

    exterior: str
    interior: str
    mean_abs: float
    max_abs: float


class Certified(NamedTuple):
    """A calibrated camera, and how it was calibrated."""

    camera: str
    sensor: Sensor
    interior: InteriorOrientation
    covariance: Float[np.ndarray, "p p"] | None
    """A posteriori, of `parameter_names(interior)`, zero where fixed."""
    summary: Mapping[str, Any]
    """summary.json."""
    with_exterior: Sequence[ExteriorCorrelation]
    conditions: Sequence[Conditions]
    """Conditions of the images, if their files were read."""
    inputs: Sequence[InputFile]
    all_inputs: bool
    """True if all input files are known; image files alone are not all."""
    last: LastCalibration | None = None
    band: FormatBand | None = None

    @property
    def sigma_factor(self) -> float:
        """Factor of sigmas for spatially correlated residuals; 1 if unknown."""
        factor = self.summary.get("sigma_factor", 1.0)
        return float(factor) if isinstance(factor, int | float) and math.isfinite(factor) and factor > 1 else 1.0

    @property
    def shifted_axes(self) -> list[str]:
        """Axes with a significant mean error of check points."""
        errors = dict(self.summary.get("check_points", {})).items()
        numbers = {axis: [of.get(key, math.nan) for key in ("n", "mean_m", "rmse_m")] for axis, of in errors}
        return [axis for axis, (n, mean, rmse) in numbers.items() if AxisErrors(axis, n, mean, rmse).biased]

    @property
    def files(self) -> list[InputFile]:
        """All known input files."""
        return sorted({*self.inputs, *(part.input for part in (self.last, self.band) if part is not None)})

    @property
    def findings(self) -> list[tuple[str, str]]:
        """Severities and sentences of the findings in summary.json."""
        rows = self.summary.get("findings", [])
        return [(str(f.get("severity", "")), str(f.get("text", ""))) for f in rows if isinstance(f, dict)]


def certificate_page(certified: Certified) -> str:
    """The certificate as HTML. Raises InputError for a non-invertible distortion, and what `change` raises."""
    model = next((f"{c.camera} {c.serial}".strip() for c in certified.conditions if c.camera), "")
    foot = f"inputs SHA-256 {digest_of_all(certified.files)[:16]}" if certified.all_inputs else "inputs unknown"
    parts = [part for section in _SECTIONS for part in section(certified)]
    title = f"Certificate of calibration: {model or camera_words(certified.camera)}"
    return page(title, parts, _statement(certified), foot=foot)


def _statement(certified: Certified) -> tuple[str, str]:
    """The first sentence and its colour."""
    colour, severities = certified.summary.get("verdict"), [severity for severity, _ in certified.findings]
    if certified.covariance is None:
        return "Not to be signed: nothing of this camera was estimated, or no correlations are kept.", "red"
    if colour == "red":
        first = next((f" First error: {text}" for severity, text in certified.findings if severity == "error"), "")
        return f"Not to be signed: the verdict on the adjustment is red.{first}", "red"
    if colour == "amber":
        return f"Calibrated with {severities.count('warning')} warnings, which are listed under Findings.", "amber"
    if axes := ", ".join(certified.shifted_axes):
        return f"Calibrated; check points are shifted in {axes}: look into this before signing.", "amber"
    return "Calibrated; all tests of the adjustment are passed.", "green"


def _camera(certified: Certified) -> Iterator[Part]:
    if certified.sigma_factor > 1:
        yield Paragraph(
            "Residuals are spatially correlated: standard deviations and bands of this certificate are those of the "
            f"adjustment times {certified.sigma_factor:.2f}."
        )
    yield Heading("Camera")
    s, fields = certified.sensor, {}
    for name, field in (
        ("make", "make"), ("model", "model"), ("serial number", "serial"), ("lens", "lens"),
        ("serial number of the lens", "lens_serial"), ("firmware", "firmware"),
    ):  # fmt: skip
        values = dict.fromkeys(getattr(c, field) for c in certified.conditions if getattr(c, field))
        fields[name] = ", ".join(values) or (_UNKNOWN if certified.conditions else "unknown: no image files were read")
    yield fields | {
        "format": f"{s.width_px} x {s.height_px} pixels, {s.width_mm:.4g} x {s.height_mm:.4g} mm",
        "pixel": f"{1e3 * s.pixel_mm:.5g} µm (scale of all lengths below; not calibrated)",
        "name in the block": certified.camera,
    }
    yield from assumed_pixels({certified.camera: s})


def _flight(certified: Certified) -> Iterator[Part]:
    conditions, known = certified.conditions, dict(known_conditions(certified.conditions))
    yield Heading("Flight and conditions")
    images = f"{sum(c.used for c in conditions)} of {len(conditions)} used" if conditions else ""
    flight = certified.summary.get("flight")
    yield {
        "flight": str(certified.summary.get("title") or "without a title"),
        "date": dates(conditions),
        "images": images or str(certified.summary.get("n_images", "unknown")),
        "aircraft": ", ".join(dict.fromkeys(c.drone for c in conditions if c.drone)) or _UNKNOWN,
        **({str(k): str(v) for k, v in flight.items()} if isinstance(flight, dict) else {}),
        **{name: known.get(name, _UNKNOWN) for name, _, _ in _QUANTITIES},
    }


def dates(conditions: Sequence[Conditions]) -> str:
    """First and last exposure by the clock of the camera."""
    times = sorted(c.time for c in conditions if c.time)
    if not times:
        return _UNKNOWN
    zone = "" if len(times[0]) > 19 and times[0][-6] in "+-" else ", by the camera's clock (time zone unknown)"
    return f"{times[0]} to {times[-1]}{zone}"


def known_conditions(conditions: Sequence[Conditions]) -> Iterator[tuple[str, str]]:
    """Ranges of exposure, aperture, sensitivity, focus and weather over the used images, where known."""
    for name, field, unit in _QUANTITIES:
        values = [v for c in conditions if c.used and (v := getattr(c, field)) is not None]
        if values:
            low, middle, high = min(values), float(np.median(values)), max(values)
            text = f"{middle:.4g}" if low == high else f"{low:.4g} to {high:.4g}, median {middle:.4g}"
            yield name, f"{text} {unit}".strip()


def _method(certified: Certified) -> Iterator[Part]:
    yield Heading("Method")
    of, sigma0 = certified.summary, certified.summary.get("sigma0")
    counts = ", ".join(
        f"{v} of {k.replace('_', ' ')}" for k, v in of.get("n_observations", {}).items() if k != "total" and v
    )
    distortion, projection = certified.interior.distortion.name, certified.interior.projection.name
    yield {
        "adjustment": "self-calibrating bundle adjustment by least squares, exact covariances",
        "model": f"projection {projection}, distortion {distortion} (docs/models.md)",
        "observations": f"{counts}; redundancy {of.get('redundancy', 'unknown')}",
        "sigma naught": f"{sigma0:.4g} (expected 1)" if isinstance(sigma0, int | float) else "unknown",
        "outcome": str(of.get("outcome", "unknown")),
        "options": ", ".join(f"{k} {option_word(v)}" for k, v in dict(of.get("method", {})).items()) or "unknown",
        "software": ", ".join(f"{k} {v}" for k, v in dict(of.get("versions", {})).items()) or "unknown",
    }


def _interior(certified: Certified) -> Iterator[Part]:
    yield Heading("Interior orientation")
    names, pixel = parameter_names(certified.interior), certified.sensor.pixel_mm
    sigmas = np.zeros(len(names)) if certified.covariance is None else np.sqrt(np.diagonal(certified.covariance))
    rows = []
    for name, sigma in zip(names, sigmas * certified.sigma_factor, strict=True):
        value, in_px = float(get_parameter(certified.interior, name)), ""
        if name.endswith("_mm"):
            in_px = with_sigma(value / pixel, sigma / pixel) + (f", {of_sigma(sigma / pixel)}" if sigma else "")
        if sigma > 0 or value:
            unit = parameter_unit(certified.interior, name)
            rows.append((name, with_sigma(value, sigma), of_sigma(sigma) or "fixed", unit, in_px))
    for name in constant_names(certified.interior):
        value, unit = float(get_parameter(certified.interior, name)), parameter_unit(certified.interior, name)
        rows.append((name, f"{value:.8g}", "constant", unit, ""))
    readout = dict(certified.summary.get("georeferencing", {})).get(readout_of(certified.camera), {})
    value, sigma = readout.get("value"), readout.get("sigma")
    if isinstance(value, int | float) and isinstance(sigma, int | float):
        rows.append(("readout_ms", with_sigma(value, sigma), of_sigma(sigma), "ms", ""))
    yield pd.DataFrame(rows, columns=["name", "value", "sigma", "unit", "in pixels: value, sigma"])
    yield Paragraph(
        "x_p to the right and y_p up from the centre of the format; the unit 1 is dimensionless (docs/models.md). "
        "Standard deviations are a posteriori."
    )


def _distortion(certified: Certified) -> Iterator[Part]:
    yield Heading("Distortion")
    curve, factor = distortion_curve(certified.interior, certified.sensor, certified.covariance), certified.sigma_factor
    alt = f"Radial distortion, at most {1e3 * np.abs(curve.radial).max():.3g} µm, with its 95 % band"
    yield [Plot(partial(draw_distortion, curve=curve, factor=factor), alt)]
    columns = {"distance [mm]": curve.r, "radial [µm]": 1e3 * curve.radial}
    if curve.sigma is not None:
        columns["95 % within +- [µm]"] = 1e3 * NORMAL_95 * factor * curve.sigma
    columns["decentring, affinity [µm]"] = 1e3 * curve.other
    yield pd.DataFrame(columns)[::_EVERY].map("{:.3f}".format)
    yield Paragraph(
        "Measured minus ideal, from the principal point, for the calibrated c; mean of 36 directions. The band is "
        "pointwise, by the covariance of all parameters."
    )


def _precision(certified: Certified) -> Iterator[Part]:
    yield Heading("Precision over the format")
    if certified.covariance is None:
        yield Paragraph("Unknown: no covariance.")
        return
    points, scale = image_grid(certified.sensor, *_GRID), certified.sigma_factor / certified.sensor.pixel_mm
    maps = {
        words: scale * frame_sigma(certified.interior, certified.covariance, points, how) for how, words in _ALIGNMENTS
    }
    plots = [_map(certified, points, sigma, f"sigma [px], {words}") for words, sigma in maps.items()]
    if certified.band:
        plots.append(_map(certified, certified.band.cells_mm, certified.band.band_px, "95 % by split halves [px]"))
    yield plots
    rows = [(w, *(f"{v:.3g}" for v in (s.min(), np.median(s), s.max()))) for w, s in maps.items()]
    yield pd.DataFrame(rows, columns=["RMS error of a ray [px]", "least", "median", "most"])
    yield Paragraph(
        f"Random halves of the block ({certified.band.input.file}): standard deviations are to be multiplied by "
        f"{certified.band.factor:.2f} +- {certified.band.sigma_factor:.2f}."
        if certified.band
        else "By the covariance of the adjustment; no split-half validation (jaxphoto halves)."
    )


def _map(certified: Certified, cells_mm: np.ndarray, values: np.ndarray, name: str) -> Plot:
    draw = partial(draw_format_map, sensor=certified.sensor, cells_mm=cells_mm, name=name, values=values)
    return Plot(draw, f"Map over the format: {name}, {values.min():.2g} to {values.max():.2g}")


def _correlations(certified: Certified) -> Iterator[Part]:
    yield Heading("Correlations")
    if certified.covariance is None:
        yield Paragraph("Unknown: no covariance.")
        return
    sigma = np.sqrt(np.diagonal(certified.covariance))
    free = np.flatnonzero(sigma > 0)
    names = [parameter_names(certified.interior)[k] for k in free]
    rho = certified.covariance[np.ix_(free, free)] / sigma[free, None] / sigma[free]
    high = [f"{symbol(a)} and {symbol(b)} {r:+.3f}" for a, b, r in high_pairs(names, rho, _HIGH)]
    words = f"Above {_HIGH}: {', '.join(high)}; interpret these jointly." if high else f"None is above {_HIGH}."
    draw = partial(draw_matrix, values=rho, rows=names, columns=names, name="correlation of the interior orientation")
    yield [Plot(draw, f"Matrix of correlations. {words}", 3.8)]
    yield Paragraph(words)
    if certified.with_exterior:
        table = pd.DataFrame(certified.with_exterior)
        cells = table.assign(rho=[f"{c.mean_abs:.2f} ({c.max_abs:.2f})" for c in certified.with_exterior])
        wide = cells.pivot_table("rho", "interior", "exterior", aggfunc="first", sort=False).fillna("")
        yield wide.reset_index(names="mean (largest) |rho| over the images")


def _stability(certified: Certified) -> Iterator[Part]:
    yield Heading("Stability since the last calibration")
    last = certified.last
    if last is None:
        yield Paragraph("No earlier calibration was given (--last).")
        return
    points = image_grid(certified.sensor, *_GRID)
    widened = None if certified.covariance is None else certified.covariance * certified.sigma_factor**2
    changed = change(last.interior, certified.interior, points, (last.covariance, widened))
    yield Paragraph(f"Compared with {last.name} (first: that, second: this).")
    if last.shared:
        yield Paragraph(
            "Both calibrations have images in common: their agreement does not show that nothing has changed. Compare "
            "with a calibration by other images."
        )
    yield from (Paragraph(as_sentence(sentence)) for sentence in change_verdict(changed, certified.sensor))
    yield [
        _map(certified, points, changed.offset_mm / certified.sensor.pixel_mm, "offset of rays [px]"),
        _map(certified, points, changed.offset_mm / changed.limit_mm, f"offset over its {100 * LEVEL:.0f} % limit"),
    ]
    table = parameter_changes(changed).drop(columns="ratio")
    if len(table := table[table["sigma"] > 0]):
        yield table


def _accuracy(certified: Certified) -> Iterator[Part]:
    sentences = certified.summary.get("positional_accuracy")
    yield Heading("Check points")
    yield from (Paragraph(str(sentence)) for sentence in sentences or ["None: no positional accuracy was tested."])


def _findings(certified: Certified) -> Iterator[Part]:
    yield Heading("Findings")
    yield from [Paragraph(f"{s.capitalize()}: {as_sentence(t)}", s) for s, t in certified.findings] or [
        Paragraph("None.")
    ]


def _inputs(certified: Certified) -> Iterator[Part]:
    yield Heading("Inputs")
    files = certified.files
    if not files:
        yield Paragraph("Unknown: the results have no hashes of their inputs; repeat the adjustment.")
        return
    if not certified.all_inputs:
        yield Paragraph("Incomplete: the results have no hashes of their inputs; repeat the adjustment.")
    else:
        yield Paragraph(
            f"SHA-256 of all {len(files)} together ({digest_of_all(files)}) is that of the lines below as written by "
            "sha256sum, in the order of their names."
        )
        equal = "The same inputs, options and software give the numbers of this certificate to the printed digit."
        yield Paragraph(equal if certified.summary.get("method") else "The options are unknown.")
    yield hash_table(files)


def _signature(certified: Certified) -> Iterator[Part]:
    yield Heading("Signature")
    yield dict.fromkeys(("calibrated by", "place and date", "signature"), "_" * 40)


_SECTIONS = (
    _camera, _flight, _method, _interior, _distortion, _precision, _correlations, _stability, _accuracy, _findings,
    _inputs, _signature,
)  # fmt: skip
