"""Types and shapes are checked by jaxtyping and beartype while the tests run: where a function is traced or called."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import equinox  # noqa: F401
import jax
import jaxtyping
import numpy as np
import optimistix  # noqa: F401
from beartype import BeartypeConf, beartype

# The rooms that are checked. To be added: adjustment, statistics and sensitivity, whose arrays have other shapes while
# they are dealt out or mapped over; procedures and experiment.
CHECKED = (
    "arrays", "block_from_arrays", "camera", "cloud", "collinearity", "columns", "georeferencing",
    "image_measurement", "io", "lidar", "observations", "orientation", "parameters", "report", "rotation",
    "simulation", "stability", "unknowns",
)  # fmt: skip


def check_types() -> None:
    """Check the rooms `CHECKED` from their import on; to be called before it."""
    # An array is NumPy's where it lies still and JAX's where it is traced (jaxphoto/arrays.py), and a number alone may
    # be Python's: all functions take all. The packages of others, imported above, keep their own meaning.
    jaxtyping.Array = jax.Array | np.ndarray | np.generic | float
    jaxtyping.install_import_hook([f"jaxphoto.{room}" for room in CHECKED], "tests.checked_types.checked")


def checked(function: Callable) -> Callable:
    """`function` with its types checked. A tree of priors has priors where that of the unknowns has numbers."""
    for name, hint in function.__annotations__.items():
        # Beartype knows `Self` only of classes that it was given whole.
        if "typing.Self" in str(hint):
            function.__annotations__[name] = Any
        # What lies still for a user is traced where JAX maps or differentiates the whole.
        elif hint is np.ndarray:
            function.__annotations__[name] = np.ndarray | jax.Array
    strict = beartype(conf=BeartypeConf(is_pep484_tower=True))(function)
    if function.__name__ != "__init__":
        return strict

    @functools.wraps(function)
    def of_numbers_or_priors(*arguments, **fields):
        given = (*arguments, *fields.values())
        priors = any(type(value).__name__ in ("Prior", "Weighted") for value in given)
        return (function if priors else strict)(*arguments, **fields)

    return of_numbers_or_priors


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """What is called herein is not checked: for what users, who have no checker, are told of a wrong type."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)
