"""Memory that was freed goes back to the system, where the C library keeps it."""

import ctypes
import sys


def return_freed_memory() -> None:
    """Have glibc give back what is free: of the many small pieces of XLA's compiler it would keep 50 MB a program.

    Other C libraries do so themselves, or have no such call.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
