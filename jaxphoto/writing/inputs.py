"""The files that a result was made of, by SHA-256."""

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple


class InputFile(NamedTuple):
    """One file."""

    file: str
    """Its name, below the folder that was given."""
    n_bytes: int
    sha256: str


def input_file(path: Path, name: str | None = None) -> InputFile:
    """What is at `path` now."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return InputFile(name or path.name, file.tell(), digest)


def digest_of_all(files: Iterable[InputFile]) -> str:
    """SHA-256 of the lines "SHA-256, two blanks, name" of all files in the order of their names, as `sha256sum` writes
    them."""
    lines = "".join(f"{f.sha256}  {f.file}\n" for f in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()
