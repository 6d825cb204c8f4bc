"""What the console and notebooks show of things, in lines instead of pages: counts, numbers, outcome, sigma naught.

Tables and pictures are made upstairs (`jaxphoto.report`), which nothing down here may import. What an object offers of
them for notebooks is asked for by name, when it is wanted: `from_upstairs`.
"""

import importlib
from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

# Standard deviations that a normal number exceeds once in a thousand times, to either side.
_ONE_IN_A_THOUSAND = 3.29


def from_upstairs(name: str) -> Any:
    """A function of `jaxphoto.report`, which is imported now."""
    return getattr(importlib.import_module("jaxphoto.report"), name)


def html_of(title: str, rows: Mapping[str, object]) -> str:
    """A small table under a title, as notebooks show it."""
    cells = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(str(value))}</td></tr>'
        for name, value in rows.items()
    )
    return f"<b>{escape(title)}</b><table>{cells}</table>"


def number_word(value: Any) -> str:
    """A number in six digits, a prior or an array in a word."""
    if np.ndim(value) == 0 and isinstance(value, int | float | np.generic | np.ndarray):
        return f"{float(value):.6g}"
    if hasattr(value, "shape") and not np.ndim(value):
        # JAX's: a traced one has no value.
        return f"{float(value):.6g}" if getattr(value, "is_fully_addressable", False) else type(value).__name__
    return f"array{tuple(value.shape)}" if hasattr(value, "shape") else " ".join(repr(value).split())


def numbers_words(numbers: Mapping[str, Any]) -> str:
    """`c_mm 34.25, k1 -9.12e-05`."""
    return ", ".join(f"{name} {number_word(value)}" for name, value in numbers.items())


def _observed(block: Any) -> dict[str, int]:
    """How much of each kind is observed besides image points."""
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


def block_html(block: Any, unknowns: Mapping[str, object]) -> str:
    """Counts of a block, and what is known beforehand of its `unknowns`, in words by owner."""
    counts: dict[str, object] = {
        "images": f"{len(block.images)} of {_counted(len(block.sensors), 'camera')}",
        "points": f"{len(block.points)} in {_counted(_length(block.image_points.image), 'image point')}",
    }
    return html_of(
        f"Block {block.title!r}", counts | {f"{k}s": n for k, n in _observed(block).items()} | dict(unknowns)
    )


def adjustment_html(adjusted: Any, unknowns: Mapping[str, object]) -> str:
    """Outcome and quality of an adjustment, and its shared unknowns in words by owner."""
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
    """`Block 'title': 31 images of 1 camera, 352 points in 2415 image points; ...` with what else is observed."""
    more = ", ".join(_counted(n, name) for name, n in _observed(block).items())
    return (
        f"Block {block.title!r}: {_counted(len(block.images), 'image')} of {_counted(len(block.sensors), 'camera')}, "
        f"{_counted(len(block.points), 'point')} in {_counted(_length(block.image_points.image), 'image point')}"
        + (f";\n  {more}" if more else "")
    )


def adjustment_repr(adjusted: Any) -> str:
    """`Adjustment of 'title': converged ...`, then steps, sigma naught and redundancy, in two lines."""
    of = f"Adjustment of {adjusted.block.title!r}"
    # A traced number has no value, and several have no common one; `factored` is None inside a transformation of JAX.
    if adjusted.factored is None or np.ndim(adjusted.converged) != 0:
        return f"{of} inside a transformation of JAX or of several blocks at once: its numbers are arrays"
    observations, unknowns = (sum(n.values()) for n in (adjusted.n_observations, adjusted.n_unknowns))
    return (
        f"{of}: {adjusted.outcome.value.partition(':')[0]} after {_counted(int(adjusted.steps), 'step')},\n"
        f"  sigma naught {_sigma0_words(adjusted)}, redundancy {adjusted.redundancy} "
        f"({_counted(observations, 'observation')}, {_counted(unknowns, 'unknown')})"
    )


def _sigma0_words(adjusted: Any) -> str:
    """`1.043`; where chance does not explain it, with what does to one in a thousand, and who knows why."""
    sigma0, redundancy = float(adjusted.sigma0), adjusted.redundancy
    if redundancy <= 0:
        return f"{sigma0:.4g}"
    # Of many squares, sigma naught is normal about 1 with the variance 1 / (2 redundancy).
    expected = _ONE_IN_A_THOUSAND / (2 * redundancy) ** 0.5
    asks = f" (expected 1 +- {expected:.2g}: see .verdict())" if abs(sigma0 - 1) > expected else ""
    return f"{sigma0:.4g}{asks}"


def _counted(n: int, name: str) -> str:
    return f"{n} {name}" + ("s" if n != 1 else "")


def _length(rows: Any) -> int:
    """0 for what is no array: a tree may hold anything while JAX maps over it."""
    return next(iter(getattr(rows, "shape", ())), 0)
