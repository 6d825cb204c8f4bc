"""What a report of DBAT prints, as numbers with the digits they were printed with."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

# In the order of our exterior orientation.
EOP = ("Xc", "Yc", "Zc", "Omega", "Phi", "Kappa")


class Printed(NamedTuple):
    """Value, standard deviation and correlations over 95 % (name -> percent) of one parameter."""

    value: float
    deviation: float
    correlations: dict[str, float]


class Report(NamedTuple):
    sigma0: float
    redundancy: int
    n_unknowns: int
    n_observations: int
    camera: dict[str, Printed]
    photos: dict[str, dict[str, Printed]]
    control: dict[str, list[float]]
    """x, y, z, stdx, stdy, stdz of the adjusted control points."""
    check: dict[str, list[float]]
    """The same of the check points."""
    check_difference: dict[str, list[float]]


def read_report(path: Path) -> Report:
    text = path.read_text(encoding="utf-8", errors="replace")
    camera, rest = text.split("Precisions / Standard Deviations:", 1)
    photos = re.split(r"Photo \d+: (\S+)\n", rest.split("Quality", 1)[0])
    points = {name: _points(text, name) for name in ("Ctrl", "Check")}
    return Report(
        sigma0=float(_first(r"Sigma0:\s+(\S+)", text)),
        redundancy=int(_first(r"Redundancy\s+(\d+)", text)),
        n_unknowns=int(_first(r"Number of params:\s+(\d+)", text)),
        n_observations=int(_first(r"Number of observations:\s+(\d+)", text)),
        camera=_parameters(camera),
        photos={Path(name).stem: _parameters(body) for name, body in zip(photos[1::2], photos[2::2], strict=True)},
        control=points["Ctrl"][1],
        check=points["Check"][1],
        check_difference=points["Check"][2],
    )


def half_unit(printed: float, digits: int) -> float:
    """Half a unit of the last of `digits` significant digits of a printed number."""
    return 0.5 * 10.0 ** (np.floor(np.log10(abs(printed))) - digits + 1)


def assert_printed(value: float, printed: float, digits: int, what: str = "", iteration: float = 0.0) -> None:
    """`value`, rounded to `digits` significant digits, is what was printed.

    `iteration` is how far from the optimum the other program may have stopped.
    """
    allowed = half_unit(printed, digits) * (1 + 1e-9) + iteration
    assert abs(value - printed) <= allowed, f"{what}: {value!r}, printed {printed!r}"


def _first(pattern: str, text: str) -> str:
    found = re.search(pattern, text)
    assert found, pattern
    return found[1]


def _parameters(text: str) -> dict[str, Printed]:
    """Every parameter that has a deviation."""
    pattern = (
        r"^ +(Camera Constant|[A-Z][A-Za-z0-9]+|as|px|py)\b[^\n]*:\n +Value: +(\S+)[^\n]*\n +Deviation: +(\S+)[^\n]*\n"
        r"((?: +(?:Significance|Cumulative significance|Correlations)[^\n]*\n)*)"
    )
    result = {}
    for name, value, deviation, more in re.findall(pattern, text, re.M):
        listed = re.findall(r"([A-Za-z0-9]+):(-?[\d.]+)%", more.partition("Correlations over 95%:")[2])
        result[name] = Printed(float(value), float(deviation), {other: float(rho) for other, rho in listed})
    return result


def _points(text: str, kind: str) -> list[dict[str, list[float]]]:
    """Prior, posterior and difference of control or check points."""
    section = text.partition(f"{kind} measurements")[2].split("point delta", 1)[0]
    if "none" in section.split("id,", 1)[0] or "id," not in section:
        return [{}, {}, {}]
    rows = [re.findall(r"^ +(\S+),((?: +[-\d.]+%?,){6})", part, re.M) for part in re.split(r"id, +x,", section)[1:]]
    return [{name: [float(v.strip(" %")) for v in cells.split(",")[:6]] for name, cells in part} for part in rows]
