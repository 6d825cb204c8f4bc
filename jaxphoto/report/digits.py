"""Numbers with as many digits as their standard deviations have a use for."""

import math
import re
from collections.abc import Iterable

# From here on a number is written without a power of ten, as by Python's "g".
_LEAST = 1e-4
# Digits beyond these are no more than rounding of the computation.
_MOST = 12
# Numbers of up to ten digits that are written with a power of ten.
_LARGE = re.compile(r"(?<![\w.])([+-]?)(\d(?:\.\d*)?e\+0\d)(?!\w)")


def with_sigma(value: float, sigma: float) -> str:
    """A number to the second digit of its standard deviation; zero where it is less than half of that."""
    if not sigma > 0 or not value or not math.isfinite(value):
        return f"{value:.8g}"
    power = math.floor(math.log10(max(abs(value), sigma)))
    places = min(1 - math.floor(math.log10(sigma)), _MOST - 1 - power)
    if max(abs(value), sigma) >= _LEAST:
        said = f"{value:.{max(places, 0)}f}"
    elif abs(value) >= sigma:
        said = f"{value:.{places + power}e}"
    else:
        said = f"{value / 10.0**power:.{places + power}f}e{power:03d}"
    if float(said) == 0:
        return said.removeprefix("-") if "e" not in said else "0"
    return said


def of_sigma(sigma: float) -> str:
    """A standard deviation in two digits."""
    return in_figures(sigma, 2) if sigma > 0 else ""


def of_p(p_value: float, digits: int = 2) -> str:
    """A p-value; what is too small for a number is no zero."""
    return f"{p_value:.{digits}g}" if p_value > 0 else "< 1e-300"


def in_figures(value: float, figures: int) -> str:
    """A number in so many figures, its last zeros too: 0.00350 beside 0.00286; zero is 0."""
    return without_powers(f"{value:#.{figures}g}").replace(".e", "e").rstrip(".") if value else "0"


def without_powers(text: str) -> str:
    """A text whose large numbers are written out: 400 m, and not 4e+02 m."""
    return _LARGE.sub(lambda number: f"{number[1]}{float(number[2]):.0f}", text)


def alike(values: Iterable[float], most: int) -> list[str]:
    """Numbers of one column in as many figures as the longest of them has, and no more than `most`."""
    told = [f"{v:.{most}g}" for v in values]
    figures = max((_figures(said) for said in told), default=most)
    return [in_figures(float(said), figures) for said in told]


def _figures(said: str) -> int:
    """Of a number as "g" writes it: 3 of 0.00286, 2 of 20."""
    return len(said.partition("e")[0].lstrip("-").replace(".", "").lstrip("0"))
