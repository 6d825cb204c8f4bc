"""Compiled programs on disk, beside JAX's own cache, to be run by a later process without tracing them again.

JAX's cache holds what XLA compiled, but needs the traced and lowered program to find it; these are half of a start.
A file's name is a hash of all that a program depends on (`key_of`); its content is a JSON text and what XLA writes of
the program, in a folder that only takes what this user wrote (`private_folder`): like JAX's cache it holds code.
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
from jaxphoto.compiling.plain_tree import told, tree_of

with contextlib.suppress(ImportError):  # Another jaxlib: `load` finds nothing.
    from jaxlib import lapack

# What the folder may hold (bytes): beyond, what was not used for longest goes.
MOST = 1_000_000_000
_PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
# Of the number of bytes of the text, which comes first.
_LENGTH = 8


class Stored(NamedTuple):
    """A program whose arguments and results are lists of arrays, and the tree that its results fill."""

    compiled: jax.stages.Compiled
    skeleton: Any


def _digest_of_sources() -> str:
    digest = hashlib.sha256()
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(f"{path.relative_to(package)}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


# Taken while they are imported: an edit after that is not what this process runs.
_SOURCES = _digest_of_sources()


def key_of(function: Any, arguments: tuple, options: dict | None) -> str | None:
    """The name under which a program is kept; None where nothing is to be kept, or no name would be safe."""
    if _folder() is None or jax.default_backend() != "cpu" or jax.process_count() > 1:
        return None
    try:
        told = (describe(function), describe(arguments), describe(options), *_surroundings(), *_settings())
    except Indescribable:
        return None
    return hashlib.sha256("\n".join(told).encode()).hexdigest()


def load(key: str) -> Stored | None:
    """The program kept under `key`; None where there is none that this user kept, or it does not fit."""
    folder = _folder()
    content = private_folder.read(folder, key) if folder is not None else None
    if content is None:
        return None
    try:
        # A program finds LAPACK by pointers that JAX sets when it lowers a call of it; here nothing is lowered.
        lapack.prepare_lapack_call("potrf", np.dtype(float))
        length = int.from_bytes(content[:_LENGTH], "big")
        text = json.loads(content[_LENGTH : _LENGTH + length])
        compiled = program_of(PlainProgram(text["program"], content[_LENGTH + length :]))
        return Stored(compiled, tree_of(text["skeleton"]))
    except Exception:  # Whatever is wrong with a file or other in this JAX, the program can be compiled.
        return None


def save(key: str, program: Stored) -> None:
    """Keep a program, where that is possible: not one that calls back into Python, nor on a full disk."""
    folder = _folder()
    if folder is None:
        return
    try:
        plain = as_plain(program.compiled)
        text = json.dumps({"program": plain.text, "skeleton": told(program.skeleton)}).encode()
    except Exception:  # JAX and XLA say in many ways that something cannot be kept.
        return
    private_folder.write(folder, key, len(text).to_bytes(_LENGTH, "big") + text + plain.executable)
    private_folder.limit(folder, MOST)


def _folder() -> Path | None:
    """Beside JAX's cache; None where that is off or not a local folder."""
    chosen = jax.config.values["jax_compilation_cache_dir"]
    if not jax.config.values["jax_enable_compilation_cache"] or not chosen or "://" in chosen:
        return None
    return Path(chosen) / "programs"


def _settings() -> list[str]:
    """Everything that JAX, XLA and equinox were told, in this process and around this call; some of it changes code."""
    kept = ("JAX_", "XLA_", "EQX_")
    chosen = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith(kept)]
    # What is set for a while (`with jax.enable_x64(False)`) is seen as an attribute only, and some options are none.
    values = {name: getattr(jax.config, name, value) for name, value in jax.config.values.items()}
    chosen += [f"{name}={value}" for name, value in sorted(values.items())]
    return [line for line in chosen if "cache" not in line.lower().split("=")[0]]


@functools.cache
def _surroundings() -> tuple[str, ...]:
    """Sources, versions, Python, the processor and the devices: they stay as they are while a process runs."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES]
    devices = [f"{device.id} {device.platform} {device.device_kind}" for device in jax.devices()]
    return (_SOURCES, sys.version, *versions, platform.platform(), _processor(), *devices)


def _processor() -> str:
    """What tells one kind of processor from another: code is made for the instructions of the one at hand."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return "\n".join(sorted({line for line in lines if line.startswith(("model", "flags", "Features", "CPU"))}))
    return platform.processor()
