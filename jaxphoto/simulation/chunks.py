"""Compiled functions over rows of any number: rows go in chunks of one size, so that each compiles once only."""

from collections.abc import Callable

import jax
import numpy as np


def in_chunks(function: Callable, size: int, *rows):
    """`function(*rows)` for trees of arrays (or numbers) with a leading axis of one length, `size` rows at a time.

    `function` is compiled and takes `size` rows; the last chunk is filled up with copies of its first row. The result
    is a tree of numpy arrays.
    """
    n = len(jax.tree.leaves(rows)[0])
    parts = []
    for begin in range(0, n, size):
        chosen = np.arange(begin, begin + size)
        chosen[chosen >= n] = begin
        part = function(*jax.tree.map(lambda a: np.asarray(a)[chosen], rows))  # noqa: B023
        parts.append(jax.tree.map(lambda a: np.asarray(a)[: n - begin], part))  # noqa: B023
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)
