"""NumPy or JAX arrays: NumPy for concrete values, JAX for traced values."""

import functools
import operator
import typing
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

ArrayLike = jax.Array | np.ndarray
"""NumPy for concrete values (reading, results), JAX when traced (compiled, differentiated)."""


def to_numpy(values) -> Any:
    """Convert to NumPy, whose operations need no compilation; return traced values unchanged.

    Values sharded over several processes are gathered: each process must call this function.
    """
    if isinstance(values, jax.core.Tracer):
        return values
    if isinstance(values, jax.Array) and not (values.is_fully_addressable or values.is_fully_replicated):
        return np.asarray(multihost_utils.process_allgather(values, tiled=True))
    return np.asarray(values)


def from_list(values: Any) -> Any:
    """Convert a list to an array of real numbers; return anything else unchanged."""
    return np.asarray(values, float) if isinstance(values, list) else values


def is_traced(tree: Any) -> bool:
    """Return True if a JAX transformation traces any leaf of `tree`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def is_float(value: Any) -> bool:
    """Return True if `value` is a float or an array of floats, traced or not."""
    return np.dtype(getattr(value, "dtype", type(value))).kind == "f"


def namespace(*values: Any) -> Any:
    """Return `jax.numpy` if any of `values` is traced, else `numpy`."""
    return jnp if is_traced(values) else np


def gathered(tree: Any) -> Any:
    """Gather results from several devices for the next program; values of several processes stay sharded."""
    return tree if jax.process_count() > 1 else jax.tree.map(to_numpy, tree)


def as_jax_array(values) -> jax.Array:
    """Return a JAX array of concrete real numbers; `jnp.asarray` would compile a copy for each shape."""
    return jax.device_put(np.asarray(values, float))


def sum_terms(terms: Iterable[Any]) -> Any:
    """Sum the terms. Python's `sum` starts with zero, which adds an operation to every program."""
    return functools.reduce(operator.add, terms)


def joined(parts: Sequence) -> ArrayLike:
    """Concatenate `parts` along their first axis, in NumPy unless traced."""
    parts = [to_numpy(part) for part in parts]
    return namespace(*parts).concatenate(parts)


def vector_of(scalars: Sequence) -> Any:
    """Return one float64 array of scalars, in NumPy unless traced."""
    return jnp.stack([jnp.asarray(x, float) for x in scalars]) if is_traced(scalars) else np.array(scalars, float)


def annotated(hint: Any) -> tuple[list[str], bool] | None:
    """Return the axes of an annotation, and True for integers: ["n", "2"] of `Int[np.ndarray, "n 2"]`.

    None if it is not an array annotation.
    """
    kind = next((a for a in (*typing.get_args(hint), hint) if hasattr(a, "dim_str")), None)
    if kind is None:
        return None
    # Skip axes of several objects, as in "3 *images": they do not belong to one object.
    axes = [axis for axis in kind.dim_str.split() if not axis.startswith("*")]
    return axes, not any("float" in name for name in kind.dtypes)
