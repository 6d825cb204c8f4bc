"""Directory of files that only this user can write, each authenticated with its name.

Its content is executed. Therefore the directory and its files belong to the user, nobody else may write to them, and
each file begins with an HMAC-SHA256 of its name and content, with a secret that only the user can read. A file of
another machine, a renamed file or a damaged file is ignored.
"""

import contextlib
import hashlib
import hmac
import os
import re
import secrets
import stat
import tempfile
import time
from pathlib import Path

_SECRET = "secret"
_DIGEST = hashlib.sha256().digest_size
# Pattern of the names (hashes), and minimum age (s) of other files that are deleted: a process was killed while writing
# them.
_NAME, _LEFT = re.compile("[0-9a-f]{64}"), 3600.0


def read(folder: Path, name: str) -> bytes | None:
    """Return the content of a file, or None if it is missing, invalid or not trusted. Updates its time of last use."""
    try:
        _make_private(folder)
        content = _own_content(folder / name)
        secret = _own_content(folder / _SECRET)
        os.utime(folder / name)
    except OSError:
        return None
    if len(secret) != _DIGEST or not hmac.compare_digest(_hash(secret, name, content[_DIGEST:]), content[:_DIGEST]):
        return None
    return content[_DIGEST:]


def write(folder: Path, name: str, content: bytes) -> None:
    """Write a file atomically; skip it if the directory is not writable."""
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _make_private(folder)
        _write(folder / name, _hash(_secret(folder), name, content) + content)


def limit(folder: Path, most: float) -> None:
    """Delete the least recently used files until the rest is below `most` bytes, and incomplete files."""
    with contextlib.suppress(OSError):
        files = sorted(
            ((path, path.stat()) for path in folder.iterdir() if path.name != _SECRET), key=lambda f: f[1].st_mtime
        )
        size = sum(found.st_size for _, found in files)
        for path, found in files:
            unfinished = not _NAME.fullmatch(path.name) and time.time() - found.st_mtime > _LEFT
            if size > most or unfinished:
                path.unlink(missing_ok=True)
                size -= found.st_size


def _secret(folder: Path) -> bytes:
    """Return the secret of this directory; create it if there is none."""
    path = folder / _SECRET
    with contextlib.suppress(OSError):
        if len(known := _own_content(path)) == _DIGEST:
            return known
    # If two processes create a secret at once, the later one is retained; files authenticated with the other are
    # rewritten.
    _write(path, secrets.token_bytes(_DIGEST))
    return _own_content(path)


def _hash(secret: bytes, name: str, content: bytes) -> bytes:
    return hmac.digest(secret, name.encode() + b"\n" + content, "sha256")


def _make_private(folder: Path) -> None:
    """Raise PermissionError for another user's directory; restrict the permissions of this user's."""
    found = folder.stat()
    if hasattr(os, "getuid") and found.st_uid != os.getuid():
        raise PermissionError(folder)
    if os.name == "posix" and found.st_mode & 0o077:
        folder.chmod(0o700)


def _own_content(path: Path) -> bytes:
    """Read a file. Raises OSError if it is missing or others can write to it."""
    with open(path, "rb", opener=_opened_itself) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise PermissionError(path)
        if hasattr(os, "getuid") and (found.st_uid != os.getuid() or found.st_mode & 0o022):
            raise PermissionError(path)
        return file.read()


def _opened_itself(path: str, flags: int) -> int:
    """Open without following a link or blocking on a pipe."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))


def _write(path: Path, content: bytes) -> None:
    # Written to a temporary name, then renamed; readable by this user only.
    opened, beside = tempfile.mkstemp(dir=path.parent)
    try:
        with open(opened, "wb") as file:
            file.write(content)
        os.replace(beside, path)
    except OSError:
        Path(beside).unlink(missing_ok=True)
        raise
