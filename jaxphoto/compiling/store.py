"""Compiled programs on disk, beside JAX's own cache, run by a later process without tracing them.

JAX's cache holds what XLA compiled, but needs the traced and lowered program to find it, half of the start-up time. A
file's name is a hash of all that a program depends on (`key_of`); its content is JSON and XLA's serialised program, in
a directory that only holds what this user wrote (`private_folder`): like JAX's cache it contains code.
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

with contextlib.suppress(ImportError):  # Another jaxlib: `load` finds nothing.
    from jaxlib import lapack

# Most bytes in the directory; beyond, the least recently used programs are deleted.
MOST = 1_000_000_000
_PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
# Bytes of the length of the text, which precedes it.
_LENGTH = 8


class Stored(NamedTuple):
    """Program whose arguments and results are lists of arrays, and the tree that its results fill."""

    compiled: jax.stages.Compiled
    skeleton: Any


def _digest_of_sources() -> str:
    digest = hashlib.sha256()
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(f"{path.relative_to(package)}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


# Hashed at import: later edits are not what this process runs.
_SOURCES = _digest_of_sources()


def key_of(function: Any, arguments: tuple, options: dict | None) -> str | None:
    """Return the name of a program; None if nothing is stored, or no name identifies it."""
    if _folder() is None or jax.default_backend() != "cpu" or jax.process_count() > 1:
        return None
    try:
        parts = (describe(function), describe(arguments), describe(options), *_surroundings(), *_settings())
    except Indescribable:
        return None
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def load(key: str) -> Stored | None:
    """Load the program stored under `key`; None if there is none, or it is invalid."""
    folder = _folder()
    content = private_folder.read(folder, key) if folder is not None else None
    if content is None:
        return None
    try:
        # A program finds LAPACK by pointers that JAX sets when it lowers a call of it; nothing is lowered here.
        lapack.prepare_lapack_call("potrf", np.dtype(float))
        length = int.from_bytes(content[:_LENGTH], "big")
        text = json.loads(content[_LENGTH : _LENGTH + length])
        compiled = program_of(PlainProgram(text["program"], content[_LENGTH + length :]))
        return Stored(compiled, from_json(text["skeleton"]))
    except Exception:  # Whatever is wrong with a file or other in this JAX, the program can be compiled.
        return None


def save(key: str, program: Stored) -> None:
    """Store a program, if possible: not one that calls back into Python, nor on a full disk."""
    folder = _folder()
    if folder is None:
        return
    try:
        plain = as_plain(program.compiled)
        text = json.dumps({"program": plain.text, "skeleton": to_json(program.skeleton)}).encode()
    except Exception:  # JAX and XLA say in many ways that something cannot be kept.
        return
    private_folder.write(folder, key, len(text).to_bytes(_LENGTH, "big") + text + plain.executable)
    private_folder.limit(folder, MOST)


def _folder() -> Path | None:
    """Return the directory beside JAX's cache; None if that is off or remote."""
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
    """Identify the kind of processor: code is compiled for its instructions."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return "\n".join(sorted({line for line in lines if line.startswith(("model", "flags", "Features", "CPU"))}))
    return platform.processor()
