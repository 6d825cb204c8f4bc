"""Whether cameras changed during the flight, in words."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from jaxphoto.camera import ThermalRates
from jaxphoto.errors import camera_words
from jaxphoto.report.digits import of_sigma, with_sigma
from jaxphoto.report.findings import Finding, Level, p_words
from jaxphoto.report.tables import Tables
from jaxphoto.statistics import (
    POWER,
    SIGNIFICANCE_LEVEL,
    CameraDifferences,
    CameraDrift,
    ZeroTest,
    camera_spline_differences,
    strip_differences,
)

_NAMES = {"c": "c", "xp": "x_p", "yp": "y_p", "k1": "K1"}
# Of an hour: a shorter flight is told in minutes.
_HOURS = 1.5
_UM = 1e3
_LARGE_MM = 0.0995


def drift_findings(tables: Tables) -> Iterator[Finding]:
    """Of cameras whose rates or splines were estimated, and of those of strips: what changed, or would have shown."""
    for drift in tables.tested_drifts:
        yield Finding(Level.INFORMATION, drift_words(drift))
    for wandering in camera_spline_differences(tables.adjusted, tables.covariance):
        yield Finding(Level.INFORMATION, differences_words(wandering))
    if (strips := strip_differences(tables.adjusted, tables.covariance)) is not None:
        yield Finding(Level.INFORMATION, differences_words(strips))


def drift_words(drift: CameraDrift) -> str:
    """One camera in one sentence; where it changed, by what did beyond chance, or else by all."""
    test, over, camera = drift.change, _span(drift), camera_words(drift.camera)
    warmed = drift.rates is ThermalRates
    if not test.rejected:
        shown = _least(drift.parameters, test.detectable.tolist())
        what = f"no change of {camera} with its temperature" if warmed else f"no drift of {camera}"
        return (
            f"{what} is seen ({p_words(test.p_value)}); over its {over} this flight would have shown, with a "
            f"probability of {POWER:.0%}, {shown}"
        )
    told = [k for k, p in enumerate(test.p_values) if p < SIGNIFICANCE_LEVEL] or range(len(drift.parameters))
    changes = ", ".join(_change(drift, k) for k in told)
    when = f"changed as it warmed by {over}" if warmed else f"changed over the {over} of its flight"
    return f"{camera} {when} ({p_words(test.p_value)}): {changes}"


def differences_words(found: CameraDifferences) -> str:
    """The cameras of all strips, or of all knots of a spline, in one sentence."""
    test, names, camera = found.more, np.array(found.parameters), camera_words(found.camera)
    each = [(name, np.flatnonzero(names == name)) for name in dict.fromkeys(found.parameters)]
    if not test.rejected:
        shown = _least([name for name, _ in each], [float(test.detectable[own].max()) for _, own in each])
        what = f"no wandering of {camera}" if found.camera else "no difference between the cameras of strips"
        return (
            f"{what} is seen ({p_words(test.p_value)}); any one {'knot' if found.camera else 'strip'} alone would have "
            f"shown, with a probability of {POWER:.0%}, {shown}"
        )
    told = []
    for name, own in each:
        low, high = (int(own[end(test.value[own])]) for end in (np.argmin, np.argmax))
        where = [f"at {found.at[k]} min" if found.camera else f"in strip {found.at[k]}" for k in (low, high)]
        ends = (f"{_signed(name, test, k)} {place}" for k, place in zip((low, high), where, strict=True))
        told.append(f"{_NAMES[name]} from {' to '.join(ends)}")
    changed = f"{camera} wandered during its flight" if found.camera else "the camera is not the same in all strips"
    return f"{changed} ({p_words(test.p_value)}): {', '.join(told)}"


def _least(names: Sequence[str], sizes: Sequence[float]) -> str:
    return ", ".join(
        f"{of_sigma(_factor(name, size) * size)}{_unit(name, size)} of {_NAMES[name]}"
        if math.isfinite(size)
        else f"no change of {_NAMES[name]} at all"
        for name, size in zip(names, sizes, strict=True)
    )


def _signed(name: str, test: ZeroTest, k: int) -> str:
    size = float(test.sigma[k])
    value, sigma = (_factor(name, size) * float(v) for v in (test.value[k], test.sigma[k]))
    return f"{with_sigma(value, sigma)} +- {of_sigma(sigma)}{_unit(name, size)}"


def _change(drift: CameraDrift, k: int) -> str:
    name, test = drift.parameters[k], drift.change
    if name != "c":
        return f"{_NAMES[name]} changed by {_signed(name, test, k)}"
    grown = test._replace(value=np.abs(test.value))
    return f"c {'grew' if test.value[k] > 0 else 'shrank'} by {_signed(name, grown, k)}"


def _span(drift: CameraDrift) -> str:
    if drift.rates is ThermalRates:
        return f"{drift.span:.2g} K"
    return f"{drift.span:.2g} h" if drift.span > _HOURS else f"{60 * drift.span:.2g} min"


def _factor(name: str, size: float) -> float:
    return 1.0 if name == "k1" or size >= _LARGE_MM else _UM


def _unit(name: str, size: float) -> str:
    """In which `size` (mm) is told in two digits: no more micrometres than these."""
    return "" if name == "k1" else " mm" if size >= _LARGE_MM else " um"
