"""Which cases of a parametrised test are left to `pytest -m slow`."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def slow_but(quick: Callable[[Any], bool] | Iterable, cases: Iterable) -> list:
    """`cases`, those that are not `quick` marked slow: what one case shows the others show again."""
    chosen = quick if callable(quick) else set(quick).__contains__
    return [case if chosen(case) else pytest.param(case, marks=pytest.mark.slow) for case in cases]
