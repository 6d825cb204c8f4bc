"""What a person should know first: warnings about an adjustment, most serious first, each with what to do."""

import equinox as eqx
import jax
import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.camera import Sensor
from jaxphoto.compiling import call_compiled
from jaxphoto.report.tables import Tables
from jaxphoto.report.weakness import weaknesses
from jaxphoto.statistics import LEAST_CHECKED, SIGNIFICANT_RATIO, Correlations

HIGH_CORRELATION = 0.9
HIGH_OWN_CORRELATION = 0.95
LARGE_W = 4.0
_SHOWN = 4


def warnings_of(tables: Tables) -> list[str]:
    """Non-convergence, weaknesses, high correlations, insignificant IOP, large residuals, range of the distortion."""
    adjusted, found = tables.adjusted, []
    if not bool(adjusted.converged):
        found.append(adjusted.outcome.value)
    for camera, c in tables.correlations.items():
        weak = weaknesses(tables, camera, c)
        found += [w.sentence for w in weak]
        found += _correlated(camera, c, frozenset().union(*(w.explains for w in weak)), _all_known(adjusted.block))
    found += [
        f"{s.parameter} of camera {s.camera} is not significant: |value| is {s.ratio:.1f} sigma (asked: "
        f"{SIGNIFICANT_RATIO:.0f}; t-test p = {s.p_value:.2g}); consider holding it fixed"
        for s in tables.significance
        if not s.significant
    ]
    found += _large_residuals(tables)
    found += [
        f"camera {name}: its distortion folds inside the format; image points beyond the fold mean nothing, use fewer "
        "coefficients or more points in the corners"
        for name, sensor in adjusted.block.sensors.items()
        if _folds(adjusted, name, sensor)
    ]
    return found


def _all_known(block: Block) -> bool:
    """Whether all points are known beforehand: a field of targets."""
    return len(np.union1d(block.control.who, block.fixed.who)) == len(block.points)


def _correlated(camera: str, c: Correlations, explained: frozenset[tuple[str, str]], field: bool) -> list[str]:
    """High correlations, but for the pairs of exterior and interior orientation that are `explained` already.

    What cures them depends on whether all images show a `field` of known targets.
    """
    found = []
    cure = "add cross strips, control or height differences"
    usual = "usual without camera stations or attitudes, their effects on the ground cancel"
    if field:
        cure = "add photographs turned by 90 degrees about the line of sight, and tilted ones"
        usual = "usual where targets alone orient an image, their effects on it cancel"
    pairs = [
        (abs(c.interior[i, j]), c.interior[i, j], a, c.parameters[j])
        for i, a in enumerate(c.parameters)
        for j in range(i)
        if abs(c.interior[i, j]) > HIGH_CORRELATION
    ]
    for _, rho, a, b in sorted(pairs, reverse=True)[:_SHOWN]:
        found.append(
            f"high correlation of {a} and {b} of camera {camera}: {rho:+.3f}; a combination of them is better known"
        )
    if len(c.images) == 0:
        return found
    told = [[(e, p) in explained for p in c.parameters] for e in c.eop_names]
    worst = np.where(np.reshape(told, c.max_abs.shape), 0.0, c.max_abs)
    for i, j in sorted(np.argwhere(worst > HIGH_CORRELATION).tolist(), key=lambda k: -worst[k[0], k[1]])[:_SHOWN]:
        image = c.images[int(np.abs(c.exterior[:, i, j]).argmax())]
        found.append(
            f"high correlation of {c.eop_names[i]} with {c.parameters[j]} of camera {camera}: up to {worst[i, j]:.3f} "
            f"(image {image}); {cure}"
        )
    own = np.abs(c.within_image).max(axis=0)
    strong = [(own[i, j], i, j) for i in range(6) for j in range(i) if own[i, j] > HIGH_OWN_CORRELATION]
    if strong:
        names = ", ".join(f"{c.eop_names[j]} and {c.eop_names[i]} (up to {r:.3f})" for r, i, j in sorted(strong)[::-1])
        found.append(f"exterior orientation of single images is highly correlated: {names}; {usual}")
    return found


def _large_residuals(tables: Tables) -> list[str]:
    residuals = tables.residuals
    checked = (residuals["group"] == "image_points") & (residuals["redundancy_number"] > LEAST_CHECKED)
    found = residuals[checked & (residuals["w"].abs() > LARGE_W)]
    # A point in an image is one blunder, whichever of its coordinates shows it.
    by_image_point = found["w"].abs().groupby([found["point"], found["image"]], sort=False)
    large = by_image_point.max().sort_values(ascending=False)
    if not len(large):
        return []
    shown = large.head(_SHOWN)
    names = ", ".join(
        f"point {where[0]} in image {where[1]} ({w:.1f})" for where, w in zip(shown.index.tolist(), shown, strict=True)
    )
    count = "1 image point has a residual" if len(large) == 1 else f"{len(large)} image points have residuals"
    return [f"{count} over {LARGE_W:.0f} of its own standard deviations: {names}; look for blunders"]


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
