"""Errors for functions that JAX transformations cannot trace, with the alternative."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

from jaxphoto.arrays import is_traced
from jaxphoto.errors import InputError

F = TypeVar("F", bound=Callable[..., Any])


def refuse_traced(what: str, tree: Any) -> None:
    """Raise InputError if a JAX transformation traces any leaf of `tree`."""
    if is_traced(tree):
        raise InputError(
            f"{what} needs concrete numbers, which jit, grad and vmap do not have: return the adjustment or the block "
            f"from the transformed function, and call {what} outside"
        )


def outside_transformations(function: F) -> F:
    """Make `function` raise InputError if a JAX transformation traces its arguments."""

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        refuse_traced(function.__name__, (arguments, named))
        return function(*arguments, **named)

    return call  # type: ignore[return-value]
