"""Boresight misalignment of a camera in four steps, each with a decision.

1. Adjust without stations and attitudes. Are image measurements and control valid?

2. Add stations, with shift and drift of every strip, but no attitudes. Is the GNSS trajectory valid?

3. Add attitudes with free boresight. The result is the misalignment.

4. Repeat step 3 without control, which becomes check points. Does control distort the misalignment?

A shift or drift that is significant but not major in step 2 is retained: free in step 3, fixed at that value in step 4,
where without control nothing else determines the position of the block. Thresholds and their reasons:
docs/boresight.md. Source: paper 003, section 2.3.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxphoto.adjustment import MAX_STEPS, Adjustment
from jaxphoto.block import Block, Start
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import Mount, StripBias
from jaxphoto.initial.approximate import approximate
from jaxphoto.observations import AXES
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.weights import estimate_weights
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import (
    LEVEL,
    Covariance,
    blunder_test,
    check_discrepancies,
    chi_square_p,
    correlation_matrix,
    covariance,
    redundancy_numbers,
    residual_spread,
)
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import FIXED, FREE, Unknowns
from jaxphoto.variants import indirect, without_attitudes, without_control

Biases = tuple[tuple[str, str], ...]
"""Shifts and drifts: (strip, "shift" or "drift")."""

SIGNIFICANT = 3.0
"""Ratio of a shift, drift, misalignment or difference to its standard deviation above which it is significant."""
MAJOR = 10.0
"""Ratio of a significant shift, or of a drift over half a strip, to the stations' sigma above which it is major."""
HIGH = 0.9
"""Value of |rho| above which two unknowns are hardly separable."""
_SHOWN = 4
TITLES = {
    1: "neither stations nor attitudes: image measurements and control",
    2: "stations and no attitudes: shift and drift",
    3: "stations and attitudes: the misalignment",
    4: "the same without control",
}
_ANGLES = {"x": "d-omega", "y": "d-phi", "z": "d-kappa"}
_UNITS = {"_m_per_s": "m/s", "_mm": "mm", "_deg": "deg", "_m": "m", "_s": "s"}


@pretty_repr
class BoresightEstimate(NamedTuple):
    """Estimate of a step, in `unit` (angles in degrees); sigma is a posteriori."""

    parameter: str
    value: float
    sigma: float
    unit: str


@pretty_repr
class Step(eqx.Module):
    """Step of a boresight calibration: its adjustment and conclusions.

    `go_on` is True if further steps are useful; after step 4, if the misalignment is usable. `biases` are the shifts
    and drifts retained in later steps. `estimates` contains all shared unknowns and, in step 4, the differences from
    step 3.
    """

    number: int = eqx.field(static=True)
    adjusted: Adjustment
    covariance: Covariance
    estimates: tuple[BoresightEstimate, ...] = eqx.field(static=True)
    findings: tuple[str, ...] = eqx.field(static=True)
    go_on: bool = eqx.field(static=True)
    biases: Biases = eqx.field(static=True, default=())

    @property
    def title(self) -> str:
        """Description of the step."""
        return TITLES[self.number]

    @property
    def correlation(self) -> float:
        """Largest correlation of the misalignment with the principal point, with its sign; 0 if either is fixed."""
        return _with_principal_point(self.covariance)[0]


class _SharedParameters(NamedTuple):
    """Shared unknowns of a step: label -> value and sigma, in metres, radians, millimetres."""

    value: dict[str, float]
    sigma: dict[str, float]


def judge(number: int, adjusted: Adjustment, last: Step | None = None) -> Step:
    """Evaluate step `number`, whose block was adjusted; `last` is the previous step (step 4 needs step 3)."""
    cov = covariance(adjusted)
    parameters = _shared_parameters(adjusted, cov)
    estimates = [_estimate(label, parameters.value[label], parameters.sigma[label]) for label in parameters.value]
    biases = last.biases if last is not None else ()
    if not bool(adjusted.converged):
        return Step(number, adjusted, cov, tuple(estimates), (adjusted.outcome.value,), False, biases)
    findings, valid = check_fit(adjusted, cov)
    go_on = True
    if number == 1:
        go_on = valid
        findings.append(
            "no previous problem with image measurements and control"
            if valid
            else "continuing is pointless: repeat the measurements named and the calculation; if the problem persists, "
            "repeat the calibration flight"
        )
    elif number == 2:
        shifts, biases, major = _shifts(adjusted, cov, parameters)
        findings += [*shifts, *_inseparable(cov)]
        go_on = valid and not major
        if not go_on:
            findings.append(
                "continuing is pointless: recompute the GNSS trajectory (check for gaps and lost ambiguities), or "
                "remove the observations named"
            )
    else:
        findings += _misalignment(adjusted, cov, parameters)
    if number == 4:
        differences, sentence, bent = _differences(adjusted, cov, parameters, last, biases)
        estimates += differences
        findings += [sentence, *_check_point_messages(adjusted, cov)]
        go_on = not bent
    return Step(number, adjusted, cov, tuple(estimates), tuple(findings), go_on, biases)


def _shared_parameters(adjusted: Adjustment, cov: Covariance) -> _SharedParameters:
    labels, free = adjusted.structure.labels, adjusted.structure.free
    values, sigmas = np.asarray(adjusted.values.shared)[free].tolist(), np.asarray(cov.shared_sigma).tolist()
    return _SharedParameters(dict(zip(labels, values, strict=True)), dict(zip(labels, sigmas, strict=True)))


def _estimate(label: str, value: float, sigma: float) -> BoresightEstimate:
    factor = 180 / np.pi if label.endswith("_rad") else 1.0
    name = label.replace("_rad", "_deg")
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    return BoresightEstimate(name, factor * value, factor * sigma, unit)


def _shifts(adjusted: Adjustment, cov: Covariance, parameters: _SharedParameters) -> tuple[list[str], Biases, bool]:
    """Return messages about significant and major shifts and drifts, the biases to retain, and True if one is major."""
    labels = [label for label in parameters.value if label.startswith("strips[")]
    owners = [_owner(label) for label in labels]
    note = [] if any(what == "drift" for _, what in owners) else ["no drift is tested: the images have no times"]
    keep, value, sigma, p = _significant(labels, owners, cov, parameters)
    if not keep:
        sentence = f"no significant shift or drift (chi-square test of each strip's, least p = {p:.2g})"
        return [f"{sentence}: the next steps omit them", *note], (), False
    rows = []
    for k, v, s in zip(np.flatnonzero([owner in keep for owner in owners]), value, sigma, strict=True):
        (strip, what), axis = owners[k], labels[k].rsplit("].", 1)[1].split("_")[1]
        size, unit = _size(adjusted, strip, what, axis), "m" if what == "shift" else "m/s"
        text = f"{what} of strip {strip} in {axis} {v:+.4g} {unit} (sigma {s:.2g}, {abs(v) * size:.1f} times"
        rows.append((abs(v) * size, abs(v) / s, f"{text} the stations' sigma)"))
    clear = sorted((r for r in rows if r[1] > SIGNIFICANT), reverse=True) or [max(rows, key=lambda r: r[1])]
    listed = "; ".join(r[2] for r in clear[:_SHOWN]) + (f" and {len(clear) - _SHOWN} more" if clear[_SHOWN:] else "")
    major = bool(clear[0][0] > MAJOR)
    judged = "major shift or drift" if major else "significant shift or drift, not major, which the next steps retain"
    return [f"{judged}: {listed}", *note], keep, major


def _significant(
    labels: list[str], owners: list[tuple[str, str]], cov: Covariance, parameters: _SharedParameters
) -> tuple[Biases, np.ndarray, np.ndarray, float]:
    """Return the significant shifts and drifts, values and sigmas given that all others are zero, and the smallest
    p-value.

    Forward selection: the shift or drift (three axes) that reduces v'Pv / sigma0^2 most is added while the reduction is
    significant. Individual tests would fail: biases mask each other, and a free principal point masks them, because one
    strip cannot separate it from its shift.
    """
    place = [cov.labels.index(label) for label in labels]
    q = np.asarray(cov.matrix)[np.ix_(place, place)] * float(cov.variance_factor)
    d = 1 / np.sqrt(np.diagonal(q))
    normal = np.linalg.inv(q * np.outer(d, d)) * np.outer(d, d)
    right = normal @ np.array([parameters.value[label] for label in labels])

    def fitted(selected: Biases) -> tuple[float, np.ndarray, np.ndarray]:
        columns = [k for k, owner in enumerate(owners) if owner in selected]
        inverse = np.linalg.inv(normal[np.ix_(columns, columns)])
        value = inverse @ right[columns]
        return float(right[columns] @ value), value, np.sqrt(np.diagonal(inverse))

    selected: Biases = ()
    lowered, value, sigma, least = 0.0, np.zeros(0), np.zeros(0), 1.0
    while more := [owner for owner in dict.fromkeys(owners) if owner not in selected]:
        best = max(more, key=lambda owner: fitted((*selected, owner))[0])
        now, then, its = fitted((*selected, best))
        p = chi_square_p(now - lowered, 3)
        least = min(least, p)
        if p > LEVEL:
            break
        selected, lowered, value, sigma = (*selected, best), now, then, its
    return selected, value, sigma, least


def _owner(label: str) -> tuple[str, str]:
    """Return (strip, "shift" or "drift") of a strip unknown's label."""
    strip, parameter = label.removeprefix("strips[").rsplit("].", 1)
    return strip, parameter.split("_")[0]


def _size(adjusted: Adjustment, strip: str, what: str, axis: str) -> float:
    """Return the ratio of a shift of 1 m, or of a drift of 1 m/s over half a strip, to the stations' sigma."""
    block, stations = adjusted.block, adjusted.block.stations
    rows = (np.array(block.image_strip)[stations.who] == strip) & (stations.axis == AXES.index(axis))
    span = 1.0 if what == "shift" else float(np.ptp(np.asarray(block.image_time)[stations.who[rows]])) / 2
    return span / float(np.sqrt((np.asarray(stations.sigma)[rows] ** 2).mean()))


def _inseparable(cov: Covariance) -> list[str]:
    """Return messages about shifts that are correlated with an interior orientation."""
    plan = "a shift of every strip along its heading is equivalent; relief helps, or a fixed principal point"
    height = "fix c, or fly at two heights"
    messages = []
    for axes, ends, advice in (("XY", ("].xp_mm", "].yp_mm"), plan), ("Z", ("].c_mm",), height)):
        shifts = tuple(f".shift_{axis}_m" for axis in axes)
        rho, a, b = _strongest(cov, lambda x, s=shifts: x.endswith(s), lambda x, e=ends: x.endswith(e))
        if abs(rho) > HIGH:
            messages.append(f"{a} and {b} are hardly separable (rho = {rho:+.3f}): {advice}")
    return messages


def _misalignment(adjusted: Adjustment, cov: Covariance, parameters: _SharedParameters) -> list[str]:
    messages = []
    for mount in adjusted.unknowns.mounts:
        labels = {axis: f"mounts[{mount}].boresight_{axis}_rad" for axis in _ANGLES}
        angles = {_ANGLES[axis]: (parameters.value[label], parameters.sigma[label]) for axis, label in labels.items()}
        large = [name for name, (value, sigma) in angles.items() if abs(value) > SIGNIFICANT * sigma]
        judged = f"significant: {', '.join(large)}" if large else "not significant"
        messages.append(f"misalignment of mount {mount}: {judged}")
    rho, a, b = _with_principal_point(cov)
    if not a:
        return [*messages, "the principal point is fixed: its error is part of the misalignment"]
    angle = _ANGLES[a.removesuffix("_rad")[-1]]
    sentence = f"largest correlation with the principal point {rho:+.3f} ({angle}, {b})"
    if abs(rho) > HIGH:
        sentence += ": hardly separable; fly cross strips, over relief or at two heights, or fix the principal point"
    return [*messages, sentence]


def _with_principal_point(cov: Covariance) -> tuple[float, str, str]:
    return _strongest(cov, lambda x: "].boresight_" in x, lambda x: x.endswith(("].xp_mm", "].yp_mm")))


def _strongest(cov: Covariance, first, second) -> tuple[float, str, str]:
    """Return the largest correlation between unknowns of `first` and `second`, with names; empty names if none."""
    rho = correlation_matrix(cov)
    one = [k for k, label in enumerate(cov.labels) if first(label)]
    two = [k for k, label in enumerate(cov.labels) if second(label)]
    if not (one and two):
        return 0.0, "", ""
    part = rho[np.ix_(one, two)]
    i, j = np.unravel_index(np.abs(part).argmax(), part.shape)
    return float(part[i, j]), cov.labels[one[i]], cov.labels[two[j]]


def _differences(
    adjusted: Adjustment, cov: Covariance, parameters: _SharedParameters, last: Step | None, biases: Biases
) -> tuple[list[BoresightEstimate], str, bool]:
    """Return step 4 minus step 3 of every boresight angle.

    Step 3 contains all observations of step 4, so the difference has the variance Q4 - Q3. Where step 4 fixes shifts
    that step 3 estimated, it is Q4 - C Q3 C' with C = [1, d boresight / d shift]. Q4 is used as an upper bound. sigma0
    is taken from step 4, because control errors do not increase it.
    """
    if last is None or last.number != 3:
        raise ValueError("step 4 needs the result of step 3; pass it as `last`")
    before, s0 = _shared_parameters(last.adjusted, last.covariance), float(adjusted.sigma0)
    q4, q3 = (dict(zip(c.labels, np.diagonal(c.matrix).tolist(), strict=True)) for c in (cov, last.covariance))
    estimates, worst = [], (0.0, "")
    for label in (x for x in parameters.value if "].boresight_" in x):
        variance = q4[label] if biases else max(q4[label] - q3[label], 1e-6 * q4[label])
        difference, sigma = parameters.value[label] - before.value[label], s0 * variance**0.5
        estimate = _estimate(label, difference, sigma)
        estimates.append(estimate._replace(parameter=f"step 4 - step 3: {estimate.parameter}"))
        worst = max(
            worst,
            (abs(difference) / sigma, f"{_ANGLES[label[-5]]} {estimate.value:+.5f} deg (sigma {estimate.sigma:.5f})"),
        )
    bent = worst[0] > SIGNIFICANT
    judged = (
        "a systematic effect of the control: check its coordinates and its datum against that of the stations"
        if bent
        else "no systematic effect of the control"
    )
    return estimates, f"step 4 minus step 3 is at most {worst[0]:.1f} of its sigmas, {worst[1]}: {judged}", bent


def _check_point_messages(adjusted: Adjustment, cov: Covariance) -> list[str]:
    """Return messages about discrepancies at the former control points."""
    check = check_discrepancies(adjusted)
    if not len(check.who):
        return []
    d = np.asarray(check.value)
    ratio = np.abs(d) / np.hypot(np.asarray(cov.point_sigma)[check.who, check.axis], np.asarray(check.sigma))
    axes = [(name, d[check.axis == k]) for k, name in enumerate(AXES) if (check.axis == k).any()]
    spread = ", ".join(f"{name} {v.mean():+.3f} and {np.sqrt((v**2).mean()):.3f} m" for name, v in axes)
    k = int(ratio.argmax())
    worst = f"{ratio[k]:.1f} (point {adjusted.block.points[check.who[k]]} in {AXES[check.axis[k]]})"
    return [
        f"surveyed minus computed at {len(np.unique(check.who))} check points, mean and RMSE: {spread}; "
        f"{int((ratio > SIGNIFICANT).sum())} of {len(d)} are above {SIGNIFICANT:.0f} of their sigmas, at most {worst}"
    ]


STEPS = (1, 2, 3, 4)


@outside_transformations
def boresight(
    block: Block,
    *,
    go_on: bool = False,
    max_steps: int = MAX_STEPS,
    report: Callable[[str], object] = lambda text: None,
) -> tuple[Step, ...]:
    """Determine the boresight misalignment of `block` in four steps; return the steps computed.

    Stops after a step that fails its tests, unless `go_on`, and after a step that does not converge. `report` receives
    progress. Interior orientation is estimated according to the block's priors. Raises BlockError if the block lacks
    observations for a step, and the errors of `jaxphoto.adjust`.
    """
    for number in STEPS:
        _require(block, number)
    start = Start(approximate(block), np.ones(len(block.images), bool), np.ones(len(block.points), bool))
    block = dataclasses.replace(block, start=start)
    steps: list[Step] = []
    for number in STEPS:
        report(f"adjusting {len(block.images)} images: step {number} of {len(STEPS)}")
        last = steps[-1] if steps else None
        posed = step_block(block, number, last.biases, last.adjusted.unknowns) if last else step_block(block, number)
        step = judge(number, adjust(posed, max_steps=max_steps), last)
        # Step 4 has the weights of step 3: the variance of their difference requires it.
        fits = number < 4 and bool(step.adjusted.converged) and float(step.adjusted.sigma0) < LARGE_SIGMA0
        weights = estimate_weights(step.adjusted, report=report) if fits else None
        # Larger residuals than stated are what the steps test for.
        if weights and max(weights.sigma_factors.values()) < 1:
            block = block.with_observations(weights.adjusted.block.named_observations)
            step = judge(number, weights.adjusted, last)
            step = dataclasses.replace(step, findings=(weights.words, *step.findings))
        steps.append(step)
        if not (step.go_on or (go_on and bool(step.adjusted.converged))):
            break
    return tuple(steps)


def step_block(block: Block, number: int, biases: Biases = (), before: Unknowns | None = None) -> Block:
    """Return the block adjusted in step `number` (1 to 4), derived from `block`.

    `biases` are the shifts and drifts retained from step 2 (`Step.biases`). `before` contains the unknowns of the
    previous step: initial values and, in step 4, the fixed values of those shifts and drifts. If None, the initial
    values of the block are used. Raises BlockError if the block lacks observations for the step.
    """
    _require(block, number)
    free = strip_biases(block) if number == 2 else biases if number == 3 else ()
    names = [name for name in dict.fromkeys(block.image_strip) if name]
    unknowns, fixed_at = block.start.unknowns, before if before is not None else block.start.unknowns
    zero = StripBias(np.zeros(3), np.zeros(3))  # type: ignore[arg-type]
    strips = {name: unknowns.strips.get(name, zero) for name in names}
    for name, what in biases:
        strips[name] = dataclasses.replace(strips[name], **{what: getattr(fixed_at.strips.get(name, zero), what)})
    prior = lambda name, what: FREE if (name, what) in free else FIXED  # noqa: E731
    strip_priors = {name: StripBias(prior(name, "shift"), prior(name, "drift")) for name in names}  # type: ignore[arg-type]
    posed = indirect(block) if number == 1 else without_attitudes(block) if number == 2 else block
    posed = without_control(posed) if number == 4 else posed
    if before is not None:
        complete = Start(before, np.ones(len(block.images), bool), np.ones(len(block.points), bool))
        posed = dataclasses.replace(posed, start=complete)
    mounts = {name: _mount_prior(prior, number) for name, prior in block.priors.mounts.items()}
    start = dataclasses.replace(posed.start.unknowns, strips=strips)
    priors = dataclasses.replace(posed.priors, mounts=mounts, strips=strip_priors)
    return eqx.tree_at(lambda b: (b.start.unknowns, b.priors), posed, (start, priors))


def strip_biases(block: Block) -> Biases:
    """Return the biases that stations determine: shifts need one station per strip, drifts two at different times."""
    whole = np.bincount(block.stations.who, minlength=len(block.images)) == 3
    biases: list[tuple[str, str]] = []
    for name in dict.fromkeys(block.image_strip):
        images = np.flatnonzero(whole & (np.array(block.image_strip) == name))
        if name and len(images):
            biases.append((name, "shift"))
            if len(np.unique(np.asarray(block.image_time)[images])) > 1:
                biases.append((name, "drift"))
    return tuple(biases)


def _mount_prior(prior: Mount, number: int) -> Mount:
    """Return the prior of a mount. The lever arm is free from step 3 on: without attitudes it is inseparable from
    shifts.
    """
    if number < 3:
        return dataclasses.replace(prior, lever_arm=FIXED, boresight=FIXED, time_offset=FIXED)  # type: ignore[arg-type]
    return dataclasses.replace(prior, boresight=FREE)  # type: ignore[arg-type]


def _require(block: Block, number: int) -> None:
    """Raise BlockError, with the cure, if `block` lacks observations for step `number`."""
    if number not in STEPS:
        raise ValueError(f"unknown boresight step {number!r}; choose 1, 2, 3 or 4")
    what = f"step {number} of the boresight needs"
    if number < 4 and not len(block.control.who) + len(block.fixed.who):
        raise BlockError(f"{what} control points, but the block has none: add control_points.csv")
    if number == 1:
        return
    if not len(block.stations.who):
        raise BlockError(f"{what} camera stations, but the block has none: add stations.csv")
    strips = set(block.image_strip) - {""}
    if not strips:
        raise BlockError(f"{what} strips, but the images have none: add the column strip to images.csv")
    if len(strips) == 1:
        raise BlockError(
            f"{what} two strips or more, but all images are of strip {strips.pop()}, where a misalignment is "
            "equivalent to a shift: add a strip flown in the opposite direction, better also one across"
        )
    if number == 2:
        return
    if not len(block.attitudes.image):
        raise BlockError(f"{what} attitudes, but the block has none: add attitudes.csv")
    with_attitude = np.asarray(block.attitudes.image).tolist()
    turned = {block.image_mount[i] for i in with_attitude}
    if bare := sorted({block.image_camera[i] for i in with_attitude if not block.image_mount[i]}):
        raise BlockError(
            f"{what} a mount, but camera {bare[0]} has none: add [mounts.{bare[0]}] with its lever_arm_m and image_x "
            "to block.toml"
        )
    if blind := [name for name in block.priors.mounts if name not in turned]:
        raise BlockError(f"{what} attitudes, but no image of mount {blind[0]} has one: add them to attitudes.csv")
    if number == 4:
        rays = np.bincount(block.image_points.point, minlength=len(block.points))
        held = np.unique(np.concatenate([block.control.who, block.fixed.who]).astype(int))
        if len(lone := held[rays[held] < 2]):
            raise BlockError(
                f"step 4 of the boresight removes the control, but control point {block.points[lone[0]]} is seen by "
                f"fewer than two images ({len(lone)} such points): measure it in two or more, or remove it"
            )


LARGE_SIGMA0 = 1.5
"""Value of sigma0 above which a rejected test indicates contradictions; below, a priori sigmas are too small."""
_SHOWN = 4


def check_fit(adjusted: Adjustment, cov: Covariance) -> tuple[list[str], bool]:
    """Return messages about sigma0, blunders and control residuals; and True if all are consistent."""
    sigma0, redundancy = float(adjusted.sigma0), adjusted.redundancy
    p = chi_square_p(float(adjusted.sum_of_squares), redundancy)
    sigma0_message = f"sigma0 {sigma0:.3f} with redundancy {redundancy}"
    test = f"(chi-square test, p = {p:.2g})"
    large = p < LEVEL and sigma0 > LARGE_SIGMA0
    if large:
        sigma0_message += f" contradicts the a priori standard deviations {test}: observations are worse than stated"
    elif p < LEVEL:
        sigma0_message += f" is above 1 {test}: enlarge the a priori standard deviations by that factor"
    elif p > 1 - LEVEL:
        sigma0_message += f" is below 1 {test}: the a priori standard deviations are too large"
    else:
        sigma0_message += f" agrees with the a priori standard deviations {test}"
    tested = blunder_test(adjusted, redundancy_numbers(adjusted, cov))
    blunders = tested.suspects
    if blunders:
        shown = ", ".join(f"{b.words} ({abs(b.w):.1f})" for b in blunders[:_SHOWN])
        count = "1 blunder" if len(blunders) == 1 else f"{len(blunders)} blunders, the largest first"
        sentence = f"{count}: {shown}; normalised residuals above {tested.limit:.1f}"
    else:
        sentence = f"no blunder: none of {tested.n} normalised residuals is above {tested.limit:.1f}"
    control = [s for s in residual_spread(adjusted) if s.group == "control_points"]
    on_control = ["residuals at control, RMSE: " + ", ".join(f"{s.axis} {s.rmse:.3f} m" for s in control)]
    return [sigma0_message, sentence, *(on_control if control else [])], not (large or blunders)
