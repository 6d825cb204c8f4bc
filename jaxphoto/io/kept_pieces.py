"""Checkpoints of a long run: intermediate results in a folder beside its output, from which a later run resumes.

A piece is a set of arrays under a name that is a hash of all its inputs. It is written atomically and begins with the
SHA-256 of its content; a damaged piece counts as missing and is computed again.
"""

import contextlib
import hashlib
import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.writing import check_room, clear_leftovers, is_place, locked, whole_file

_MARKER, _SUFFIX = "kept.txt", ".piece"
_SAYS = "What a run of jaxphoto has worked out so far. The same command goes on from here, and removes it at its end.\n"
# Maximum size of a piece in bytes: some million features.
_MOST = 1_000_000_000


class KeptPieces:
    """The pieces in `folder`, which is created if missing.

    Raises InputError if `folder` is a file or holds something else.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        check_pieces(folder)
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / _MARKER).is_file():
            with whole_file(folder / _MARKER) as work:
                work.write_text(_SAYS, encoding="utf-8")

    def __contains__(self, name: str) -> bool:
        return self._path(name).is_file()

    def read(self, name: str) -> dict[str, np.ndarray] | None:
        """Read the arrays of a piece; None if it is missing or damaged."""
        path = self._path(name)
        try:
            if path.stat().st_size > _MOST:
                return None
            content = path.read_bytes()
        except OSError:
            return None
        digest, packed = content[:32], content[32:]
        if hashlib.sha256(packed).digest() != digest:
            return None
        with np.load(io.BytesIO(packed), allow_pickle=False) as arrays:
            return dict(arrays)

    def write(self, name: str, **arrays: np.ndarray) -> None:
        """Write `arrays` as the piece `name`."""
        packed = io.BytesIO()
        np.savez(packed, **arrays)  # type: ignore[arg-type]
        content = packed.getvalue()
        with whole_file(self._path(name)) as work:
            work.write_bytes(hashlib.sha256(content).digest() + content)

    @contextmanager
    def alone(self) -> Iterator["KeptPieces"]:
        """Lock the pieces against other processes; an empty folder is removed at the end.

        Raises InputError if another process uses them.
        """
        with locked(self.folder) as own:
            if own is False:
                raise InputError(f"another run is at work in {self.folder}: wait for it, or name another folder --out")
            try:
                yield self
            except JaxphotoError as error:
                if self._any():
                    error.add_note(f"what was worked out so far stays in {self.folder} for another try")
                raise
            finally:
                if self.folder.is_dir() and not self._any():
                    self.remove()

    def remove(self) -> None:
        """Remove all pieces, and the folder if nothing else is in it."""
        for path in self.folder.glob(f"*{_SUFFIX}"):
            path.unlink(missing_ok=True)
        clear_leftovers(self.folder)
        if not [path for path in self.folder.iterdir() if path.name != _MARKER]:
            (self.folder / _MARKER).unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                self.folder.rmdir()

    def _any(self) -> bool:
        return any(self.folder.glob(f"*{_SUFFIX}"))

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}{_SUFFIX}"


def beside(out: Path) -> Path:
    """Folder of the pieces of a run that writes to `out`."""
    target = Path(os.path.realpath(out))
    return target.with_name(f"{target.name}.progress")


def check_pieces(folder: Path) -> None:
    """Raise InputError if `folder` is a file or holds something else."""
    if os.path.lexists(folder) and not folder.is_dir():
        raise InputError(f"{folder} is a file, where what is worked out is kept meanwhile: move it away")
    known = not folder.is_dir() or (folder / _MARKER).is_file()
    if not known and any(not is_place(path.name) for path in folder.iterdir()):
        raise InputError(
            f"{folder} is not empty and not jaxphoto's, and what is worked out would be kept there meanwhile: move it "
            "away, or name another folder --out"
        )
    check_room(folder / _MARKER)


def name_of(*content: object) -> str:
    """Name of a piece: a hash of `content` (bytes, text and numbers)."""
    digest = hashlib.sha256()
    for part in content:
        packed = b"bytes" + part if isinstance(part, bytes) else repr(part).encode()
        digest.update(len(packed).to_bytes(8, "big"))
        digest.update(packed)
    return digest.hexdigest()[:40]
