"""Compiling: how much of it is worth its time, running what is compiled, and keeping it on disk."""

from jaxphoto.compiling.once import once
from jaxphoto.compiling.options import QUICK_TO_COMPILE
from jaxphoto.compiling.run import call_compiled, prepare, run_compiled

__all__ = ["QUICK_TO_COMPILE", "call_compiled", "once", "prepare", "run_compiled"]
