"""Judgement of the four steps of a boresight calibration.

Thresholds and their reasons: docs/boresight.md. Source: paper 003, section 2.3.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.observations import AXES
from jaxphoto.procedures.fit import fit
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import (
    LEVEL,
    Covariance,
    check_discrepancies,
    chi_square_p,
    correlation_matrix,
    covariance,
)

Biases = tuple[tuple[str, str], ...]
"""Shifts and drifts: (strip, "shift" or "drift")."""

SIGNIFICANT = 3.0
"""Standard deviations from which a shift, a drift, a misalignment or a difference of two is significant."""
MAJOR = 10.0
"""Multiple of the stations' sigma from which a significant shift, or drift over half a strip, is major."""
HIGH = 0.9
"""|rho| from which two unknowns are hardly separable."""
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

    `go_on` is True if continuing makes sense, after step 4 if the misalignment is usable. `biases` are the shifts and
    drifts that later steps must keep. `estimates` are all shared unknowns and, in step 4, the differences from step 3.
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


class _Known(NamedTuple):
    """Shared unknowns of a step: label -> value and sigma, in metres, radians, millimetres."""

    value: dict[str, float]
    sigma: dict[str, float]


def judge(number: int, adjusted: Adjustment, last: Step | None = None) -> Step:
    """Judge step `number`, whose block was adjusted; `last` is the previous step (step 4 needs step 3)."""
    cov = covariance(adjusted)
    known = _known(adjusted, cov)
    estimates = [_estimate(label, known.value[label], known.sigma[label]) for label in known.value]
    biases = last.biases if last is not None else ()
    if not bool(adjusted.converged):
        return Step(number, adjusted, cov, tuple(estimates), (adjusted.outcome.value,), False, biases)
    findings, sound = fit(adjusted, cov)
    go_on = True
    if number == 1:
        go_on = sound
        findings.append(
            "no previous problem with image measurements and control"
            if sound
            else "it makes no sense to continue: repeat the measurements named and the calculation; if the problem "
            "persists, repeat the calibration flight"
        )
    elif number == 2:
        found, biases, major = _shifts(adjusted, cov, known)
        findings += [*found, *_inseparable(cov)]
        go_on = sound and not major
        if not go_on:
            findings.append(
                "it makes no sense to continue: recompute the GNSS trajectory (look for breaks and lost ambiguities), "
                "or remove the observations named"
            )
    else:
        findings += _misalignment(adjusted, cov, known)
    if number == 4:
        differences, sentence, bent = _differences(adjusted, cov, known, last, biases)
        estimates += differences
        findings += [sentence, *_checks(adjusted, cov)]
        go_on = not bent
    return Step(number, adjusted, cov, tuple(estimates), tuple(findings), go_on, biases)


def _known(adjusted: Adjustment, cov: Covariance) -> _Known:
    labels, free = adjusted.structure.labels, adjusted.structure.free
    values, sigmas = np.asarray(adjusted.values.shared)[free].tolist(), np.asarray(cov.shared_sigma).tolist()
    return _Known(dict(zip(labels, values, strict=True)), dict(zip(labels, sigmas, strict=True)))


def _estimate(label: str, value: float, sigma: float) -> BoresightEstimate:
    factor = 180 / np.pi if label.endswith("_rad") else 1.0
    name = label.replace("_rad", "_deg")
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    return BoresightEstimate(name, factor * value, factor * sigma, unit)


def _shifts(adjusted: Adjustment, cov: Covariance, known: _Known) -> tuple[list[str], Biases, bool]:
    """Return messages about significant and major shifts and drifts; which to keep; and True if one is major."""
    labels = [label for label in known.value if label.startswith("strips[")]
    owners = [_owner(label) for label in labels]
    note = [] if any(what == "drift" for _, what in owners) else ["no drift is looked for: the images have no times"]
    keep, value, sigma, p = _significant(labels, owners, cov, known)
    if not keep:
        sentence = f"no significant shift or drift (chi-square test of each strip's, least p = {p:.2g})"
        return [f"{sentence}: the next steps leave them out", *note], (), False
    rows = []
    for k, v, s in zip(np.flatnonzero([owner in keep for owner in owners]), value, sigma, strict=True):
        (strip, what), axis = owners[k], labels[k].rsplit("].", 1)[1].split("_")[1]
        size, unit = _size(adjusted, strip, what, axis), "m" if what == "shift" else "m/s"
        text = f"{what} of strip {strip} in {axis} {v:+.4g} {unit} (sigma {s:.2g}, {abs(v) * size:.1f} times"
        rows.append((abs(v) * size, abs(v) / s, f"{text} the stations' sigma)"))
    clear = sorted((r for r in rows if r[1] > SIGNIFICANT), reverse=True) or [max(rows, key=lambda r: r[1])]
    listed = "; ".join(r[2] for r in clear[:_SHOWN]) + (f" and {len(clear) - _SHOWN} more" if clear[_SHOWN:] else "")
    major = bool(clear[0][0] > MAJOR)
    judged = "major shift or drift" if major else "significant shift or drift, not major, which the next steps keep"
    return [f"{judged}: {listed}", *note], keep, major


def _significant(
    labels: list[str], owners: list[tuple[str, str]], cov: Covariance, known: _Known
) -> tuple[Biases, np.ndarray, np.ndarray, float]:
    """Return the nonzero shifts and drifts, their values and sigmas with the others zero, and the smallest p of a test.

    Forward selection: the shift or drift (three axes) that reduces v'Pv / sigma0^2 most is added while the reduction is
    significant. Tested individually they would mask one another, and be masked by a free principal point, which one
    strip cannot separate from its shift.
    """
    place = [cov.labels.index(label) for label in labels]
    q = np.asarray(cov.matrix)[np.ix_(place, place)] * float(cov.variance_factor)
    d = 1 / np.sqrt(np.diagonal(q))
    normal = np.linalg.inv(q * np.outer(d, d)) * np.outer(d, d)
    right = normal @ np.array([known.value[label] for label in labels])

    def fitted(kept: Biases) -> tuple[float, np.ndarray, np.ndarray]:
        mine = [k for k, owner in enumerate(owners) if owner in kept]
        inverse = np.linalg.inv(normal[np.ix_(mine, mine)])
        value = inverse @ right[mine]
        return float(right[mine] @ value), value, np.sqrt(np.diagonal(inverse))

    kept: Biases = ()
    lowered, value, sigma, least = 0.0, np.zeros(0), np.zeros(0), 1.0
    while more := [owner for owner in dict.fromkeys(owners) if owner not in kept]:
        best = max(more, key=lambda owner: fitted((*kept, owner))[0])
        now, then, its = fitted((*kept, best))
        p = chi_square_p(now - lowered, 3)
        least = min(least, p)
        if p > LEVEL:
            break
        kept, lowered, value, sigma = (*kept, best), now, then, its
    return kept, value, sigma, least


def _owner(label: str) -> tuple[str, str]:
    """Return (strip, "shift" or "drift") of the label of a strip's unknown."""
    strip, parameter = label.removeprefix("strips[").rsplit("].", 1)
    return strip, parameter.split("_")[0]


def _size(adjusted: Adjustment, strip: str, what: str, axis: str) -> float:
    """Return a shift of 1 m, or a drift of 1 m/s over half a strip, relative to the stations' sigma."""
    block, stations = adjusted.block, adjusted.block.stations
    mine = (np.array(block.image_strip)[stations.who] == strip) & (stations.axis == AXES.index(axis))
    span = 1.0 if what == "shift" else float(np.ptp(np.asarray(block.image_time)[stations.who[mine]])) / 2
    return span / float(np.sqrt((np.asarray(stations.sigma)[mine] ** 2).mean()))


def _inseparable(cov: Covariance) -> list[str]:
    """Return messages about shifts that an interior orientation may have absorbed."""
    plan = "a shift of every strip along its own heading would pass for it; relief helps, or a held principal point"
    height = "hold c fixed, or fly at two heights"
    found = []
    for axes, ends, mend in (("XY", ("].xp_mm", "].yp_mm"), plan), ("Z", ("].c_mm",), height)):
        shifts = tuple(f".shift_{axis}_m" for axis in axes)
        rho, a, b = _strongest(cov, lambda x, s=shifts: x.endswith(s), lambda x, e=ends: x.endswith(e))
        if abs(rho) > HIGH:
            found.append(f"{a} and {b} are hard to tell apart (rho = {rho:+.3f}): {mend}")
    return found


def _misalignment(adjusted: Adjustment, cov: Covariance, known: _Known) -> list[str]:
    found = []
    for mount in adjusted.unknowns.mounts:
        labels = {axis: f"mounts[{mount}].boresight_{axis}_rad" for axis in _ANGLES}
        angles = {_ANGLES[axis]: (known.value[label], known.sigma[label]) for axis, label in labels.items()}
        values = ", ".join(
            f"{name} {np.degrees(value):+.5f} ({np.degrees(sigma):.5f})" for name, (value, sigma) in angles.items()
        )
        large = [name for name, (value, sigma) in angles.items() if abs(value) > SIGNIFICANT * sigma]
        judged = f"significant: {', '.join(large)}" if large else "not significant"
        found.append(f"misalignment of mount {mount} in degrees (sigma): {values}; {judged}")
    rho, a, b = _strongest(cov, lambda x: "].boresight_" in x, lambda x: x.endswith(("].xp_mm", "].yp_mm")))
    if not a:
        return [*found, "the principal point is held: an error of it is part of the misalignment"]
    angle = _ANGLES[a.removesuffix("_rad")[-1]]
    sentence = f"correlation with the principal point at most {rho:+.3f} ({angle}, {b})"
    if abs(rho) > HIGH:
        sentence += (
            ": high, so the one may stand for the other; fly cross strips, over relief or at two heights, or hold the "
            "principal point fixed"
        )
    return [*found, sentence]


def _strongest(cov: Covariance, first, second) -> tuple[float, str, str]:
    """Return the largest correlation of an unknown of `first` with one of `second`; empty names if none."""
    rho = correlation_matrix(cov)
    one = [k for k, label in enumerate(cov.labels) if first(label)]
    two = [k for k, label in enumerate(cov.labels) if second(label)]
    if not (one and two):
        return 0.0, "", ""
    part = rho[np.ix_(one, two)]
    i, j = np.unravel_index(np.abs(part).argmax(), part.shape)
    return float(part[i, j]), cov.labels[one[i]], cov.labels[two[j]]


def _differences(
    adjusted: Adjustment, cov: Covariance, known: _Known, last: Step | None, biases: Biases
) -> tuple[list[BoresightEstimate], str, bool]:
    """Return step 4 minus step 3 of every boresight angle.

    Step 3 has all observations of step 4, so the difference has the variance Q4 - Q3. Where step 4 fixes shifts that
    step 3 estimated, it is Q4 - C Q3 C' with C = [1, d boresight / d shift]: at most Q4, which is used. sigma0 is that
    of step 4, which control errors do not increase.
    """
    if last is None or last.number != 3:
        raise ValueError("step 4 is judged against step 3: give it as `last`")
    before, s0 = _known(last.adjusted, last.covariance), float(adjusted.sigma0)
    q4, q3 = (dict(zip(c.labels, np.diagonal(c.matrix).tolist(), strict=True)) for c in (cov, last.covariance))
    estimates, worst = [], (0.0, "")
    for label in (x for x in known.value if "].boresight_" in x):
        variance = q4[label] if biases else max(q4[label] - q3[label], 1e-6 * q4[label])
        difference, sigma = known.value[label] - before.value[label], s0 * variance**0.5
        estimate = _estimate(label, difference, sigma)
        estimates.append(estimate._replace(parameter=f"step 4 - step 3: {estimate.parameter}"))
        worst = max(
            worst,
            (abs(difference) / sigma, f"{_ANGLES[label[-5]]} {estimate.value:+.5f} deg (sigma {estimate.sigma:.5f})"),
        )
    bent = worst[0] > SIGNIFICANT
    judged = (
        "a systematic tendency from the control: check its coordinates and its datum against that of the stations"
        if bent
        else "no systematic tendency from the control"
    )
    return estimates, f"step 4 minus step 3 is at most {worst[0]:.1f} of its sigmas, {worst[1]}: {judged}", bent


def _checks(adjusted: Adjustment, cov: Covariance) -> list[str]:
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
