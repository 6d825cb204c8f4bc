"""Independent random streams of one seed, one per purpose."""

import zlib

import numpy as np


def stream(seed: int, purpose: str) -> np.random.Generator:
    """Return the generator of `purpose` ("terrain", "noise of stations", ...) under `seed`.

    Streams of different purposes are independent (NumPy's `SeedSequence` with the purpose as spawn key), and do not
    depend on which others are used.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(purpose.encode()),)))
