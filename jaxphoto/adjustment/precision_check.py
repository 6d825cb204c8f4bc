"""Warnings about numbers with fewer digits than an adjustment needs (docs/statistics.md)."""

import warnings

import jax
import numpy as np

from jaxphoto.block import Block
from jaxphoto.unknowns import Unknowns


def warn_of_precision_loss(block: Block, start: Unknowns, priors: Unknowns) -> None:
    """Warn if JAX computes in 32 bits, and about numbers given with fewer than 64."""
    if not jax.config.values["jax_enable_x64"]:
        warnings.warn(
            "JAX computes with 32 bits (jax_enable_x64 was switched off after jaxphoto was imported): an adjustment "
            "may not converge and its standard deviations are unreliable; enable it before adjusting",
            stacklevel=4,
        )
    groups = {"image_points": block.image_points, **{rows.group: rows for rows in block.observations}, "start": start}
    groups["priors"] = priors
    found = []
    for name, group in groups.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(group):
            dtype = np.dtype(getattr(leaf, "dtype", float))
            if dtype.kind == "f" and dtype.itemsize < 8 and not isinstance(leaf, jax.core.Tracer) and np.size(leaf):
                largest = float(np.abs(np.asarray(leaf)).max(initial=0.0))
                step = float(np.spacing(np.asarray(largest, dtype)))
                label = f"{name}{jax.tree_util.keystr(path)}"
                found.append(f"{label} is {dtype.name} and knows {largest:.7g} to {step:.1g} only")
    if found:
        warnings.warn(f"{'; '.join(found)}: give float64, such as np.asarray(x, float)", stacklevel=4)
