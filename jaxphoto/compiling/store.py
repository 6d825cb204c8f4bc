"""Compiled programs on disk, in addition to JAX's own cache; a later process runs them without tracing.

JAX's cache contains the results of XLA's compiler, but requires the traced and lowered program to find them, half of
the start-up time. Here the file name is a hash of all inputs of a program (`key_of`), the content is written by
`jax.experimental.serialize_executable`. Like JAX's cache it contains code: only files that nobody but this user can
write are read.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import os
import pickle
import platform
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from jaxphoto.compiling.description import Indescribable, describe

with contextlib.suppress(ImportError):  # Other jaxlib version: `load` finds nothing.
    from jaxlib import lapack

# Maximum size of the directory in bytes; then the least recently used programs are deleted.
MOST = 1_000_000_000
_PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
_DIGEST = hashlib.sha256().digest_size


class Slot:
    """Placeholder for an array in the tree of a result."""


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


def load(key: str) -> Stored | None:
    """Load the program stored under `key`; None if there is none, or it is invalid."""
    folder = _folder()
    if folder is None or not (folder / key).is_file() or not (_is_private(folder) and _is_private(folder / key)):
        return None
    try:
        content = (folder / key).read_bytes()
        if hashlib.sha256(key.encode() + content[_DIGEST:]).digest() != content[:_DIGEST]:
            return None
        os.utime(folder / key)
        # A program calls LAPACK by pointers that JAX sets when it lowers such a call; no call is lowered here.
        lapack.prepare_lapack_call("potrf", np.dtype(float))
        serialised, devices, n, m, skeleton = pickle.loads(content[_DIGEST:])
        by_id = {device.id: device for device in jax.devices()}
        trees = jax.tree.structure(((0,) * n, {})), jax.tree.structure([0] * m)
        compiled = deserialize_and_load(serialised, *trees, execution_devices=[by_id[number] for number in devices])
        return Stored(compiled, skeleton)
    except Exception:  # If the file is invalid or JAX has changed, the program is compiled instead.
        return None


def save(key: str, program: Stored) -> None:
    """Store a program if possible; skip programs with callbacks to Python, and ignore a full disk."""
    folder = _folder()
    if folder is None:
        return
    try:
        executable: Any = program.compiled._executable
        inner = executable._unloaded_executable
        if inner.host_callbacks or inner.keepalive or inner.ordered_effects or inner.unordered_effects:
            return
        serialised, arguments, results = serialize(program.compiled)
        devices = [int(device.id) for device in inner.device_list]
        content = pickle.dumps((serialised, devices, arguments.num_leaves, results.num_leaves, program.skeleton))
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        opened, path = tempfile.mkstemp(dir=folder)
        with open(opened, "wb") as file:
            file.write(hashlib.sha256(key.encode() + content).digest() + content)
        os.replace(path, folder / key)
        _limit(folder)
    except Exception:  # JAX and XLA raise various errors for programs that cannot be stored.
        return


def _is_private(path: Path) -> bool:
    """Return True if only this user can write to a file or directory."""
    found = path.lstat()
    return not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & 0o022)


def _limit(folder: Path) -> None:
    """Delete the least recently used files until the rest is below `MOST` bytes."""
    files = sorted(((path, path.stat()) for path in folder.iterdir()), key=lambda file: file[1].st_mtime)
    size = sum(found.st_size for _, found in files)
    for path, found in files:
        if size > MOST:
            path.unlink(missing_ok=True)
            size -= found.st_size


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
    # Temporary settings (`with jax.enable_x64(False)`) are visible only as attributes; some options have no attribute.
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
