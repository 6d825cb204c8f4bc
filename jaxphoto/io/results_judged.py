"""What the summary.json of results says against them, for all that read them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxphoto.errors import InputError
from jaxphoto.io.json_file import read_json
from jaxphoto.io.names import control_in

SUMMARY = "summary.json"


def read_summary(folder: Path) -> dict[str, Any]:
    """What summary.json in a folder of results says; nothing where there is none that can be read."""
    try:
        told = read_json(folder / SUMMARY)
    except (InputError, OSError):
        return {}
    return told if isinstance(told, dict) else {}


def reservation(summary: Mapping[str, Any]) -> str:
    """That an adjustment did not converge, that its verdict is red and why, that sigma naught fails its test, or that
    one on which it rests is so; ""."""
    if summary.get("converged") is False:
        return f"this adjustment did not converge, so its numbers are no results: {_told(summary.get('outcome'))}"
    if summary.get("verdict") == "red":
        told = summary.get("findings")
        found = [f for f in told if isinstance(f, dict)] if isinstance(told, list) else []
        alarms = [f.get("text") for f in found if f.get("severity") == "error"]
        return f"the verdict on this adjustment is red: {_told(alarms[0] if alarms else None)}"
    test = summary.get("global_test")
    if isinstance(test, dict) and test.get("passed") is False:
        was, wanted = _number(summary.get("sigma0")), _number(test.get("expected_sigma0"))
        return (
            f"sigma naught of this adjustment is {was:.3g}, expected {wanted:.3g}, which is no chance: its weights "
            "or its model are wrong, and its standard deviations with them"
        )
    if isinstance(prior_warnings := summary.get("doubts"), list) and prior_warnings:
        return f"this adjustment rests on an earlier one: {_told(prior_warnings[0])}"
    return ""


def _told(value: Any) -> str:
    """A sentence of a file, if it is one that a terminal would not obey."""
    return value if isinstance(value, str) and not control_in(value) else "see its report"


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")
