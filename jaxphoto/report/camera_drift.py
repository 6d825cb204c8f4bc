"""Whether cameras changed during the flight, in words."""

import math
from collections.abc import Iterator

from jaxphoto.errors import camera_words
from jaxphoto.report.digits import of_sigma, with_sigma
from jaxphoto.report.findings import Finding, Level, p_words
from jaxphoto.report.tables import Tables
from jaxphoto.statistics import POWER, SIGNIFICANCE_LEVEL, CameraDrift

_NAMES = {"c": "c", "xp": "x_p", "yp": "y_p", "k1": "K1"}
# Of an hour: a shorter flight is told in minutes.
_HOURS = 1.5
_UM = 1e3


def drift_findings(tables: Tables) -> Iterator[Finding]:
    """Of every camera whose rates were estimated: how it changed, or what change this flight would have shown."""
    for drift in tables.tested_drifts:
        yield Finding(Level.INFORMATION, drift_words(drift))


def drift_words(drift: CameraDrift) -> str:
    """One camera in one sentence."""
    return _moved(drift) if drift.moved else _still(drift)


def _moved(drift: CameraDrift) -> str:
    """What changed beyond chance; where no parameter did by itself, all of them are told."""
    told = [k for k, p in enumerate(drift.p_values) if p < SIGNIFICANCE_LEVEL] or range(len(drift.parameters))
    changes = ", ".join(_change(drift, k) for k in told)
    whose = f"{camera_words(drift.camera)} changed over the {_duration(drift)} of its flight"
    return f"{whose} ({p_words(drift.p_value)}): {changes}"


def _still(drift: CameraDrift) -> str:
    shown = zip(drift.parameters, drift.detectable.tolist(), strict=True)
    return (
        f"no drift of {camera_words(drift.camera)} is seen ({p_words(drift.p_value)}); over its {_duration(drift)} "
        f"this flight would have shown, with a probability of {POWER:.0%}, "
        f"{', '.join(_least(*each) for each in shown)}"
    )


def _least(name: str, size: float) -> str:
    if not math.isfinite(size):
        return f"no change of {_NAMES[name]} at all"
    return f"{of_sigma(_factor(name) * size)}{_unit(name)} of {_NAMES[name]}"


def _change(drift: CameraDrift, k: int) -> str:
    name = drift.parameters[k]
    value, sigma = (_factor(name) * float(v) for v in (drift.change[k], drift.sigma[k]))
    verb = ("grew by" if value > 0 else "shrank by") if name == "c" else "changed by"
    size = abs(value) if name == "c" else value
    return f"{_NAMES[name]} {verb} {with_sigma(size, sigma)} +- {of_sigma(sigma)}{_unit(name)}"


def _duration(drift: CameraDrift) -> str:
    return f"{drift.hours:.2g} h" if drift.hours > _HOURS else f"{60 * drift.hours:.2g} min"


def _factor(name: str) -> float:
    return 1.0 if name == "k1" else _UM


def _unit(name: str) -> str:
    return "" if name == "k1" else " um"
