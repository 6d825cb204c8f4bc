"""Argument checks of functions of one image and one point: convert lists, detect a missing `jax.vmap`.

Under `jit` they run only during tracing.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.errors import InputError


def require(value: Any, kind: type, cure: str) -> None:
    """Raise InputError with the `cure` if `value` is not an instance of `kind`."""
    if not isinstance(value, kind):
        given = value.__name__ if isinstance(value, type) else f"a {type(value).__name__}"
        raise InputError(f"{given} is no {kind.__name__}: {cure}")


def single(name: str, values: Any, *shape: int | None) -> Float[Array, "..."]:
    """Convert `values` to an array of `shape`, in which None is any size.

    Raises InputError for another shape, and for values that are not numbers.
    """
    if not isinstance(values, jax.Array | np.ndarray):
        try:
            values = jnp.asarray(values, float)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name} must be an array of numbers of shape {_written(shape)} ({error})") from None
    if values.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, values.shape, strict=True)):
        return values
    many = values.ndim == len(shape) + 1 and all(n in (None, m) for n, m in zip(shape, values.shape[1:], strict=True))
    cure = "map the function over many with jax.vmap" if many else "give an array of that shape"
    raise InputError(f"{name} has shape {_written(values.shape)} where {_written(shape)} is required: {cure}")


def _written(shape: tuple[int | None, ...]) -> str:
    sizes = ["n" if n is None else str(n) for n in shape]
    return f"({', '.join(sizes)}{',' if len(sizes) == 1 else ''})"
