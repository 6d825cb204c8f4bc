"""What the console shows of a block and of an adjustment, in lines instead of pages: counts, outcome, sigma naught."""

from typing import Any

import numpy as np


def block_repr(block: Any) -> str:
    """`Block 'title': 31 images of 1 camera, 352 points in 2415 image points; ...` with what else is observed."""
    observed = {
        "control coordinate": block.control.who,
        "fixed coordinate": block.fixed.who,
        "check coordinate": block.check.who,
        "station coordinate": block.stations.who,
        "attitude": block.attitudes.image,
        "distance": block.distances.value,
        "surface point": block.surfaces.point,
    }
    more = ", ".join(_counted(n, name) for name, rows in observed.items() if (n := _length(rows)))
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
        f"  sigma naught {float(adjusted.sigma0):.4g}, redundancy {adjusted.redundancy} "
        f"({_counted(observations, 'observation')}, {_counted(unknowns, 'unknown')})"
    )


def _counted(n: int, name: str) -> str:
    return f"{n} {name}" + ("s" if n != 1 else "")


def _length(rows: Any) -> int:
    """0 for what is no array: a tree may hold anything while JAX maps over it."""
    return next(iter(getattr(rows, "shape", ())), 0)
