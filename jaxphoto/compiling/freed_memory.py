"""Memory that was freed: whether the C library keeps it or gives it back to the system."""

import contextlib
import ctypes
import sys
from collections.abc import Callable, Iterator

# Of <malloc.h>.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -3, -4
_USUAL_MMAPS = 65_536
_ALL = 2**31 - 1
# Pieces up to this size come from memory that was freed, and so much is kept: what glibc comes to by itself once it has
# freed such a piece. Until then it may map what a program works with anew at each call: of P31, 3.3 MB and a third of
# the time of a solution.
_LARGEST, _KEPT = 32 * 2**20, 64 * 2**20


def keep_freed_memory() -> None:
    """Have glibc use what a program worked with again at its next call."""
    if option := _of_glibc("mallopt"):
        option(_MMAP_THRESHOLD, _LARGEST)
        option(_TRIM_THRESHOLD, _KEPT)


def return_freed_memory() -> None:
    """Have glibc give back what is free: of the many small pieces of XLA's compiler it would keep 50 MB a program.

    Other C libraries do so themselves, or have no such call.
    """
    if trim := _of_glibc("malloc_trim"):
        trim(0)


@contextlib.contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Have glibc keep what is freed meanwhile, for what allocates and frees the same gigabyte again and again.

    Asked of the system anew each time, every page of it is cleared and mapped again, which takes a third of the time
    of finding features. It goes back at the end. Threads have a part of it only where all share one pool, as in the
    command `jaxphoto`. Other C libraries go on as they do.
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
