"""The arrays of data and results: numpy's or JAX's, whichever the moment asks for."""

import functools
import operator
import typing
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

Numbers = jax.Array | np.ndarray
"""numpy where numbers lie still (reading, results), JAX where they are traced (compiled, differentiated)."""


def still(values) -> Any:
    """The same numbers as NumPy's, whose every operation need not be compiled; traced ones as they are.

    What is dealt out to several processes is gathered: each of them has to call this.
    """
    if isinstance(values, jax.core.Tracer):
        return values
    if isinstance(values, jax.Array) and not (values.is_fully_addressable or values.is_fully_replicated):
        return np.asarray(multihost_utils.process_allgather(values, tiled=True))
    return np.asarray(values)


def from_list(values: Any) -> Any:
    """A list as an array of real numbers; anything else as it is."""
    return np.asarray(values, float) if isinstance(values, list) else values


def is_traced(tree: Any) -> bool:
    """True if a transformation of JAX traces any number of `tree`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def is_float(value: Any) -> bool:
    """True if `value` is a float or an array of floats; a traced one, too."""
    return np.dtype(getattr(value, "dtype", type(value))).kind == "f"


def namespace(*values: Any) -> Any:
    """`jax.numpy` where a transformation of JAX traces a number of `values`, else `numpy`."""
    return jnp if is_traced(values) else np


def gathered(tree: Any) -> Any:
    """What a program gave on several devices, as the next one expects it; what several processes hold stays there."""
    return tree if jax.process_count() > 1 else jax.tree.map(still, tree)


def on_device(values) -> jax.Array:
    """JAX's array of real numbers that are known; `jnp.asarray` compiles a copy for each shape."""
    return jax.device_put(np.asarray(values, float))


def added(terms: Iterable[Any]) -> Any:
    """Their sum, term by term. The zero that `sum` begins with would be one more operation of every program."""
    return functools.reduce(operator.add, terms)


def joined(parts: Sequence) -> Numbers:
    """`parts` one after another along their first axis, NumPy's unless one is being traced."""
    parts = [still(part) for part in parts]
    return namespace(*parts).concatenate(parts)


def vector_of(scalars: Sequence) -> Any:
    """One float64 array of scalars, NumPy's unless one is being traced."""
    return jnp.stack([jnp.asarray(x, float) for x in scalars]) if is_traced(scalars) else np.array(scalars, float)


def annotated(hint: Any) -> tuple[list[str], bool] | None:
    """The axes that an annotation names, and whether it is of whole numbers: ["n", "2"] of `Int[np.ndarray, "n 2"]`.

    None where it says nothing of an array.
    """
    kind = next((a for a in (*typing.get_args(hint), hint) if hasattr(a, "dim_str")), None)
    if kind is None:
        return None
    # Axes of many objects, as in "3 *images", are none of the object's own.
    axes = [axis for axis in kind.dim_str.split() if not axis.startswith("*")]
    return axes, not any("float" in name for name in kind.dtypes)
