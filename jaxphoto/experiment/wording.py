"""How tables read: `table2_iops` is headed `Table 2: IOPs`, `sigma_k1_mm-2` is `σ k1 [10⁻⁷ mm⁻²]`, and digits."""

import math
import re
from collections.abc import Iterable
from decimal import Decimal

_WORDS = {
    "iops": "IOPs", "gcp": "GCP", "abs": "absolute", "rmse": "RMSE", "n": "number of", "sigma": "σ",
    "omega": "ω", "phi": "φ", "kappa": "κ", "domega": "dω", "dphi": "dφ", "dkappa": "dκ",
}  # fmt: skip
_UNITS = {"mm", "m", "px", "um", "deg", "arcsec", "mm-1", "mm-2", "mm-4", "mm-6"}
_SMALL = 1e-3
"""Columns below it throughout are given in a power of ten."""


def table_title(name: str) -> str:
    """`table2_iops` -> `Table 2: IOPs`; `agreement` -> `Agreement`."""
    numbered = re.fullmatch(r"table(\d+)_(.+)", name)
    if numbered:
        return f"Table {numbered[1]}: {_words(numbered[2])}"
    return _words(name)[:1].upper() + _words(name)[1:]


def heading(column: str, unit: str, power: int) -> str:
    """The column in words, with its unit: that of its name, else `unit`; the numbers below are times 10**`power`."""
    stem, _, last = column.rpartition("_")
    named = last in _UNITS and bool(stem)
    of = (last if named else unit).replace("um", "µm")
    of = re.sub(r"\^?-(\d)", lambda m: _raised(-int(m[1])), of)
    scale = f"10{_raised(power)}" if power else ""
    inside = " ".join(word for word in (scale, of) if word)
    return _words(stem if named else column) + (f" [{inside}]" if inside else "")


def power_of(values: Iterable[float]) -> int:
    """The power of ten in which a column of small numbers is given, 0 for others."""
    largest = max((abs(v) for v in values), default=0.0)
    return math.floor(math.log10(largest)) if 0 < largest < _SMALL else 0


def printed_decimals(values: Iterable[float], power: int) -> int | None:
    """Decimals that hold every one of `values` (in 10**`power`) whole; None where there is none but zero."""
    places = [-int(Decimal(repr(float(v))).normalize().as_tuple().exponent) + power for v in values if v]
    return max([0, *places]) if places else None


def own_decimals(value: float, spread: float, printed: int | None, size: float) -> int:
    """Decimals of a value of ours: two digits of its spread, but as many as `printed` and at most one more.

    Where nothing is printed and the spread is not known, three digits of `size`. Whole numbers, which are counted,
    have none.
    """
    if value == round(value) and not spread > 0:
        return 0
    of_spread = 1 - math.floor(math.log10(spread)) if spread > 0 else None
    if printed is not None:
        return min(max(printed, of_spread if of_spread is not None else printed + 1), printed + 1)
    of_size = 2 - math.floor(math.log10(abs(size))) if size else 0
    return max(0, of_spread if of_spread is not None else of_size)


def _words(name: str) -> str:
    return " ".join(_WORDS.get(word, word) for word in name.split("_"))


def _raised(power: int) -> str:
    return str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
