"""Random streams of one seed, one per purpose, and evaluation of compiled functions in chunks."""

import zlib
from collections.abc import Callable

import jax
import numpy as np


def stream(seed: int, purpose: str) -> np.random.Generator:
    """Return the generator of `purpose` ("terrain", "noise of stations", ...) under `seed`.

    Streams of different purposes are independent (NumPy's `SeedSequence` with the purpose as spawn key), and do not
    depend on which others are used.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(purpose.encode()),)))


def in_chunks(function: Callable, size: int, *rows):
    """Apply `function(*rows)` to trees of arrays (or numbers) with a leading axis, `size` rows at a time.

    `function` is compiled and takes `size` rows; the last chunk is padded with copies of its first row. The result is a
    tree of NumPy arrays.
    """
    n = len(jax.tree.leaves(rows)[0])
    parts = []
    for begin in range(0, n, size):
        chosen = np.arange(begin, begin + size)
        chosen[chosen >= n] = begin
        part = function(*jax.tree.map(lambda a: np.asarray(a)[chosen], rows))  # noqa: B023
        parts.append(jax.tree.map(lambda a: np.asarray(a)[: n - begin], part))  # noqa: B023
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)
