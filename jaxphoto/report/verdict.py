"""What a person should know first: findings about an adjustment, the worst first, each with what to do.

Red, amber or green follows from tests, not from convergence: of sigma naught as a whole and by group, of every
normalised residual, of patterns in them (`residual_findings`), of what the geometry leaves open.
"""

from collections.abc import Iterator

import equinox as eqx
import jax
import numpy as np

from jaxphoto.adjustment import POOR, Adjustment, weaknesses_of, yardsticks
from jaxphoto.block import Block
from jaxphoto.camera import Sensor
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import camera_words, few
from jaxphoto.procedures.adjust import left_out_words
from jaxphoto.report.behind import behind_findings
from jaxphoto.report.camera_drift import drift_findings
from jaxphoto.report.doubled import doubled_findings
from jaxphoto.report.findings import Finding, Level, Verdict, symbol
from jaxphoto.report.ground import ground_findings
from jaxphoto.report.residual_findings import (
    NOTHING_FITS,
    of_residuals,
    of_stretched_residuals,
    of_what_is_not_checked,
)
from jaxphoto.report.rolling_shutter import shutter_findings
from jaxphoto.report.tables import Tables
from jaxphoto.report.weakness import FELT, at_corner, weaknesses
from jaxphoto.statistics import Correlations, Significance, fix_at_zero, prepare_hat_matrix
from jaxphoto.statistics.correlation import high_pairs

HIGH_CORRELATION = 0.9
HIGH_OWN_CORRELATION = 0.95
# What tells a parameter of a camera from the exterior orientation of its images.
_OF_POINT = "strips in both directions with stations (GNSS), relief or oblique images"
_CURES = {
    "c_mm": "stations (GNSS) that do not shift, relief, a second flying height or oblique images",
    "xp_mm": _OF_POINT,
    "yp_mm": _OF_POINT,
}
_OF_DISTORTION = "image points towards the corners, more overlap or cross strips"
_OF_A_FIELD = "photographs turned by 90 degrees about the line of sight, and tilted ones"


def verdict_of(tables: Tables) -> Verdict:
    """Convergence, sigma naught, blunders, weaknesses, high correlations, what may be zero, what no test finds."""
    return Verdict.of(_findings(tables))


def _findings(tables: Tables) -> Iterator[Finding]:
    adjusted = tables.adjusted
    if not bool(adjusted.converged):
        yield Finding(Level.ALARM, adjusted.outcome.value)
        if names := [adjusted.block.points[p] for p in np.flatnonzero(adjusted.astray)]:
            yield Finding(Level.ALARM, f"gone astray: point {few(names)}")
        # Observations that fit one another where it stopped: then it is no bad start, but what the block cannot tell.
        if float(adjusted.sigma0) <= NOTHING_FITS:
            yield from (Finding(Level.ALARM, w.sentence) for w in weaknesses_of(adjusted))
        elif np.isfinite(adjusted.sigma0):
            yield Finding(
                Level.ALARM,
                f"nothing fits where it stopped (sigma naught {float(adjusted.sigma0):.3g}): approximate values, "
                "units, axes or names are wrong; jaxphoto adjust --snoop looks for what contradicts the others, and "
                "says which mistake of a file it is",
            )
        # Nothing that is said of an optimum holds elsewhere.
        return
    prepare_hat_matrix(adjusted.equations, adjusted.seconds)
    yield from (Finding(Level.WARNING, doubt) for doubt in adjusted.block.doubts)
    if adjusted.left_out:
        yield Finding(Level.WARNING, left_out_words(adjusted))
    yield from behind_findings(adjusted)
    yield from doubled_findings(adjusted.block)
    yield from of_residuals(tables)
    of_cameras = {camera: weaknesses(tables, camera, c) for camera, c in tables.correlations.items()}
    yield from _weak(tables, frozenset().union(*(w.labels for weak in of_cameras.values() for w in weak)))
    for camera, c in tables.correlations.items():
        weak = of_cameras[camera]
        yield from (Finding(Level.WARNING, w.sentence) for w in weak)
        explained = frozenset().union(*(w.explains for w in weak))
        felt = {name for name, moved in at_corner(tables, camera).items() if moved > FELT}
        yield from _correlated(camera, c, explained, felt, _all_known(adjusted.block))
    yield from ground_findings(tables)
    yield from shutter_findings(tables)
    yield from drift_findings(tables)
    yield from (_not_significant(tables, s) for s in tables.significance if not s.significant)
    for name, sensor in adjusted.block.sensors.items():
        if _folds(adjusted, name, sensor):
            yield Finding(
                Level.WARNING,
                f"{camera_words(name)}: its distortion folds inside the format; image points beyond the fold mean "
                "nothing, use fewer coefficients or more points in the corners",
            )
    yield from of_what_is_not_checked(tables)
    yield from of_stretched_residuals(adjusted)


def _weak(tables: Tables, told: frozenset[str]) -> Iterator[Finding]:
    """What gives way by more than `POOR`, but for interior orientations that are `told` already."""
    adjusted, q = tables.adjusted, tables.covariance
    yard, a_priori = yardsticks(adjusted), 1 / np.sqrt(float(q.variance_factor))
    in_yardsticks = (
        q.exterior_sigma[:, :3] / yard.ground,
        q.exterior_sigma[:, 3:] / yard.angle,
        q.point_sigma / yard.ground,
        q.shared_sigma / yard.shared,
    )
    if max(a_priori * np.max(v, initial=0.0) for v in in_yardsticks) > POOR:
        found = weaknesses_of(adjusted)
        yield from (Finding(Level.WARNING, w.sentence) for w in found if not w.labels & told)


def _not_significant(tables: Tables, s: Significance) -> Finding:
    """What holding a parameter at zero would change, for whoever wants fewer of them."""
    adjusted = tables.adjusted
    change = fix_at_zero(adjusted, tables.covariance, s)
    sensor = adjusted.block.sensors[s.camera]
    others = {name: abs(v) for name, v in change.in_sigmas.items() if name != s.parameter}
    most = max(others, key=lambda name: others[name], default="")
    moved = f"{symbol(most)} by {others[most]:.1f} of its sigma and " if most else ""
    pixels = f"{change.corner_mm / sensor.pixel_mm:.2g} px"
    return Finding(
        Level.INFORMATION,
        f"{symbol(s.parameter)} of {camera_words(s.camera)} may be zero (p = {s.p_value:.2g}); held there, it would "
        f"move {moved}the corner of the image by {pixels}",
    )


def _all_known(block: Block) -> bool:
    """Whether all points are known beforehand: a field of targets."""
    return len(np.union1d(block.control.who, block.fixed.who)) == len(block.points)


def _correlated(
    camera: str, c: Correlations, explained: frozenset[tuple[str, str]], felt: set[str], field: bool
) -> Iterator[Finding]:
    """High correlations, but for the pairs of exterior and interior orientation that are `explained` already.

    They are a reservation where a parameter is so badly known that images feel it (`felt`), else to be known. What
    cures them depends on the parameter, and on whether all images show a `field` of known targets.
    """
    usual = "usual without camera stations or attitudes, their effects on the ground cancel"
    if field:
        usual = "usual where targets alone orient an image, their effects on it cancel"
    pairs = high_pairs(c.parameters, c.interior, HIGH_CORRELATION)
    if pairs:
        names = few([f"{symbol(a)} and {symbol(b)} {rho:+.3f}" for a, b, rho in pairs])
        yield Finding(
            Level.INFORMATION,
            f"high correlation within the interior orientation of {camera_words(camera)}: {names}; a change of one "
            "makes good for the other, and only together they mean much",
        )
    if len(c.images) == 0:
        return
    told = [[(e, p) in explained for p in c.parameters] for e in c.eop_names]
    worst = np.where(np.reshape(told, c.max_abs.shape), 0.0, c.max_abs)
    high = sorted(np.argwhere(worst > HIGH_CORRELATION).tolist(), key=lambda k: -worst[k[0], k[1]])
    if high:
        images = [c.images[int(np.abs(c.exterior[:, i, j]).argmax())] for i, j in high]
        where = zip(high, images, strict=True)
        names = few(
            [f"{c.eop_names[i]} with {symbol(c.parameters[j])} {worst[i, j]:.3f} (image {k})" for (i, j), k in where]
        )
        open_ = [p for p in dict.fromkeys(c.parameters[j] for _, j in high) if p in felt]
        cures = [_OF_A_FIELD] if field else list(dict.fromkeys(_CURES.get(p, _OF_DISTORTION) for p in open_))
        said = (
            f"add {', or '.join(cures)}"
            if open_
            else f"what is open moves no corner of an image by {FELT:g} of its sigmas"
        )
        yield Finding(
            Level.WARNING if open_ else Level.INFORMATION,
            f"high correlation of exterior with interior orientation of {camera_words(camera)}: {names}; {said}",
        )
    own = np.abs(c.within_image).max(axis=0)
    strong = [(own[i, j], i, j) for i in range(6) for j in range(i) if own[i, j] > HIGH_OWN_CORRELATION]
    if strong:
        names = few([f"{c.eop_names[j]} and {c.eop_names[i]} (up to {r:.3f})" for r, i, j in sorted(strong)[::-1]])
        yield Finding(
            Level.INFORMATION, f"exterior orientation of single images is highly correlated: {names}; {usual}"
        )


def _folds(adjusted: Adjustment, name: str, sensor: Sensor) -> bool:
    """Whether the corner of the format lies beyond the monotone range of the adjusted distortion."""
    interior = adjusted.unknowns.interior[name]
    corner = np.array([sensor.width_mm, sensor.height_mm]) / 2
    r = np.linspace(0.0, 1.0, 65)[:, None] * corner
    out = np.asarray(call_compiled(_closed_form, interior, r))
    return bool((np.diff(np.linalg.norm(out, axis=1)) <= 0).any())


@eqx.filter_jit
def _closed_form(interior, xy):
    return jax.vmap(interior.closed_form)(xy)
