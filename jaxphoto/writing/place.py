"""Hidden folders in which a thing is made before it takes its place, and what becomes of those of killed runs.

A work place `.jaxphoto-...` lies beside its target and holds `new/NAME`, and for a moment `old/NAME`. Its process has a
lock on it; one that nobody has was left by a run that was killed, and the next run that writes there clears it away.
"""

import contextlib
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxphoto.writing.exchange import exchange

try:
    import fcntl
except ImportError:  # Windows: nothing is locked there, so leftovers stay.
    fcntl = None  # type: ignore[assignment]

_PREFIX, _NEW, _OLD = ".jaxphoto-", "new", "old"
_placing = threading.RLock()
"""Held while something is moved into place."""


@contextmanager
def work_place(target: Path) -> Iterator[Path]:
    """A path of the name of `target`, whose folder is there already, in a work place beside it; both go at the end."""
    clear_leftovers(target.parent)
    place, lock = _made(target.parent)
    try:
        (place / _NEW).mkdir()
        yield place / _NEW / target.name
    finally:
        _clear(place)
        if lock is not None:
            os.close(lock)


def put(work: Path, target: Path) -> None:
    """Move what was made in a `work_place` to `target`, where nothing or a file is."""
    with _placing:
        os.replace(work, target)
    _flush(target.parent)


def swap(work: Path, target: Path) -> None:
    """Put a folder from its `work_place` at `target`, and the folder there into the work place."""
    with _placing:
        if not exchange(work, target):
            # Killed between the two, the old one is back, or the new one there, when this or the next run has cleared.
            old = work.parents[1] / _OLD / target.name
            old.parent.mkdir(exist_ok=True)
            os.rename(target, old)
            os.rename(work, target)
            os.rename(old, work)
    _flush(target.parent)


def clear_leftovers(folder: Path) -> None:
    """Clear away the work places in `folder` of runs that were killed; what was on its way to a place gets there."""
    with contextlib.suppress(OSError):
        for entry in list(os.scandir(folder)):
            if not is_place(entry.name) or not entry.is_dir(follow_symlinks=False):
                continue
            if hasattr(os, "getuid") and entry.stat(follow_symlinks=False).st_uid != os.getuid():
                continue
            with locked(Path(entry.path)) as own:
                if own:
                    _clear(Path(entry.path))


def is_place(name: str) -> bool:
    """Whether a file or folder of that name is a work place."""
    return name.startswith(_PREFIX)


@contextmanager
def locked(folder: Path, wait: bool = False) -> Iterator[bool | None]:
    """Whether `folder` is locked for this process, until the end; None where it cannot be locked by anybody."""
    try:
        lock = _lock(folder, wait)
    except BlockingIOError:
        yield False
        return
    except OSError:
        lock = None
    try:
        yield None if lock is None else True
    finally:
        if lock is not None:
            os.close(lock)


def _lock(folder: Path, wait: bool = False) -> int | None:
    """An open lock on `folder`; None where there are no locks. Raises OSError where another process has it."""
    if fcntl is None:
        return None
    opened = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        os.close(opened)
        raise
    return opened


def _made(folder: Path) -> tuple[Path, int | None]:
    """A new work place in `folder`, and the lock on it (None where file systems or systems have none)."""
    while True:
        place = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=folder))
        lock = None
        with contextlib.suppress(OSError):
            lock = _lock(place, wait=True)
        # Another process may have taken it for a leftover between the two.
        if place.exists():
            return place, lock
        if lock is not None:
            os.close(lock)


def _clear(place: Path) -> None:
    """Remove a work place; where the target was moved aside and nothing has come, it comes back, or the new one."""
    with contextlib.suppress(OSError):
        for old in list((place / _OLD).iterdir()):
            target = place.parent / old.name
            if not os.path.lexists(target):
                new = place / _NEW / old.name
                os.rename(new if new.exists() else old, target)
    shutil.rmtree(place, ignore_errors=True)


def _flush(folder: Path) -> None:
    """Have a change of names in `folder` on the disk, where the system can say that of a folder."""
    with contextlib.suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)
