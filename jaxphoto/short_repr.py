"""Short `repr` and HTML of objects: counts, values, outcome, sigma naught.

Tables and plots are created by `jaxphoto.report`, which this module must not import; objects import its functions by
name when they are called (`from_upstairs`).
"""

import dataclasses
import enum
import importlib
import textwrap
from collections.abc import Mapping
from html import escape
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T", bound=type)
# Limits of a printed object: characters per field, numbers or names shown, table rows, fields.
_LONGEST, _FEW, _ROWS, _FIELDS = 72, 4, 20, 24


def from_upstairs(name: str, room: str = "report") -> Any:
    """Import and return a function of a package that depends on this module."""
    return getattr(importlib.import_module(f"jaxphoto.{room}"), name)


def html_of(title: str, rows: Mapping[str, object]) -> str:
    """Return a small HTML table under a title."""
    left = ' style="text-align:left"'
    cells = (f"<tr><th{left}>{escape(k)}</th><td{left}>{escape(str(v))}</td></tr>" for k, v in rows.items())
    return f"<b>{escape(title)}</b><table>{''.join(cells)}</table>"


def pretty_repr(cls: T) -> T:
    """Add a short `repr` and an HTML table of the fields to a class."""
    cls.__repr__ = fields_repr  # type: ignore[assignment]
    cls._repr_html_ = fields_html  # type: ignore[attr-defined]
    return cls


def _fields(thing: Any) -> dict[str, Any]:
    """Return the fields that have a value: a tree that JAX rebuilds may lack some."""
    names = getattr(thing, "_fields", None) or [field.name for field in dataclasses.fields(thing)]
    values = {name: getattr(thing, name, None) for name in names if not name.startswith("_")}
    empty = lambda v: v is None or (isinstance(v, str | tuple | list | dict) and not v)  # noqa: E731
    return {name: value for name, value in values.items() if not empty(value)}


def fields_repr(thing: Any) -> str:
    """Return `Name(field text, field text, ...)`, wrapped."""
    words = [f"{name} {field_word(value)}".strip() for name, value in _fields(thing).items()]
    words[_FIELDS:] = [f"{len(words) - _FIELDS} more"] if len(words) > _FIELDS else []
    return "\n".join(textwrap.wrap(f"{type(thing).__name__}({', '.join(words)})", 110, subsequent_indent="  "))


def fields_html(thing: Any) -> str:
    """Return the fields as an HTML table."""
    return html_of(type(thing).__name__, {name: field_word(value) for name, value in _fields(thing).items()})


def field_word(value: Any) -> str:
    """Describe the value of a field in a few words."""
    if isinstance(value, str):
        return textwrap.shorten(value, _LONGEST, placeholder=" ...")
    if isinstance(value, enum.Enum | type):
        return getattr(value, "__name__", getattr(value, "name", ""))
    if isinstance(value, Mapping | tuple | list) and not hasattr(value, "_fields"):
        if (
            isinstance(value, Mapping)
            and len(value) <= _FEW
            and all(isinstance(v, int | float) for v in value.values())
        ):
            return numbers_words(value)
        if not all(isinstance(item, str | int | float | np.generic) for item in value):
            return f"{len(value)} {' '.join(sorted({type(item).__name__ for item in value}))}"
        first = " ".join(map(field_word, list(value)[:_FEW]))
        return first if len(value) <= _FEW else f"{len(value)}: {first} ..."
    if isinstance(value, bool | np.bool_):
        return str(value)
    if isinstance(value, int | float | np.generic) or hasattr(value, "shape"):
        return number_word(value)
    word = " ".join(repr(value).split()) if hasattr(type(value), "_repr_html_") else ""
    return word if 0 < len(word) <= _LONGEST else getattr(value, "__name__", type(value).__name__)


def number_word(value: Any) -> str:
    """Format a scalar or short vector with six significant digits; describe other arrays by shape."""
    known = isinstance(value, int | float | np.generic | np.ndarray) or getattr(value, "is_fully_addressable", False)
    if known and np.ndim(value) == 0:
        return f"{float(value):.6g}"
    if known and value.dtype.kind in "iuf" and value.ndim == 1 and 0 < value.size <= _FEW:
        return " ".join(map(number_word, np.asarray(value)))
    if not hasattr(value, "shape"):
        return " ".join(repr(value).split())
    # A traced scalar has no value.
    return f"array{tuple(value.shape)}" if value.shape else type(value).__name__


def numbers_words(numbers: Mapping[str, Any]) -> str:
    """Format `c_mm 34.25, k1 -9.12e-05`."""
    return ", ".join(f"{name} {number_word(value)}" for name, value in numbers.items())


# Blocks, adjustments, simulations, changes -----------------------------------------------------------------------


def _counted(n: int, name: str) -> str:
    return f"{n} {name}" + ("s" if n != 1 else "")


def _length(rows: Any) -> int:
    """Return the length of an array, 0 for any other value: while JAX maps over a tree, leaves are any objects."""
    return next(iter(getattr(rows, "shape", ())), 0)


def _observed(block: Any) -> dict[str, int]:
    """Count the observations of each kind other than image points."""
    rows = {
        "control coordinate": block.control.who, "fixed coordinate": block.fixed.who,
        "check coordinate": block.check.who, "station coordinate": block.stations.who,
        "attitude": block.attitudes.image, "distance": block.distances.value, "surface point": block.surfaces.point,
    }  # fmt: skip
    return {name: n for name, own in rows.items() if (n := _length(own))}


def block_repr(block: Any) -> str:
    """Return `Block 'title': 31 images of 1 camera, 352 points in 2415 image points; ...` and other observations."""
    more = ", ".join(_counted(n, name) for name, n in _observed(block).items())
    images = f"{_counted(len(block.images), 'image')} of {_counted(len(block.sensors), 'camera')}"
    points = f"{_counted(len(block.points), 'point')} in {_counted(_length(block.image_points.image), 'image point')}"
    return f"Block {block.title!r}: {images}, {points}" + (f";\n  {more}" if more else "")


def block_html(block: Any, unknowns: Mapping[str, object], title: str = "Block") -> str:
    """Return the counts of a block and its `unknowns` (texts by owner) as an HTML table."""
    counts = {"images": f"{len(block.images)} of {_counted(len(block.sensors), 'camera')}", "points": len(block.points)}
    observed = {"image point": _length(block.image_points.image), **_observed(block)}
    rows = {**counts, **{f"{name}s": n for name, n in observed.items()}, **unknowns}
    return html_of(f"{title} {block.title!r}", rows)


def adjustment_repr(adjusted: Any) -> str:
    """Return `Adjustment of 'title': converged ...`, steps, sigma naught and redundancy, in two lines."""
    of = f"Adjustment of {adjusted.block.title!r}"
    # Traced arrays have no value, and several blocks have no common one; `factored` is None in a JAX transformation.
    if adjusted.factored is None or np.ndim(adjusted.converged) != 0:
        return f"{of}: traced by JAX or batched, values are arrays"
    observations, unknowns = (sum(n.values()) for n in (adjusted.n_observations, adjusted.n_unknowns))
    sigma0, f = float(adjusted.sigma0), adjusted.redundancy
    # With many degrees of freedom, sigma naught is normally distributed about 1 with the variance 1 / (2 redundancy);
    # 3.29 is the two-sided 0.1 % quantile.
    expected = 3.29 / (2 * f) ** 0.5 if f > 0 else np.inf
    asks = f" (expected 1 +- {expected:.2g}: see .verdict())" if abs(sigma0 - 1) > expected else ""
    return (
        f"{of}: {adjusted.outcome.value.partition(':')[0]} after {_counted(int(adjusted.steps), 'step')},\n"
        f"  sigma naught {sigma0:.4g}{asks}, redundancy {f} "
        f"({_counted(observations, 'observation')}, {_counted(unknowns, 'unknown')})"
    )


def adjustment_html(adjusted: Any, unknowns: Mapping[str, object]) -> str:
    """Return outcome and quality of an adjustment and its shared unknowns (texts by owner) as an HTML table."""
    title = f"Adjustment of {adjusted.block.title!r}"
    return html_of(title, {"outcome": adjustment_repr(adjusted)[len(title) + 2 :], **unknowns})


def _scanned(simulated: Any) -> dict[str, str]:
    cloud, trajectory, words = simulated.cloud, simulated.trajectory, {}
    if cloud is not None:
        words["cloud"] = f"{_counted(_length(cloud.xyz), 'laser point')} of {_counted(len(cloud.strips), 'strip')}"
    if trajectory is not None:
        words["trajectory"] = f"{_counted(_length(trajectory.time), 'record')} of GNSS/IMU"
    return words


def simulation_repr(simulated: Any) -> str:
    """Return `Simulation with its truth, of Block ...` and the size of its lidar data."""
    more = ", ".join(_scanned(simulated).values())
    return f"Simulation with its truth, of {block_repr(simulated.block)}" + (f";\n  {more}" if more else "")


def simulation_html(simulated: Any) -> str:
    """Return the counts of its block, cloud and trajectory and the true shared parameters as an HTML table."""
    truth = {f"true {name}": words for name, words in simulated.truth.words.items()}
    return block_html(simulated.block, _scanned(simulated) | truth, "Simulation of block")


def _change_rows(found: Any) -> dict[str, str]:
    """Return the verdict on a change, and each test."""
    verdict = "the camera has changed significantly" if found.changed else "no significant change of the camera"
    rows = {"verdict": verdict}
    if found.degrees_of_freedom:
        p = f"{found.p_parameters:.2g}" if found.p_parameters else "< 1e-300"
        rows["parameters"] = f"chi-square {found.chi_square:.4g} of {found.degrees_of_freedom}, p {p}"
    if np.isfinite(found.p_field):
        rows[f"bundles of rays ({found.field.method})"] = f"p {found.p_field:.2g}"
    rows["beyond the 95 % limit"] = f"at {int(found.beyond.sum())} of {len(found.limit_mm)} points of the format"
    return rows


def change_repr(found: Any) -> str:
    """Return `Change: ...` and its tests."""
    verdict, *tests = (f"{name}: {words}" for name, words in _change_rows(found).items())
    return f"Change: {verdict.partition(': ')[2]};\n  {'; '.join(tests)}"


def change_html(found: Any) -> str:
    """Return the verdict, the tests and the parameters of both calibrations as an HTML table."""
    used = [one for one in found.parameters if one.sigma > 0 or one.first or one.second][:_ROWS]
    row = lambda cells, tag: f"<tr>{''.join(f'<{tag}>{escape(str(cell))}</{tag}>' for cell in cells)}</tr>"  # noqa: E731
    lines = [row(map(field_word, one), "td") for one in used]
    table = f"<table>{row(used[0]._fields, 'th')}{''.join(lines)}</table>" if used else ""
    return html_of("Change", _change_rows(found)) + table
