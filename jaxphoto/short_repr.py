"""Short `repr` and HTML of objects: counts, values, outcome, sigma naught.

Tables and plots are created by `jaxphoto.report`, which this module must not import; objects import its functions by
name when they are called (`from_upstairs`).
"""

import dataclasses
import enum
import importlib
import textwrap
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T", bound=type)
# Limits of a printed object: characters per field, numbers or names shown, table rows, fields.
_LONGEST, _FEW, _ROWS, _FIELDS = 72, 4, 20, 24

# Two-sided 0.1 % quantile of the normal distribution.
_ONE_IN_A_THOUSAND = 3.29


def from_upstairs(name: str, room: str = "report") -> Any:
    """Import and return a function of a package that depends on this module."""
    return getattr(importlib.import_module(f"jaxphoto.{room}"), name)


def html_of(title: str, rows: Mapping[str, object]) -> str:
    """Return a small HTML table under a title."""
    cells = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(str(value))}</td></tr>'
        for name, value in rows.items()
    )
    return f"<b>{escape(title)}</b><table>{cells}</table>"


def pretty_repr(cls: T) -> T:
    """Add a short `repr` and an HTML table of the fields to a class."""
    cls.__repr__ = fields_repr  # type: ignore[assignment]
    cls._repr_html_ = fields_html  # type: ignore[attr-defined]
    return cls


def fields_repr(thing: Any) -> str:
    """Return `Name(field text, field text, ...)`, wrapped."""
    told = [f"{name} {field_word(value)}".strip() for name, value in _fields(thing)]
    if len(told) > _FIELDS:
        told[_FIELDS:] = [f"{len(told) - _FIELDS} more"]
    return "\n".join(textwrap.wrap(f"{type(thing).__name__}({', '.join(told)})", 110, subsequent_indent="  "))


def fields_html(thing: Any) -> str:
    """Return the fields as an HTML table, followed by fields that are tables themselves."""
    fields = dict(_fields(thing))
    tables = {name: rows for name, rows in fields.items() if _is_rows(rows)}
    words = {name: field_word(value) for name, value in fields.items() if name not in tables}
    return html_of(type(thing).__name__, words) + "".join(_rows_html(name, rows) for name, rows in tables.items())


def _fields(thing: Any) -> Iterator[tuple[str, Any]]:
    """Yield the fields that exist: a tree that JAX rebuilds may lack some."""
    names = getattr(thing, "_fields", None) or [field.name for field in dataclasses.fields(thing)]
    given = ((name, getattr(thing, name, None)) for name in names if not name.startswith("_"))
    return ((name, value) for name, value in given if value is not None and not _is_empty(value))


def _is_empty(value: Any) -> bool:
    return isinstance(value, str | tuple | list | dict) and not value


def _is_rows(value: Any) -> bool:
    """Return True for a list of records of one kind that contain only text and numbers."""
    if not isinstance(value, tuple | list) or not value or not hasattr(value[0], "_fields"):
        return False
    plain = str | int | float | np.generic | None
    return all(type(row) is type(value[0]) and all(isinstance(cell, plain) for cell in row) for row in value)


def _rows_html(name: str, rows: Any) -> str:
    head = "".join(f"<th>{escape(field)}</th>" for field in rows[0]._fields)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(field_word(cell))}</td>' for cell in row)}</tr>" for row in rows[:_ROWS]
    )
    more = f"<p>{len(rows) - _ROWS} more</p>" if len(rows) > _ROWS else ""
    return f"<b>{escape(name)}</b><table><tr>{head}</tr>{body}</table>{more}"


def field_word(value: Any) -> str:
    """Describe the value of a field in a few words."""
    if isinstance(value, str):
        return textwrap.shorten(value, _LONGEST, placeholder=" ...")
    if isinstance(value, bool | np.bool_):
        return str(value)
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, type):
        return value.__name__
    if isinstance(value, Mapping | tuple | list) and not hasattr(value, "_fields"):
        return _several_word(value)
    if hasattr(value, "_fields") or dataclasses.is_dataclass(value):
        word = " ".join(repr(value).split()) if hasattr(type(value), "_repr_html_") else ""
        return word if 0 < len(word) <= _LONGEST else type(value).__name__
    if isinstance(value, int | float | np.generic) or hasattr(value, "shape"):
        return number_word(value)
    return getattr(value, "__name__", type(value).__name__)


def _several_word(value: Any) -> str:
    """Describe a list: the first names and numbers, or the number of objects."""
    if isinstance(value, Mapping) and all(isinstance(v, int | float) for v in value.values()) and len(value) <= _FEW:
        return numbers_words(value)
    items = [str(key) for key in value] if isinstance(value, Mapping) else list(value)
    if all(isinstance(item, str | int | float | np.generic) for item in items):
        told = " ".join(field_word(item) for item in items[:_FEW])
        return told if len(items) <= _FEW else f"{len(items)}: {told} ..."
    kinds = sorted({type(item).__name__ for item in items})
    return f"{len(items)} {' '.join(kinds)}"


def number_word(value: Any) -> str:
    """Format a scalar or short vector with six significant digits; describe a larger array by its shape."""
    if np.ndim(value) == 0 and isinstance(value, int | float | np.generic | np.ndarray):
        return f"{float(value):.6g}"
    if hasattr(value, "shape") and not np.ndim(value):
        # A traced JAX array has no value.
        return f"{float(value):.6g}" if getattr(value, "is_fully_addressable", False) else type(value).__name__
    # A traced JAX array has no value.
    known = isinstance(value, np.ndarray) or getattr(value, "is_fully_addressable", False)
    if known and value.dtype.kind in "iuf" and value.ndim == 1 and 0 < value.size <= _FEW:
        return " ".join(number_word(v) for v in np.asarray(value))
    return f"array{tuple(value.shape)}" if hasattr(value, "shape") else " ".join(repr(value).split())


def numbers_words(numbers: Mapping[str, Any]) -> str:
    """Format `c_mm 34.25, k1 -9.12e-05`."""
    return ", ".join(f"{name} {number_word(value)}" for name, value in numbers.items())


def _observed(block: Any) -> dict[str, int]:
    """Count the observations of each kind other than image points."""
    rows = {
        "control coordinate": block.control.who,
        "fixed coordinate": block.fixed.who,
        "check coordinate": block.check.who,
        "station coordinate": block.stations.who,
        "attitude": block.attitudes.image,
        "distance": block.distances.value,
        "surface point": block.surfaces.point,
    }
    return {name: n for name, own in rows.items() if (n := _length(own))}


def block_html(block: Any, unknowns: Mapping[str, object], title: str = "Block") -> str:
    """Return the counts of a block and its `unknowns` (texts by owner) as an HTML table."""
    counts: dict[str, object] = {
        "images": f"{len(block.images)} of {_counted(len(block.sensors), 'camera')}",
        "points": f"{len(block.points)} in {_counted(_length(block.image_points.image), 'image point')}",
    }
    return html_of(
        f"{title} {block.title!r}", counts | {f"{k}s": n for k, n in _observed(block).items()} | dict(unknowns)
    )


def adjustment_html(adjusted: Any, unknowns: Mapping[str, object]) -> str:
    """Return outcome and quality of an adjustment and its shared unknowns (texts by owner) as an HTML table."""
    if adjusted.factored is None or np.ndim(adjusted.converged) != 0:
        return escape(adjustment_repr(adjusted))
    rows: dict[str, object] = {
        "outcome": adjusted.outcome.value,
        "iterations": int(adjusted.steps),
        "sigma naught": _sigma0_words(adjusted),
        "redundancy": adjusted.redundancy,
    }
    groups = {name.replace("_", " "): n for name, n in adjusted.n_observations.items() if n}
    rows["observations"] = ", ".join(f"{n} {name}" for name, n in groups.items())
    return html_of(f"Adjustment of {adjusted.block.title!r}", rows | dict(unknowns))


def block_repr(block: Any) -> str:
    """Return `Block 'title': 31 images of 1 camera, 352 points in 2415 image points; ...` and other observations."""
    more = ", ".join(_counted(n, name) for name, n in _observed(block).items())
    return (
        f"Block {block.title!r}: {_counted(len(block.images), 'image')} of {_counted(len(block.sensors), 'camera')}, "
        f"{_counted(len(block.points), 'point')} in {_counted(_length(block.image_points.image), 'image point')}"
        + (f";\n  {more}" if more else "")
    )


def adjustment_repr(adjusted: Any) -> str:
    """Return `Adjustment of 'title': converged ...`, steps, sigma naught and redundancy, in two lines."""
    of = f"Adjustment of {adjusted.block.title!r}"
    # Traced arrays have no value, and several blocks have no common one; `factored` is None in a JAX transformation.
    if adjusted.factored is None or np.ndim(adjusted.converged) != 0:
        return f"{of}: traced by JAX or batched, values are arrays"
    observations, unknowns = (sum(n.values()) for n in (adjusted.n_observations, adjusted.n_unknowns))
    return (
        f"{of}: {adjusted.outcome.value.partition(':')[0]} after {_counted(int(adjusted.steps), 'step')},\n"
        f"  sigma naught {_sigma0_words(adjusted)}, redundancy {adjusted.redundancy} "
        f"({_counted(observations, 'observation')}, {_counted(unknowns, 'unknown')})"
    )


def _sigma0_words(adjusted: Any) -> str:
    """Format `1.043`; outside the 99.9 % interval also the expected interval."""
    sigma0, redundancy = float(adjusted.sigma0), adjusted.redundancy
    if redundancy <= 0:
        return f"{sigma0:.4g}"
    # With many degrees of freedom, sigma naught is normally distributed about 1 with the variance 1 / (2 redundancy).
    expected = _ONE_IN_A_THOUSAND / (2 * redundancy) ** 0.5
    asks = f" (expected 1 +- {expected:.2g}: see .verdict())" if abs(sigma0 - 1) > expected else ""
    return f"{sigma0:.4g}{asks}"


def simulation_repr(simulated: Any) -> str:
    """Return `Simulation with its truth, of Block ...` and the size of its lidar data."""
    more = ", ".join(_scanned(simulated).values())
    return f"Simulation with its truth, of {block_repr(simulated.block)}" + (f";\n  {more}" if more else "")


def simulation_html(simulated: Any) -> str:
    """Return the counts of its block, cloud and trajectory and the true shared parameters as an HTML table."""
    truth = {f"true {name}": words for name, words in simulated.truth.words.items()}
    return block_html(simulated.block, _scanned(simulated) | truth, "Simulation of block")


def _scanned(simulated: Any) -> dict[str, str]:
    cloud, trajectory = simulated.cloud, simulated.trajectory
    of_cloud = {} if cloud is None else {
        "cloud": f"{_counted(_length(cloud.xyz), 'laser point')} of {_counted(len(cloud.strips), 'strip')}"
    }  # fmt: skip
    n = 0 if trajectory is None else _length(trajectory.time)
    records = {"trajectory": f"{_counted(n, 'record')} of GNSS/IMU"} if n else {}
    return of_cloud | records


def change_repr(found: Any) -> str:
    """Return `Change: ...` and one line per test."""
    told = "; ".join(f"{name}: {words}" for name, words in _tests(found).items())
    return f"Change: {_change_words(found)};\n  {told}"


def change_html(found: Any) -> str:
    """Return the verdict, the tests and the parameters of both calibrations as an HTML table."""
    used = [one for one in found.parameters if one.sigma > 0 or one.first or one.second]
    rows = {"verdict": _change_words(found), **_tests(found)}
    return html_of("Change", rows) + (_rows_html("parameters", used) if used else "")


def _change_words(found: Any) -> str:
    return "the camera has changed significantly" if found.changed else "no significant change of the camera"


def _tests(found: Any) -> dict[str, str]:
    """Describe each test of the comparison."""
    of_all = f"at {int(found.beyond.sum())} of {len(found.limit_mm)} points of the format"
    tests = {"beyond the 95 % limit": of_all}
    if np.isfinite(found.p_field):
        tests = {f"bundles of rays ({found.field.method})": f"p {found.p_field:.2g}"} | tests
    if not found.degrees_of_freedom:
        return tests
    p = f"{found.p_parameters:.2g}" if found.p_parameters else "< 1e-300"
    chi = f"chi-square {found.chi_square:.4g} of {found.degrees_of_freedom}, p {p}"
    return {"parameters": chi} | tests


def _counted(n: int, name: str) -> str:
    return f"{n} {name}" + ("s" if n != 1 else "")


def _length(rows: Any) -> int:
    """Return the length of an array, 0 for any other value: while JAX maps over a tree, its leaves are arbitrary
    objects.
    """
    return next(iter(getattr(rows, "shape", ())), 0)
