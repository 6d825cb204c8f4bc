"""One file, or one folder, written whole or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxphoto.errors import InputError
from jaxphoto.writing.manifest import Clashes, keep, mark, own_files
from jaxphoto.writing.place import locked, put, swap, work_place


def _nothing_clashes(name: str) -> bool:
    return False


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A place to write to, which becomes `path` when all is written and on the disk, and is removed on an error.

    Raises InputError where `path` is something else than a file, OSError where it cannot be written.
    """
    target = _real(path)
    _check_kind(path, target)
    with _said_of(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with work_place(target) as work, _said_of(target, work):
            yield work
            _flush(work)
            if target.exists():
                shutil.copymode(target, work)
            put(work, target)


@contextmanager
def whole_folder(directory: Path, clashes: Clashes = _nothing_clashes) -> Iterator[Path]:
    """A folder to write into, which takes the place of `directory` when all is written and on the disk.

    What jaxphoto wrote in `directory` before goes, whatever else is in it stays. On an error nothing changes. Raises
    InputError where `check_folder` does, OSError where it cannot be written.
    """
    target = _real(directory)
    check_folder(directory, clashes=clashes)
    with _said_of(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with work_place(target) as work, _said_of(target, work):
            work.mkdir()
            yield work
            mark(work)
            for path in work.rglob("*"):
                if path.is_file() and not path.is_symlink():
                    _flush(path)
            # One after the other: what is looked through must not change places meanwhile.
            with locked(target.parent, wait=True):
                _place_folder(work, target, clashes)


def check_folder(directory: Path, *inputs: Path, clashes: Clashes = _nothing_clashes) -> None:
    """Raise InputError where nothing can be written in the place of `directory`, or something would be lost by it.

    That is a file; a folder that jaxphoto did not write, or in which a file is no longer as it wrote it, or another one
    `clashes`; what holds one of the `inputs`; and where the disk or the rights do not let anything be written.
    """
    target = _real(directory)
    for given in inputs:
        if target in (real := _real(given), *real.parents):
            raise InputError(f"{directory} is or holds the input {given}, which would be lost: name another folder")
    _check_parents(target, "name a folder")
    if os.path.ismount(target):
        raise InputError(f"{directory} is a disk of its own, which cannot be replaced: name a folder in it")
    if os.path.isfile(target):
        raise InputError(f"{target} is a file: name a folder")
    check_room(target)
    # One after the other: a folder that another run puts in its place just now is neither gone nor without rights.
    with locked(target.parent, wait=True), _said_of(target):
        if not os.path.lexists(target):
            return
        if not target.is_dir():
            raise InputError(f"{target} is no folder: name one")
        if not os.access(target, os.W_OK):
            raise InputError(f"{directory} must not be written to: name another folder, or change its rights")
        own_files(target, clashes)


def check_file(path: Path, *inputs: Path) -> None:
    """Raise InputError where no new file `path` can be written, or one of the `inputs` or another file is there."""
    target = _real(path)
    if target in map(_real, inputs):
        raise InputError(f"{path} is the input itself, which would be lost: name another file")
    if os.path.lexists(target):
        raise InputError(f"{path} exists already: name a new file")
    _check_parents(target, "name a file in a folder")
    check_room(target)


def _check_parents(target: Path, mend: str) -> None:
    for parent in target.parents:
        if os.path.lexists(parent) and not parent.is_dir():
            raise InputError(f"{parent} is a file: {mend}")


def _check_kind(path: Path, target: Path) -> None:
    if os.path.lexists(target) and not target.is_file():
        raise InputError(f"{path} is there and no file: name a file")


def check_room(target: Path) -> None:
    """Raise InputError where nothing can be made beside `target`."""
    folder = next(parent for parent in target.parents if parent.is_dir())
    try:
        with work_place(folder / "room") as work:
            work.joinpath(*target.relative_to(folder).parts).mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{target} cannot be written ({error.strerror}): name another place") from None


def _place_folder(work: Path, target: Path, clashes: Clashes) -> None:
    """Put `work` in the place of `target`, keeping what is not jaxphoto's."""
    if not target.exists():
        return put(work, target)
    own = own_files(target, clashes)
    keep(target, work, own)
    shutil.copymode(target, work)
    swap(work, target)
    try:
        # What came since it was looked through.
        keep(work, target, own)
    except InputError:
        swap(work, target)
        raise


def _flush(path: Path) -> None:
    """Have a file on the disk; some file systems say only here that there is no room for it."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


@contextmanager
def _said_of(target: Path, work: Path | None = None) -> Iterator[None]:
    """Have an OSError that names no file, or one that only lies in the work place, name `target`."""
    try:
        yield
    except OSError as error:
        told = error.filename is not None and not (work and str(error.filename).startswith(str(work.parents[1])))
        if told or error.errno is None:
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(target)) from error


def _real(path: Path) -> Path:
    """Where `path` leads, through links: they stay, and what they lead to is written."""
    return Path(os.path.realpath(path))
