"""Atomic writing of files and directories: complete or not at all, without loss of a user's files.

A directory written by jaxphoto contains the file `MARKER`, a list of the files written by jaxphoto with their SHA-256.
Only such a directory is replaced, only if these files are unchanged, and all other files in it are retained. Temporary
files are in a hidden directory next to their target.
"""

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from jaxphoto.errors import InputError

try:
    import fcntl
except ImportError:  # Windows has no such locks.
    fcntl = None  # type: ignore[assignment]

MARKER = ".jaxphoto.json"
_PREFIX = ".jaxphoto-"
# Files created by file managers in every directory they display.
_DEBRIS = {".DS_Store", "Thumbs.db", "desktop.ini"}


class InputFile(NamedTuple):
    """Name, size and hash of an input file."""

    file: str
    n_bytes: int
    sha256: str


def input_file(path: Path, name: str | None = None) -> InputFile:
    """Return size and hash of the file at `path`."""
    return InputFile(name or path.name, path.stat().st_size, _digest(path))


def digest_of_all(files: Iterable[InputFile]) -> str:
    """Return the SHA-256 of the lines that `sha256sum` prints for `files`, sorted by name."""
    lines = "".join(f"{f.sha256}  {f.file}\n" for f in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a path to write to, which replaces `path` when it is complete and is removed after an error.

    Raises InputError if `path` is not a regular file, OSError if it cannot be written.
    """
    target = _real(path)
    if os.path.lexists(target) and not target.is_file():
        raise InputError(f"{path} exists and is not a regular file: use another path")
    with _work_place(target) as work:
        yield work
        _flush(work)
        if target.exists():
            shutil.copymode(target, work)
        os.replace(work, target)


@contextmanager
def whole_folder(directory: Path) -> Iterator[Path]:
    """Yield a directory to write into, which replaces `directory` when it is complete.

    Files previously written there by jaxphoto are removed, all others are retained. After an error nothing has changed.
    Raises InputError as `check_folder`, OSError if it cannot be written.
    """
    target = _real(directory)
    check_folder(directory)
    with _work_place(target) as work:
        work.mkdir()
        yield work
        files = {name: _digest(work / name) for name in _files(work) if name != MARKER}
        text = json.dumps({"written by": "jaxphoto", "files": files}, indent=1)
        (work / MARKER).write_text(text + "\n", encoding="utf-8")
        for name in (*files, MARKER):
            _flush(work / name)
        if target.exists():
            _keep_foreign(target, work, _written(target))
            shutil.copymode(target, work)
            old = work.with_name(f"{target.name}.old")
            os.rename(target, old)
            try:
                os.rename(work, target)
            except BaseException:
                os.rename(old, target)
                raise
        else:
            os.rename(work, target)


def check_folder(directory: Path, *inputs: Path) -> None:
    """Raise InputError if `directory` cannot be written or replaced without loss.

    Reasons: it is a file; a directory that jaxphoto did not write, or with a file that was modified since;
    it contains one of the `inputs`; permissions or disk space are insufficient.
    """
    target = _real(directory)
    for given in inputs:
        if target in (real := _real(given), *real.parents):
            raise InputError(f"{directory} is or contains the input {given}, which would be lost: use another folder")
    _check_parents(target, "name a folder")
    if os.path.ismount(target):
        raise InputError(f"{directory} is a mount point, which cannot be replaced: use a folder in it")
    if os.path.lexists(target) and not target.is_dir():
        raise InputError(f"{target} is a file: give a folder")
    check_room(target)
    if target.is_dir():
        if not os.access(target, os.W_OK):
            raise InputError(f"{directory} is read-only: use another folder, or change its permissions")
        _written(target)


def check_file(path: Path, *inputs: Path) -> None:
    """Raise InputError if a new file `path` cannot be written, or exists."""
    target = _real(path)
    if target in map(_real, inputs):
        raise InputError(f"{path} is the input itself, which would be lost: use another file")
    if os.path.lexists(target):
        raise InputError(f"{path} exists already: use a new file")
    _check_parents(target, "give a file in a folder")
    check_room(target)


def check_room(target: Path) -> None:
    """Raise InputError if no file can be created next to `target`."""
    folder = next(parent for parent in target.parents if parent.is_dir())
    try:
        with _work_place(folder / "room") as work:
            work.joinpath(*target.relative_to(folder).parts).mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{target} cannot be written ({error.strerror}): use another path") from None


def files_in(folder: Path) -> list[str]:
    """Return the files that jaxphoto wrote in `folder`, by their paths in it; all files if there is no marker."""
    listed = _listed(folder)
    return sorted(_files(folder) if listed is None else listed)


def is_place(name: str) -> bool:
    """Return True for the name of a hidden directory of temporary files."""
    return name.startswith(_PREFIX)


def clear_leftovers(folder: Path) -> None:
    """Remove temporary files of killed processes from `folder`, which the caller has `locked`."""
    for place in folder.glob(f"{_PREFIX}*/"):
        shutil.rmtree(place, ignore_errors=True)


@contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Lock `folder` for this process; yield False if another process holds the lock."""
    with contextlib.ExitStack() as stack:
        try:
            if fcntl is not None:
                opened = os.open(folder, os.O_RDONLY)
                stack.callback(os.close, opened)
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        except OSError:  # The file system does not support locks, or the folder was removed.
            pass
        yield True


@contextmanager
def _work_place(target: Path) -> Iterator[Path]:
    """Yield a path named like `target` in a hidden directory next to it; an OSError there names `target`."""
    place = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        place = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=target.parent))
        yield place / target.name
    except OSError as error:
        hidden = error.filename is None or (place and str(error.filename).startswith(str(place)))
        if not hidden or error.errno is None:
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(target)) from error
    finally:
        if place is not None and (target.exists() or not (place / f"{target.name}.old").exists()):
            shutil.rmtree(place, ignore_errors=True)


def _written(folder: Path) -> set[str]:
    """Return the files that jaxphoto wrote in `folder`. Raises InputError if replacing them could lose data."""
    if not set(os.listdir(folder)) - _DEBRIS:
        return set()
    listed = _listed(folder)
    if listed is None:
        raise InputError(f"{folder} is not empty and was not written by jaxphoto: use a new folder")
    for name, digest in listed.items():
        path = folder / name
        if os.path.lexists(path) and (path.is_symlink() or not path.is_file() or _digest(path) != digest):
            raise InputError(
                f"{path} was changed since jaxphoto wrote it, and would be lost: move it away, or use a new folder"
            )
    return set(listed)


def _keep_foreign(old: Path, new: Path, written: set[str]) -> None:
    """Link all files that jaxphoto did not write from `old` into `new`. Raises InputError if a name already exists
    there.
    """
    for root, folders, names in os.walk(old):
        inside = Path(root).relative_to(old)
        links = [name for name in folders if (Path(root) / name).is_symlink()]
        for name in (*names, *links):
            path, to = Path(root) / name, new / inside / name
            if str(inside / name) in written or name in {MARKER, *_DEBRIS}:
                continue
            if os.path.lexists(to) or any(parent.is_file() for parent in to.parents):
                raise InputError(
                    f"{path} was not written by jaxphoto and would be lost: move it away, or use a new folder"
                )
            to.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(path, to, follow_symlinks=False)
            except (OSError, NotImplementedError):  # The file system does not support hard links.
                shutil.copy2(path, to, follow_symlinks=False)


def _listed(folder: Path) -> dict[str, str] | None:
    """Return the content of the marker; None without a valid one."""
    try:
        files = json.loads((folder / MARKER).read_text(encoding="utf-8"))["files"]
        return files if all(isinstance(digest, str) for digest in files.values()) else None
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check_parents(target: Path, cure: str) -> None:
    for parent in target.parents:
        if os.path.lexists(parent) and not parent.is_dir():
            raise InputError(f"{parent} is a file: {cure}")


def _flush(path: Path) -> None:
    """Flush a file to disk; some file systems report only here that the disk is full."""
    if path.is_symlink() or not path.is_file():
        return
    with contextlib.closing(os.fdopen(os.open(path, os.O_RDONLY))) as file:
        os.fsync(file.fileno())


def _real(path: Path) -> Path:
    """Resolve links: the links are retained, and their targets are written."""
    return Path(os.path.realpath(path))
