"""Types and shapes checked by jaxtyping and beartype while tests run, whenever a function is traced or called."""

import contextlib
import functools
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any

import equinox  # noqa: F401
import jax
import jaxtyping
import numpy as np
import optimistix  # noqa: F401
from beartype import BeartypeConf, beartype

# The checked packages: all that compute.
CHECKED = (
    "adjustment", "arrays", "block_from_arrays", "camera", "cloud", "collinearity", "columns", "experiment",
    "georeferencing", "extras", "io", "lidar", "observations", "orientation", "parameters", "procedures",
    "report", "rotation", "sensitivity", "simulation", "small_matrices", "stability", "statistics", "unknowns",
)  # fmt: skip


def check_types() -> None:
    """Check the packages `CHECKED`; call before importing them."""
    # Functions take NumPy arrays, traced JAX arrays (jaxphoto/arrays.py) and Python numbers alike. The third-party
    # packages imported above keep their own meaning.
    jaxtyping.Array = jax.Array | np.ndarray | np.generic | float
    jaxtyping.install_import_hook([f"jaxphoto.{room}" for room in CHECKED], "tests.checked_types.checked")


def checked(function: Callable) -> Callable:
    """Return `function` with its types checked, but for trees of priors in place of numbers."""
    for name, hint in function.__annotations__.items():
        # Beartype knows `Self` only of decorated classes.
        if "typing.Self" in str(hint):
            function.__annotations__[name] = Any
        else:
            function.__annotations__[name] = _widened(hint)
    strict = beartype(conf=BeartypeConf(is_pep484_tower=True))(function)
    if function.__name__ != "__init__":
        return strict

    @functools.wraps(function)
    def of_numbers_or_priors(*arguments, **fields):
        given = (*arguments, *fields.values())
        priors = any(type(value).__name__ in ("Prior", "Weighted") for value in given)
        return (function if priors else strict)(*arguments, **fields)

    return of_numbers_or_priors


def _widened(hint: Any) -> Any:
    """Return the hint with JAX arrays admitted for NumPy arrays, which JAX traces under a transformation."""
    if hint is np.ndarray:
        return np.ndarray | jax.Array
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray) and hint.array_type is np.ndarray:
        return hint.dtype[np.ndarray | jax.Array, hint.dim_str]
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return typing.Union[tuple(map(_widened, arguments))]  # noqa: UP007
    if origin in (tuple, list, dict):
        return origin[tuple(map(_widened, arguments))]
    return hint


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Switch the checks off, to test what a user without a checker sees after passing a wrong type."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)
