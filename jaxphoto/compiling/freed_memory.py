"""Freed memory: retained by the C library, or returned to the system."""

import contextlib
import ctypes
import sys
from collections.abc import Callable, Iterator

# Constants of <malloc.h>.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -3, -4
_USUAL_MMAPS = 65_536
_ALL = 2**31 - 1
# Maximum size of blocks that reuse freed memory, and maximum amount of freed memory that glibc retains. glibc adapts to
# these values after it has freed such a block. Until then it may map new work space at each call: 3.3 MB and a third of
# the solution time of P31.
_LARGEST, _KEPT = 32 * 2**20, 64 * 2**20


def keep_freed_memory() -> None:
    """Make glibc reuse freed work space at the next call."""
    if option := _of_glibc("mallopt"):
        option(_MMAP_THRESHOLD, _LARGEST)
        option(_TRIM_THRESHOLD, _KEPT)


def return_freed_memory() -> None:
    """Make glibc return freed memory; it would retain 50 MB of small blocks of XLA's compiler per program.

    Other C libraries return it automatically or have no such call.
    """
    if trim := _of_glibc("malloc_trim"):
        trim(0)


@contextlib.contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Make glibc retain freed memory, for code that repeatedly allocates and frees the same gigabyte.

    Otherwise every page is cleared and mapped again each time, which takes a third of the time of feature extraction.
    The memory is returned at the end. Threads benefit only if all share one arena, as in the command `jaxphoto`. Other
    C libraries are unaffected.
    """
    option = _of_glibc("mallopt")
    if option is None:
        yield
        return
    option(_MMAP_MAX, 0)
    option(_TRIM_THRESHOLD, _ALL)
    try:
        yield
    finally:
        option(_MMAP_MAX, _USUAL_MMAPS)
        option(_TRIM_THRESHOLD, _KEPT)
        return_freed_memory()


def _of_glibc(function: str) -> Callable[..., int] | None:
    return getattr(ctypes.CDLL(None), function, None) if sys.platform == "linux" else None
