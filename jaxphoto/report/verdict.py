"""Verdict on an adjustment: findings on convergence, residuals, geometry and reliability."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.weak_directions import POOR, yardsticks
from jaxphoto.adjustment.weakness_messages import weaknesses_of
from jaxphoto.camera import RollingShutter, Sensor, ThermalRates, get_parameter
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import camera_words, few
from jaxphoto.initial.approximate import in_front, looking_away
from jaxphoto.procedures.adjust import ABSURD, left_out_words
from jaxphoto.procedures.contradiction import Contradiction, contradicting_group
from jaxphoto.report.findings import Finding, Severity, Verdict, p_words
from jaxphoto.report.formatting import of_sigma, path_words, plus_minus, symbol
from jaxphoto.report.residual_findings import (
    NOTHING_FITS,
    input_findings,
    reliability_findings,
    residual_findings,
    stretch_findings,
)
from jaxphoto.report.tables import NEAR_VERTICAL, Tables
from jaxphoto.statistics import (
    SIGNIFICANCE_LEVEL,
    CameraDifferences,
    CameraDrift,
    Correlations,
    Significance,
    ZeroTest,
    camera_spline_differences,
    correlation_matrix,
    fix_at_zero,
    prepare_hat_matrix,
    strip_differences,
)
from jaxphoto.statistics.block_geometry import size_mismatches
from jaxphoto.statistics.correlation import FORMS, high_pairs
from jaxphoto.statistics.determinability import FELT, WEAK_CORRELATION, corner_yardsticks
from jaxphoto.unknowns import FIXED, Weighted

HIGH_CORRELATION = 0.9
HIGH_OWN_CORRELATION = 0.95
FLAT = 0.2
"""Ratio of height range to flying height below which the ground is nearly flat."""
NEAR_VERTICAL_DEG = 15.0
SEEN = 3.0
"""Ratio of a rolling-shutter readout to its standard deviation above which it is significant."""
_FOR_POINT = "strips in both directions with stations (GNSS), relief or oblique images"
_CURES = {
    "c_mm": "stations (GNSS) that do not shift, relief, a second flying height or oblique images",
    "xp_mm": _FOR_POINT,
    "yp_mm": _FOR_POINT,
}
_FOR_DISTORTION = "image points towards the corners, more overlap or cross strips"
# Rows of the correlations: horizontal position, height, tilts.
_PLAN, _HEIGHT, _TILTS = slice(0, 2), slice(2, 3), slice(3, 5)
_C, _POINT = ("c_mm",), ("xp_mm", "yp_mm")
# Maximum offset of the principal point from the middle, as a fraction of the format: lenses reach one or two per cent.
# Maximum ratio of the adjusted and the initial principal distance, which nominal focal lengths reach by a few per cent.
_OFF_MIDDLE, _C_RATIO = 0.05, 1.25


def verdict_of(tables: Tables, more: Sequence[Finding] = ()) -> Verdict:
    """Assess an adjustment: convergence, residuals, weak geometry, correlations, significance, reliability.

    `more`: findings on the steps before; they replace findings of the same code and subject.
    """
    known = {(f.code, f.subject) for f in more}
    return Verdict.of([*more, *(f for f in _findings(tables) if (f.code, f.subject) not in known)])


def _findings(tables: Tables) -> Iterator[Finding]:
    adjusted = tables.adjusted
    if not bool(adjusted.converged):
        yield from _not_converged(adjusted)
        # Stop here: statistics are valid only at an optimum.
        return
    if float(adjusted.sigma0) > ABSURD and (contradiction := contradicting_group(adjusted)) is not None:
        yield _contradiction_finding(adjusted, contradiction)
        if contradiction.explanation:
            # Tests of an adjustment that is distorted so far name innocent observations.
            return
    prepare_hat_matrix(adjusted)
    yield from (Finding("prior_information", "warning", doubt) for doubt in adjusted.block.prior_warnings)
    if adjusted.left_out:
        yield Finding("rejected", "warning", left_out_words(adjusted))
    yield from behind_findings(adjusted)
    yield from looking_up_findings(tables)
    yield from format_findings(adjusted)
    residual = list(residual_findings(tables))
    yield from input_findings(tables, residual)
    yield from residual
    inseparable = {adjusted.block.images[k] for k in np.flatnonzero(tables.inseparable_angles)}
    of_cameras = {camera: weaknesses(tables, camera, c) for camera, c in tables.correlations.items()}
    yield from _weak(tables, frozenset().union(*(w.labels for weak in of_cameras.values() for w in weak)))
    for camera, c in tables.correlations.items():
        weak = of_cameras[camera]
        yield from (w.finding for w in weak)
        explained = frozenset().union(*(w.explains for w in weak))
        felt = {name for name, moved in at_corner(tables, camera).items() if moved > FELT}
        yield from _correlated(camera, c, explained, felt, inseparable)
    yield from scanner_findings(tables)
    yield from angle_findings(tables)
    yield from ground_findings(tables)
    yield from shutter_findings(tables)
    yield from drift_findings(tables)
    yield from (_not_significant(tables, s) for s in tables.significance if not s.significant)
    for name, sensor in adjusted.block.sensors.items():
        if not _invertible(adjusted, name, sensor):
            yield Finding("distortion_not_invertible", "warning", camera_words(name))
    yield from reliability_findings(tables)
    yield from stretch_findings(adjusted)


def _not_converged(adjusted: Adjustment) -> Iterator[Finding]:
    sigma0 = float(adjusted.sigma0)
    if sigma0 > NOTHING_FITS and (contradiction := contradicting_group(adjusted)) is not None:
        yield _contradiction_finding(adjusted, contradiction)
        yield Finding("not_converged", "error", adjusted.outcome.value)
        return
    yield Finding("not_converged", "error", adjusted.outcome.value)
    if names := [adjusted.block.points[p] for p in np.flatnonzero(adjusted.diverged_points)]:
        yield Finding("diverged_points", "error", few(names), len(names))
    # Good fit without convergence indicates an undetermined direction, not poor initial values.
    if sigma0 <= NOTHING_FITS:
        yield from (Finding("undetermined", "error", w.sentence) for w in weaknesses_of(adjusted))
    elif np.isfinite(sigma0):
        yield Finding("nothing_fits", "error", value=sigma0, limit=NOTHING_FITS)


def _contradiction_finding(adjusted: Adjustment, contradiction: Contradiction) -> Finding:
    """Return the finding; a group that agrees by no known correction has the hint to check its file."""
    c, names = contradiction, [name.replace("_", " ") for name in contradiction.groups]
    others = f" (or without {few([name.replace('_', ' ') for name in c.others])})" if c.others else ""
    numbers = {"others": others, "explanation": f"; they agree {c.explanation}" if c.explanation else ""}
    hint = "" if c.explanation else f"Check {' and '.join(f'{name}.csv' for name in c.groups)}, or the trajectory"
    return Finding(
        "contradicting_group", "error", " and ".join(names), float(adjusted.sigma0), c.sigma0, hint, numbers=numbers
    )


def behind_findings(adjusted: Adjustment) -> Iterator[Finding]:
    """Yield images that face away from their points, and single points behind images."""
    block = adjusted.block
    rows, seen = block.image_points, in_front(block, adjusted.unknowns)
    away = looking_away(block, seen)
    if names := [block.images[k] for k in away]:
        yield Finding("mirrored_image", "error", few(names), len(names))
    behind = np.flatnonzero(~seen & ~np.isin(rows.image, away))
    if len(behind):
        names = [f"{block.points[rows.point[k]]} in {block.images[rows.image[k]]}" for k in behind]
        yield Finding("points_behind", "warning", few(names), len(names))


def looking_up_findings(tables: Tables) -> Iterator[Finding]:
    """Yield a finding if all images are below their object points and look up.

    Control or stations with exchanged axes, or one axis of the wrong sign, are mirrored. On flat ground a mirrored plan
    is that of a block turned by half a turn about a horizontal axis, which fits as well.
    """
    adjusted, s = tables.adjusted, tables.adjusted.structure
    if tables.unit != "m" or not len(s.image):
        return
    exterior, z = adjusted.unknowns.exterior, np.asarray(adjusted.unknowns.points)[s.point, 2]
    depth = z - np.asarray(exterior.position)[s.image, 2]
    upwards = -np.asarray(exterior.camera_from_object)[s.image, 2, 2]
    if depth.min() > 0 and np.median(upwards) > NEAR_VERTICAL:
        severity: Severity = "error" if adjusted.block.frame.kind == "epsg" else "warning"
        yield Finding("looking_up", severity, value=float(np.median(depth)))


def format_findings(adjusted: Adjustment) -> Iterator[Finding]:
    """Yield cameras whose image points, principal point or principal distance do not fit their format."""
    block = adjusted.block
    for name, mismatch in size_mismatches(block).items():
        yield Finding(
            "picture_size", "error" if mismatch.resized else "warning", f"{camera_words(name)}: {mismatch.text}"
        )
    for name, sensor in block.sensors.items():
        words = camera_words(name)
        first, last = (u.interior[name] for u in (block.start.unknowns, adjusted.unknowns))
        size_mm = np.array([sensor.width_mm, sensor.height_mm])
        offset = np.abs([np.asarray(i.principal_point) / size_mm for i in (last, first)]).max(axis=1)
        if offset[0] > _OFF_MIDDLE and offset[0] > 2 * offset[1]:
            x, y = np.asarray(last.principal_point) / sensor.pixel_mm
            yield Finding(
                "principal_point_far",
                "warning",
                words,
                offset[0],
                _OFF_MIDDLE,
                numbers={"x": x, "y": y, "percent": 100 * offset[0]},
            )
        ratio = float(last.c) / float(first.c)
        if not 1 / _C_RATIO < ratio < _C_RATIO:
            numbers = {"c": float(last.c), "initial": float(first.c)}
            yield Finding("c_far", "warning", words, ratio, _C_RATIO, numbers=numbers)


# Weak geometry ---------------------------------------------------------------------------------------------------


class Weakness(NamedTuple):
    """A poorly determined interior parameter, and the (exterior, interior) pairs whose correlation it explains."""

    finding: Finding
    explains: frozenset[tuple[str, str]]
    labels: frozenset[str]
    """Paths of the parameters."""


def weaknesses(tables: Tables, camera: str, c: Correlations) -> list[Weakness]:
    """Find interior parameters that near-vertical images over flat ground do not determine.

    In this geometry, principal distance and flying height have equal effects, and so do principal point and a shift
    with tilt of the camera. Criteria are a correlation above `WEAK_CORRELATION` with the exterior orientation, and a
    sigma that moves the corner of the image by more than `FELT` sigmas of an image point (docs/statistics.md).
    """
    adjusted = tables.adjusted
    images = np.flatnonzero(np.array(adjusted.block.image_camera) == camera)
    relief, tilt_deg = _geometry(adjusted, images)
    if not (relief < FLAT and tilt_deg < NEAR_VERTICAL_DEG):
        return []
    geometry = f"nearly flat ground (relief {100 * relief:.0f} % of the flying height) in near-vertical images"
    sigma = {s.parameter: s.sigma for s in tables.significance if s.camera == camera}
    corner, words, findings = at_corner(tables, camera), camera_words(camera), []

    def add(code: str, parameters: tuple[str, ...], value: float, hint: str, numbers: dict[str, Any]) -> None:
        finding = Finding(code, "warning", words, value, hint=hint, numbers={"geometry": geometry, **numbers})
        pairs = frozenset((e, p) for e in c.eop_names for p in c.parameters if p in parameters)
        findings.append(Weakness(finding, pairs, frozenset(f"interior[{camera}].{name}" for name in parameters)))

    rho = _strongest(c, _HEIGHT, _C)
    if rho > WEAK_CORRELATION and corner["c_mm"] > FELT:
        why, cure = _stations(adjusted, images, (2,))
        percent = 100 * sigma["c_mm"] / float(adjusted.unknowns.interior[camera].c)
        hint = f"{cure}, relief, a second flying height or oblique images, or fix c"
        add("c_weak", _C, sigma["c_mm"], hint, {"percent": percent, "rho": rho, "why": why})
    tilt, shift = _strongest(c, _TILTS, _POINT), _strongest(c, _PLAN, _POINT)
    moved = max((corner[name] for name in _POINT if name in corner), default=0.0)
    if max(tilt, shift) > WEAK_CORRELATION and moved > FELT:
        why, cure = _stations(adjusted, images, (0, 1))
        sigmas = ", ".join(f"sigma of {symbol(name)} {sigma[name]:.3g} mm" for name in _POINT if name in sigma)
        hint = f"{cure} with strips in both directions, relief or oblique images, or fix it"
        numbers = {"sigmas": sigmas, "tilts": " and ".join(c.eop_names[_TILTS]), "tilt": tilt, "shift": shift}
        add("principal_point_weak", _POINT, max(sigma.get(n, 0.0) for n in _POINT), hint, {**numbers, "why": why})
    return findings


def at_corner(tables: Tables, camera: str) -> dict[str, float]:
    """Return the shift of the image corner by one sigma of each estimated parameter, in sigmas of an image point."""
    adjusted = tables.adjusted
    labels, own = adjusted.structure.labels, {camera: adjusted.unknowns.interior[camera]}
    units = dict(zip(labels, corner_yardsticks(adjusted.block, own, labels, yardsticks(adjusted)), strict=True))
    tests = [s for s in tables.significance if s.camera == camera]
    return {s.parameter: s.sigma / units[f"interior[{camera}].{s.parameter}"] for s in tests}


def _geometry(adjusted: Adjustment, images: np.ndarray) -> tuple[float, float]:
    """Return relief over flying height, and the largest tilt (degrees); infinite unless the images look down."""
    rows = adjusted.structure
    points = np.unique(rows.point[np.isin(rows.image, images)])
    heights = np.asarray(adjusted.unknowns.points)[points, 2]
    flying = np.asarray(adjusted.unknowns.exterior.position)[images, 2].mean() - heights.mean() if len(points) else 0.0
    if not flying > 0:
        return math.inf, math.inf
    axis = np.asarray(adjusted.unknowns.exterior.camera_from_object)[images][:, 2, 2]
    return float(np.ptp(heights) / flying), float(np.degrees(np.arccos(np.clip(axis, -1.0, 1.0))).max())


def _stations(adjusted: Adjustment, images: np.ndarray, axes: tuple[int, ...]) -> tuple[str, str]:
    """Explain why stations along `axes` do not separate the interior orientation, and return the cure."""
    block, priors = adjusted.block, adjusted.priors
    rows = np.isin(block.stations.who, images) & np.isin(block.stations.axis, axes)
    observed = np.unique(block.stations.who[rows]).tolist()
    if not observed:
        return "no station separates them", "Add camera stations (GNSS)"
    loose = {name for name, bias in priors.strips.items() if bias.shift != FIXED}
    swung = {name for name, mount in priors.mounts.items() if mount.lever_arm != FIXED}
    if all(block.image_strip[i] in loose or block.image_mount[i] in swung for i in observed):
        why = "estimated shifts or lever arms of the stations hardly separate them"
        return why, "Fix these, or add camera stations (GNSS) that do not shift"
    sigma = float(np.median(np.asarray(block.stations.sigma)[rows]))
    return f"stations of sigma {sigma:.2g} m hardly separate them", "Add better camera stations (GNSS)"


def _strongest(c: Correlations, rows: slice, parameters: tuple[str, ...]) -> float:
    columns = [k for k, name in enumerate(c.parameters) if name in parameters]
    return float(c.max_abs[rows][:, columns].max(initial=0.0)) if len(c.images) else 0.0


def _weak(tables: Tables, reported: frozenset[str]) -> Iterator[Finding]:
    """Report unknowns with a scaled sigma above `POOR`, except the interior orientations in `reported`."""
    adjusted, q = tables.adjusted, tables.covariance
    yard, a_priori = yardsticks(adjusted), 1 / np.sqrt(float(q.variance_factor))
    in_yardsticks = (
        q.exterior_sigma[:, :3] / yard.ground,
        q.exterior_sigma[:, 3:] / yard.angle,
        q.point_sigma / yard.ground,
        q.shared_sigma / yard.shared,
    )
    if max(a_priori * np.max(v, initial=0.0) for v in in_yardsticks) > POOR:
        weak = (w for w in weaknesses_of(adjusted) if not w.labels & reported)
        yield from (Finding("undetermined", "warning", w.sentence) for w in weak)


# Correlations and significance -----------------------------------------------------------------------------------


def _not_significant(tables: Tables, s: Significance) -> Finding:
    """Report the effect of fixing an insignificant parameter at zero."""
    change, sensor = fix_at_zero(tables.adjusted, tables.covariance, s), tables.adjusted.block.sensors[s.camera]
    others = {name: abs(v) for name, v in change.in_sigmas.items() if name != s.parameter}
    most = max(others, key=lambda name: others[name], default="")
    moved = f"{symbol(most)} by {others[most]:.1f} sigma and " if most else ""
    effect = f"{moved}the corner of the image by {change.corner_mm / sensor.pixel_mm:.2g} px"
    subject = f"{symbol(s.parameter)} of {camera_words(s.camera)}"
    return Finding("not_significant", "note", subject, s.p_value, SIGNIFICANCE_LEVEL, numbers={"effect": effect})


def _correlated(
    camera: str, c: Correlations, explained: frozenset[tuple[str, str]], felt: set[str], inseparable: set[str]
) -> Iterator[Finding]:
    """Report high correlations, except the pairs in `explained`: a warning if the parameter affects the images.

    Correlations within the images in `inseparable`, whose omega and kappa are not separable, are not reported.
    """
    subject, limit = camera_words(camera), HIGH_CORRELATION
    if pairs := high_pairs(c.parameters, c.interior, limit):
        words = _correlated_words([(symbol(a), symbol(b), rho) for a, b, rho in pairs])
        yield Finding("correlation_interior", "note", subject, pairs[0][2], limit, numbers={"pairs": words})
    if len(c.images) == 0:
        return
    expected = [[(e, p) in explained for p in c.parameters] for e in c.eop_names]
    worst = np.where(np.reshape(expected, c.max_abs.shape), 0.0, c.max_abs)
    if high := sorted(np.argwhere(worst > limit).tolist(), key=lambda k: -worst[k[0], k[1]]):
        names = few(
            [
                f"{c.eop_names[i]} with {symbol(c.parameters[j])} {worst[i, j]:.3f} "
                f"(image {c.images[int(np.abs(c.exterior[:, i, j]).argmax())]})"
                for i, j in high
            ]
        )
        weak = [p for p in dict.fromkeys(c.parameters[j] for _, j in high) if p in felt]
        cures = " or ".join(dict.fromkeys(_CURES.get(p, _FOR_DISTORTION) for p in weak))
        hint = f"Add {cures}" if weak else f"Its effect on the image corners is below {FELT:g} sigma"
        severity: Severity = "warning" if weak else "note"
        numbers = {"pairs": names}
        yield Finding("correlation_exterior", severity, subject, float(worst.max()), limit, hint, numbers)
    regular = np.array([image not in inseparable for image in c.images])
    within = np.abs(c.within_image[regular]).max(axis=0, initial=0.0)
    strong = sorted((within[i, j], i, j) for i in range(6) for j in range(i) if within[i, j] > HIGH_OWN_CORRELATION)
    if strong:
        names = few([f"{c.eop_names[j]} and {c.eop_names[i]} (up to {r:.3f})" for r, i, j in strong[::-1]])
        numbers = {"pairs": names}
        yield Finding("correlation_image", "note", subject, strong[-1][0], HIGH_OWN_CORRELATION, numbers=numbers)


def _correlated_words(pairs: list[tuple[str, str, float]]) -> str:
    """Return "a and b are strongly correlated (rho = +0.95)", for the first pairs and the number of others."""
    (a, b, rho), others = pairs[0], [f"{a} and {b} ({rho:+.3f})" for a, b, rho in pairs[1:]]
    return f"{a} and {b} are strongly correlated (rho = {rho:+.3f})" + f", also {few(others)}" * bool(others)


def scanner_findings(tables: Tables) -> Iterator[Finding]:
    """Report strong correlations of the boresight and shifts of the laser scanner with each other and the cameras."""
    q = tables.covariance
    first = 6 * q.n_images
    if not any(label.startswith("scanner") for label in q.labels[first:]):
        return
    found = high_pairs(q.labels[first:], correlation_matrix(q)[first:, first:], HIGH_CORRELATION)
    found = [pair for pair in found if any(label.startswith("scanner") for label in pair[:2])]
    if found:
        name = lambda path: path_words(path).partition(" [")[0]  # noqa: E731
        numbers = {"pairs": _correlated_words([(name(a), name(b), rho) for a, b, rho in found])}
        yield Finding("correlation_scanner", "warning", "scanner", found[0][2], HIGH_CORRELATION, numbers=numbers)


def angle_findings(tables: Tables) -> Iterator[Finding]:
    """Report images whose omega and kappa are not separable."""
    if names := [tables.adjusted.block.images[k] for k in np.flatnonzero(tables.inseparable_angles)]:
        yield Finding("inseparable_angles", "note", few(names), len(names))


def ground_findings(tables: Tables) -> Iterator[Finding]:
    """Report correlations of c with heights, and of the camera with doming of the ground."""
    for camera, g in tables.ground_correlations.items():
        words, dome = camera_words(camera), float(g.together[FORMS.index("dome")])
        if "c_mm" in g.parameters:
            rho = g.rho[:2, g.parameters.index("c_mm")]
            k = int(np.abs(rho).argmax())
            if abs(rho[k]) > HIGH_CORRELATION:
                sigma = tables.interior.set_index(["camera", "parameter"])["sigma"][camera, "c_mm"]
                what = ("the height of the ground", "the distance of the images from the ground")[k]
                numbers = {"what": what, "sigma": sigma, "effect": abs(rho[k]) * g.sigma_m[k], "unit": tables.unit}
                yield Finding("ground_c", "note", words, float(rho[k]), HIGH_CORRELATION, numbers=numbers)
        if dome > HIGH_CORRELATION:
            numbers = {"effect": g.sigma_m[FORMS.index("dome")], "unit": tables.unit}
            yield Finding("ground_dome", "note", words, dome, HIGH_CORRELATION, numbers=numbers)


def _invertible(adjusted: Adjustment, name: str, sensor: Sensor) -> bool:
    """Return True if the corner of the format is within the monotonic range of the distortion."""
    corner = np.array([sensor.width_mm, sensor.height_mm]) / 2
    r = np.linspace(0.0, 1.0, 65)[:, None] * corner
    out = np.asarray(call_compiled(_closed_form, adjusted.unknowns.interior[name], r))
    return not bool((np.diff(np.linalg.norm(out, axis=1)) <= 0).any())


@eqx.filter_jit
def _closed_form(interior, xy):
    return jax.vmap(interior.closed_form)(xy)


# Priors, rolling shutter, drift ----------------------------------------------------------------------------------


def lens_findings(tables: Tables) -> Iterator[Finding]:
    """Compare the adjusted c with its prior; a warning if the block hardly improves the prior."""
    adjusted, little = tables.adjusted, 0.7
    if not bool(adjusted.converged):
        return
    interior = tables.interior.set_index(["camera", "parameter"])
    for camera, priors in adjusted.block.priors.interior.items():
        prior = get_parameter(priors, "c_mm")
        value, sigma = (float(interior[column][camera, "c_mm"]) for column in ("value", "sigma"))
        if not isinstance(prior, Weighted) or not np.isfinite(sigma):
            continue
        known, words = float(prior.sigma), camera_words(camera)
        if sigma > little * known:
            yield Finding("lens_prior_only", "warning", words, sigma, known)
        else:
            change = value - float(prior.value)
            numbers = {"change": change, "ratio": abs(change) / known}
            yield Finding("lens_prior", "note", words, sigma, known, numbers=numbers)


def readout_of(camera: str) -> str:
    """Return the parameter path of a camera's rolling-shutter readout."""
    return f"{RollingShutter.kind}[{camera}].readout_ms"


def shutter_findings(tables: Tables) -> Iterator[Finding]:
    """Report the estimated readout of every rolling shutter, and its significance."""
    table = tables.georeferencing
    for label, value, sigma in table[table["parameter"].str.startswith(f"{RollingShutter.kind}[")].to_numpy():
        words = camera_words(label.split("[", 1)[1].rsplit("]", 1)[0])
        if abs(value) < SEEN * sigma:
            yield Finding("no_rolling_shutter", "note", words, value, SEEN * sigma, numbers={"sigma": sigma})
        else:
            numbers = {"sigma": sigma, "order": "first row first" if value > 0 else "last row first"}
            yield Finding("rolling_shutter", "note", words, abs(value), SEEN * sigma, numbers=numbers)


def drift_findings(tables: Tables) -> Iterator[Finding]:
    """Report changes of cameras with estimated rates or splines, and differences between strips."""
    yield from map(drift_finding, tables.tested_drifts)
    yield from map(differences_finding, camera_spline_differences(tables.adjusted, tables.covariance))
    if (strips := strip_differences(tables.adjusted, tables.covariance)) is not None:
        yield differences_finding(strips)


def drift_finding(drift: CameraDrift) -> Finding:
    """Report the change of one camera: significant parameters if there are any, otherwise the MDBs."""
    test, names = drift.change, drift.parameters
    if drift.rates is ThermalRates:
        over = f"with its temperature over {drift.span:.2g} K"
    else:
        over = f"over {drift.span:.2g} h" if drift.span > 1.5 else f"over {60 * drift.span:.2g} min"
    significant = [k for k, p in enumerate(test.p_values) if p < SIGNIFICANCE_LEVEL] or range(len(names))
    changes = [f"{_symbol(names[k])} by {_signed(names[k], test, k)}" for k in significant]
    return _drift(camera_words(drift.camera), over, test, changes, dict(zip(names, test.detectable, strict=True)))


def differences_finding(differences: CameraDifferences) -> Finding:
    """Report differences between the cameras of all strips, or between all knots of a spline."""
    test, names, spline = differences.more, np.array(differences.parameters), bool(differences.camera)
    words = camera_words(differences.camera) if spline else "the camera"
    over, place = ("from knot to knot of its spline", "at {} min") if spline else ("from strip to strip", "in strip {}")
    changes, detectable = [], {}
    for name in dict.fromkeys(differences.parameters):
        rows = np.flatnonzero(names == name)
        ends = (int(rows[end(test.value[rows])]) for end in (np.argmin, np.argmax))
        texts = (f"{_signed(name, test, k)} {place.format(differences.at[k])}" for k in ends)
        changes.append(f"{_symbol(name)} from {' to '.join(texts)}")
        detectable[name] = float(test.detectable[rows].max())
    return _drift(words, over, test, changes, detectable)


def _drift(subject: str, over: str, test: ZeroTest, changes: list[str], mdb: Mapping[str, float]) -> Finding:
    if not test.rejected:
        sizes = ((name, *_scale(name, size), size) for name, size in mdb.items())
        changes = [
            f"{_symbol(name)} {of_sigma(factor * size) + unit if math.isfinite(size) else 'none'}"
            for name, factor, unit, size in sizes
        ]
    numbers = {"over": over, "p": p_words(test.p_value), "changes": ", ".join(changes)}
    code = "drift" if test.rejected else "no_drift"
    return Finding(code, "note", subject, test.p_value, SIGNIFICANCE_LEVEL, numbers=numbers)


def _signed(name: str, test: ZeroTest, k: int) -> str:
    factor, unit = _scale(name, float(test.sigma[k]))
    return plus_minus(factor * float(test.value[k]), factor * float(test.sigma[k])) + unit


def _symbol(name: str) -> str:
    return {"xp": "x_p", "yp": "y_p"}.get(name, name)


def _scale(name: str, size: float) -> tuple[float, str]:
    """Return factor and unit of a change of `size` (mm): micrometres below a tenth of a millimetre."""
    if name == "k1":
        return 1.0, ""
    return (1.0, " mm") if size >= 0.0995 else (1e3, " um")
