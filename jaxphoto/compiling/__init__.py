"""Compile, run and store the programs of JAX."""

from jaxphoto.compiling.once import once
from jaxphoto.compiling.quickly import jit_quickly
from jaxphoto.compiling.run import call_compiled, prepare, run_compiled

__all__ = ["call_compiled", "jit_quickly", "once", "prepare", "run_compiled"]
