"""Calibration certificate: camera, flight, conditions, method, results, inputs, and missing information.

The order follows certificates after DIN 18740 and EuroSDR's reports on camera calibration; no conformity is claimed. It
contains no creation time: equal inputs give equal bytes.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation, Sensor, constant_names, get_parameter, parameter_names, parameter_unit
from jaxphoto.camera.conditions import Conditions
from jaxphoto.errors import camera_words
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.formatting import of_sigma, symbol, with_sigma
from jaxphoto.report.page import Heading, Paragraph, Part, Plot, hash_table, option_word, page
from jaxphoto.report.plots import draw_distortion, draw_format_map, draw_matrix
from jaxphoto.report.results import assumed_pixels
from jaxphoto.report.verdict import readout_of
from jaxphoto.stability import NORMAL_95, Method, distortion_curve, frame_sigma, image_grid
from jaxphoto.statistics import AxisErrors
from jaxphoto.statistics.correlation import high_pairs
from jaxphoto.writing import InputFile, digest_of_all

_GRID, _HIGH = (15, 11), 0.9
# Step between tabulated rows of the distortion curve.
_EVERY = 3
# Alignments of the ray bundle in applications of the calibration; an estimated attitude or position compensates part of
# the camera's errors.
_ALIGNMENTS: tuple[tuple[Method, str], ...] = (
    ("zrot", "position and attitude known"), ("rot", "attitude re-estimated"),
)  # fmt: skip
_UNKNOWN = "not in the image files"
_NAMES = {
    "make": "make", "model": "model", "serial number": "serial", "lens": "lens",
    "serial number of the lens": "lens_serial", "firmware": "firmware", "aircraft": "drone",
}  # fmt: skip
_QUANTITIES = (
    ("exposure", "exposure_s", "s"), ("f-number", "f_number", ""), ("sensitivity", "iso", "ISO"),
    ("focal length", "focal_length_mm", "mm (as stated by the lens)"), ("focus distance", "subject_distance_m", "m"),
    ("temperature", "temperature_c", "degrees Celsius"), ("relative humidity", "humidity_percent", "%"),
    ("air pressure", "pressure_hpa", "hPa"),
)  # fmt: skip


class Certified(NamedTuple):
    """A calibrated camera with the data and method of its calibration."""

    camera: str
    sensor: Sensor
    interior: InteriorOrientation
    covariance: Float[np.ndarray, "p p"] | None
    """A posteriori covariance of `parameter_names(interior)`; zero for fixed parameters."""
    summary: Mapping[str, Any]
    """Content of summary.json."""
    with_exterior: pd.DataFrame
    """Rows of correlation_summary.csv."""
    conditions: Sequence[Conditions]
    """Conditions of the images; empty if their files were not read."""
    inputs: Sequence[InputFile]
    all_inputs: bool
    """True if all input files are known, not only the image files."""

    @property
    def files(self) -> list[InputFile]:
        """All known input files, by name."""
        return sorted(self.inputs)


def certificate_page(certified: Certified) -> str:
    """Return the certificate as HTML. Raises InputError for a non-invertible distortion, and the errors of `change`."""
    model = next((f"{c.camera} {c.serial}".strip() for c in certified.conditions if c.camera), "")
    foot = f"inputs SHA-256 {digest_of_all(certified.files)[:16]}" if certified.all_inputs else "inputs unknown"
    title = f"Certificate of calibration: {model or camera_words(certified.camera)}"
    parts = [*_camera(certified), *_method(certified), *_interior(certified), *_precision(certified)]
    parts += _tests_and_inputs(certified)
    return page(title, parts, _statement(certified), foot=foot)


def _statement(certified: Certified) -> tuple[str, str]:
    """Return the first sentence and its colour."""
    colour, findings = certified.summary.get("verdict"), certified.summary.get("findings", [])
    if certified.covariance is None:
        return "Not to be signed: no parameter of this camera was estimated, or correlations are missing.", "red"
    if colour == "red":
        first = next((f" First error: {f['text']}" for f in findings if f["severity"] == "error"), "")
        return f"Not to be signed: the verdict on the adjustment is red.{first}", "red"
    if colour == "amber":
        n = sum(f["severity"] == "warning" for f in findings)
        return f"Calibrated with {n} warnings, which are listed under Findings.", "amber"
    of = certified.summary.get("check_points", {})
    if axes := [a for a, d in of.items() if AxisErrors(a, d["n"], d["mean_m"], d["rmse_m"]).biased]:
        return f"Calibrated; check points are shifted in {', '.join(axes)}: check this before signing.", "amber"
    return "Calibrated; all tests of the adjustment are passed.", "green"


def known_conditions(conditions: Sequence[Conditions]) -> dict[str, str]:
    """Return dates, camera, aircraft and the ranges of exposure and weather over the used images, where recorded."""
    rows = {}
    if times := sorted(c.time for c in conditions if c.time):
        zone = "" if len(times[0]) > 19 and times[0][-6] in "+-" else ", by the camera's clock (time zone unknown)"
        rows["images taken"] = f"{times[0]} to {times[-1]}{zone}"
    for name, field in _NAMES.items():
        if known := dict.fromkeys(getattr(c, field) for c in conditions if getattr(c, field)):
            rows[name] = ", ".join(known)
    for name, field, unit in _QUANTITIES:
        values = [v for c in conditions if c.used and (v := getattr(c, field)) is not None]
        if values:
            low, middle, high = min(values), float(np.median(values)), max(values)
            text = f"{middle:.4g}" if low == high else f"{low:.4g} to {high:.4g}, median {middle:.4g}"
            rows[name] = f"{text} {unit}".strip()
    return rows


def _camera(certified: Certified) -> Iterator[Part]:
    s, of = certified.sensor, certified.summary
    yield Heading("Camera, flight and conditions")
    names = ("images taken", *_NAMES, *(name for name, _, _ in _QUANTITIES))
    missing = _UNKNOWN if certified.conditions else "unknown: no image files were read"
    images = [c.used for c in certified.conditions]
    yield {
        "name in the block": certified.camera,
        "format": f"{s.width_px} x {s.height_px} pixels, {s.width_mm:.4g} x {s.height_mm:.4g} mm",
        "pixel": f"{1e3 * s.pixel_mm:.5g} µm (scale of all lengths below; not calibrated)",
        "flight": str(of.get("title") or "without a title"),
        "images": f"{sum(images)} of {len(images)} used" if images else str(of.get("n_images", "unknown")),
        **{str(k): str(v) for k, v in dict(of.get("flight") or {}).items()},
        **dict.fromkeys(names, missing),
        **known_conditions(certified.conditions),
    }
    yield from assumed_pixels({certified.camera: s})


def _method(certified: Certified) -> Iterator[Part]:
    of, sigma0 = certified.summary, certified.summary.get("sigma0")
    groups = {k.replace("_", " "): v for k, v in of.get("n_observations", {}).items() if k != "total" and v}
    counts = ", ".join(f"{v} of {k}" for k, v in groups.items())
    distortion, projection = certified.interior.distortion.name, certified.interior.projection.name
    yield Heading("Method")
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
    interior, pixel = certified.interior, certified.sensor.pixel_mm
    names, rows = parameter_names(interior), []
    sigmas = np.zeros(len(names)) if certified.covariance is None else np.sqrt(np.diagonal(certified.covariance))
    for name, sigma in zip(names, sigmas, strict=True):
        value, in_px = float(get_parameter(interior, name)), ""
        if name.endswith("_mm"):
            in_px = with_sigma(value / pixel, sigma / pixel) + (f", {of_sigma(sigma / pixel)}" if sigma else "")
        if sigma > 0 or value:
            unit = parameter_unit(interior, name)
            rows.append((name, with_sigma(value, sigma), of_sigma(sigma) or "fixed", unit, in_px))
    for name in constant_names(interior):
        rows.append(
            (name, f"{float(get_parameter(interior, name)):.8g}", "constant", parameter_unit(interior, name), "")
        )
    if readout := certified.summary.get("georeferencing", {}).get(readout_of(certified.camera)):
        value, sigma = readout["value"], readout["sigma"]
        rows.append(("readout_ms", with_sigma(value, sigma), of_sigma(sigma), "ms", ""))
    yield pd.DataFrame(rows, columns=["name", "value", "sigma", "unit", "in pixels: value, sigma"])
    yield Paragraph(
        "x_p to the right and y_p up from the centre of the format; the unit 1 is dimensionless (docs/models.md). "
        "Standard deviations are a posteriori."
    )
    yield Heading("Distortion")
    curve = distortion_curve(interior, certified.sensor, certified.covariance)
    alt = f"Radial distortion, at most {1e3 * np.abs(curve.radial).max():.3g} µm, with its 95 % band"
    yield [Plot(partial(draw_distortion, curve=curve), alt)]
    columns = {"distance [mm]": curve.r, "radial [µm]": 1e3 * curve.radial}
    if curve.sigma is not None:
        columns["95 % within +- [µm]"] = 1e3 * NORMAL_95 * curve.sigma
    columns["decentring, affinity [µm]"] = 1e3 * curve.other
    yield pd.DataFrame(columns)[::_EVERY].map("{:.3f}".format)
    yield Paragraph(
        "Measured minus ideal, from the principal point, for the calibrated c; mean of 36 directions. The band is "
        "pointwise, by the covariance of all parameters."
    )


def _precision(certified: Certified) -> Iterator[Part]:
    covariance, names = certified.covariance, parameter_names(certified.interior)
    yield Heading("Precision over the format")
    if covariance is None:
        yield Paragraph("Precision and correlations are unknown: no covariance.")
        return
    points, scale = image_grid(certified.sensor, *_GRID), 1 / certified.sensor.pixel_mm
    maps = {w: scale * frame_sigma(certified.interior, covariance, points, how) for how, w in _ALIGNMENTS}
    yield [_map(certified, points, sigma, f"sigma [px], {words}") for words, sigma in maps.items()]
    rows = [(w, *(f"{v:.3g}" for v in (s.min(), np.median(s), s.max()))) for w, s in maps.items()]
    yield pd.DataFrame(rows, columns=["RMS error of a ray [px]", "least", "median", "most"])
    yield Heading("Correlations")
    sigma = np.sqrt(np.diagonal(covariance))
    free = np.flatnonzero(sigma > 0)
    names = tuple(names[k] for k in free)
    rho = covariance[np.ix_(free, free)] / sigma[free, None] / sigma[free]
    high = [f"{symbol(a)} and {symbol(b)} {r:+.3f}" for a, b, r in high_pairs(names, rho, _HIGH)]
    words = f"Above {_HIGH}: {', '.join(high)}; interpret these jointly." if high else f"None is above {_HIGH}."
    draw = partial(draw_matrix, values=rho, rows=names, columns=names, name="correlation of the interior orientation")
    yield [Plot(draw, f"Matrix of correlations. {words}", 3.8)]
    yield Paragraph(words)
    if len(table := certified.with_exterior):
        cells = table["mean_abs_rho"].map("{:.2f}".format) + table["max_abs_rho"].map(" ({:.2f})".format)
        wide = table.assign(rho=cells).pivot_table("rho", "interior", "exterior", aggfunc="first", sort=False)
        yield wide.fillna("").reset_index(names="mean (largest) |rho| over the images")


def _map(certified: Certified, cells_mm: np.ndarray, values: np.ndarray, name: str) -> Plot:
    draw = partial(draw_format_map, sensor=certified.sensor, cells_mm=cells_mm, name=name, values=values)
    return Plot(draw, f"Map over the format: {name}, {values.min():.2g} to {values.max():.2g}")


def _tests_and_inputs(certified: Certified) -> Iterator[Part]:
    of, files = certified.summary, certified.files
    yield Heading("Check points: surveyed minus computed")
    errors = pd.DataFrame.from_dict(of.get("check_points") or {}, orient="index")
    yield errors.reset_index(names="axis") if len(errors) else Paragraph("None.")
    yield Heading("Findings")
    texts = [(f["severity"], as_sentence(f["text"])) for f in of.get("findings", [])]
    yield from [Paragraph(f"{severity.capitalize()}: {text}", severity) for severity, text in texts] or [
        Paragraph("None.")
    ]
    yield Heading("Inputs")
    if not certified.all_inputs:
        yield Paragraph("Incomplete: the results have no hashes of their inputs; repeat the adjustment.")
    else:
        yield Paragraph(
            f"SHA-256 of all {len(files)} together ({digest_of_all(files)}) is that of the lines below as written by "
            "sha256sum, in the order of their names."
        )
        equal = "The same inputs, options and software give the numbers of this certificate to the printed digit."
        yield Paragraph(equal if of.get("method") else "The options are unknown.")
    yield hash_table(files)
    yield Heading("Signature")
    yield dict.fromkeys(("calibrated by", "place and date", "signature"), "_" * 40)
