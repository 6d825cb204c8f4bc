"""Compiling: how much of it is worth its time, running what is compiled, and keeping it on disk."""

from jaxphoto.compiling.quickly import jit_quickly
from jaxphoto.compiling.run import call_compiled, prepare, run_compiled
from jaxphoto.compiling.unique import once

__all__ = ["call_compiled", "jit_quickly", "once", "prepare", "run_compiled"]
