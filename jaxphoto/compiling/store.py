"""Compiled programs on disk, in addition to JAX's own cache; a later process runs them without tracing.

JAX's cache contains the results of XLA's compiler, but requires the traced and lowered program to find them, half of
the start-up time. Here the file name is a hash of all inputs of a program (`key_of`); the content is JSON and XLA's
serialised program, in a directory with files of this user only (`private_folder`): like JAX's cache it contains code.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxphoto.compiling import private_folder
from jaxphoto.compiling.description import Indescribable, describe
from jaxphoto.compiling.plain_program import PlainProgram, as_plain, program_of
from jaxphoto.compiling.plain_tree import from_json, to_json

with contextlib.suppress(ImportError):  # Other jaxlib version: `load` finds nothing.
    from jaxlib import lapack

# Maximum size of the directory in bytes; then the least recently used programs are deleted.
MOST = 1_000_000_000
_PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
# Number of bytes of the text length that precedes the text.
_LENGTH = 8


class Stored(NamedTuple):
    """Program whose arguments and results are lists of arrays, and the tree of its results."""

    compiled: jax.stages.Compiled
    skeleton: Any


def _digest_of_sources() -> str:
    digest = hashlib.sha256()
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(f"{path.relative_to(package)}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


# Hashed at import: this process does not run later edits.
_SOURCES = _digest_of_sources()


def key_of(function: Any, arguments: tuple, options: dict | None) -> str | None:
    """Return the name of a program; None if storing is disabled, or the arguments cannot be identified."""
    if _folder() is None or jax.default_backend() != "cpu" or jax.process_count() > 1:
        return None
    try:
        parts = (describe(function), describe(arguments), describe(options), *_surroundings(), *_settings())
    except Indescribable:
        return None
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def read(key: str) -> bytes | None:
    """Read the file of the program `key`; None if there is none."""
    folder = _folder()
    return private_folder.read(folder, key) if folder is not None else None


def load(content: bytes) -> Stored | None:
    """Load the program in a file; None if it is invalid."""
    try:
        # A program calls LAPACK by pointers that JAX sets when it lowers such a call; no call is lowered here.
        lapack.prepare_lapack_call("potrf", np.dtype(float))
        length = int.from_bytes(content[:_LENGTH], "big")
        text = json.loads(content[_LENGTH : _LENGTH + length])
        compiled = program_of(PlainProgram(text["program"], content[_LENGTH + length :]))
        return Stored(compiled, from_json(text["skeleton"]))
    except Exception:  # If the file is invalid or JAX has changed, the program is compiled instead.
        return None


def save(key: str, program: Stored) -> None:
    """Store a program if possible; skip programs with callbacks to Python, and ignore a full disk."""
    folder = _folder()
    if folder is None:
        return
    try:
        plain = as_plain(program.compiled)
        text = json.dumps({"program": plain.text, "skeleton": to_json(program.skeleton)}).encode()
    except Exception:  # JAX and XLA raise various errors for programs that cannot be stored.
        return
    private_folder.write(folder, key, len(text).to_bytes(_LENGTH, "big") + text + plain.executable)
    private_folder.limit(folder, MOST)


def _folder() -> Path | None:
    """Return the directory next to JAX's cache; None if the cache is disabled or remote."""
    chosen = jax.config.values["jax_compilation_cache_dir"]
    if not jax.config.values["jax_enable_compilation_cache"] or not chosen or "://" in chosen:
        return None
    return Path(chosen) / "programs"


def _settings() -> list[str]:
    """List all settings of JAX, XLA and equinox in this process and around this call; some change the code."""
    kept = ("JAX_", "XLA_", "EQX_")
    chosen = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith(kept)]
    # Temporary settings (`with jax.enable_x64(False)`) are visible as attributes only, and some options are not.
    values = {name: getattr(jax.config, name, value) for name, value in jax.config.values.items()}
    chosen += [f"{name}={value}" for name, value in sorted(values.items())]
    return [line for line in chosen if "cache" not in line.lower().split("=")[0]]


@functools.cache
def _surroundings() -> tuple[str, ...]:
    """List sources, versions, Python, processor and devices, which are constant in a process."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES]
    devices = [f"{device.id} {device.platform} {device.device_kind}" for device in jax.devices()]
    return (_SOURCES, sys.version, *versions, platform.platform(), _processor(), *devices)


def _processor() -> str:
    """Identify the processor model: code is compiled for its instruction set."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return "\n".join(sorted({line for line in lines if line.startswith(("model", "flags", "Features", "CPU"))}))
    return platform.processor()
