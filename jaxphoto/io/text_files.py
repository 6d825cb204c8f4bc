"""Read whole files: bytes, UTF-8 text and JSON objects."""

import json
from pathlib import Path
from typing import Any

from jaxphoto.errors import InputError

# Maximum number of bytes searched for words that identify a format.
_HEAD = 2_000_000
# First bytes of spreadsheet workbooks: ZIP archive, and the older binary format.
_WORKBOOK = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")


def read_bytes(path: Path) -> bytes:
    """Read a file. Raises InputError if it is missing, a folder, or unreadable."""
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"file not found: {path}; add it, or correct the name") from None
    except IsADirectoryError:
        raise InputError(f"{path} is a folder; give the path of a file") from None
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror}); check that it is a readable file") from None


def read_text(path: Path) -> str:
    """Read a UTF-8 file, normalising line ends and removing the byte order mark. Raises InputError if invalid."""
    content = read_bytes(path)
    if content.startswith(_WORKBOOK):
        raise InputError(f"{path.name} is a workbook (xlsx, ods) or another archive; save the sheet as CSV, UTF-8")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        row = error.object[: error.start].count(b"\n") + 1
        raise InputError(
            f"{path.name}, row {row}: the text is not UTF-8; save the file as UTF-8 (in a spreadsheet: CSV UTF-8)"
        ) from None


def read_legacy_text(path: Path) -> str:
    """Read a text file of another program, UTF-8 or else Windows-1252, normalising line ends."""
    content = read_bytes(path)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252", "replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object from a file. Raises InputError for other content."""
    try:
        values = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a JSON file ({error}). Rewrite it") from None
    if not isinstance(values, dict):
        raise InputError(f"{path}: not a JSON object. Rewrite it")
    return values


def has_words(path: Path, *words: str) -> bool:
    """Return True if the file exists and its first two megabytes contain all `words`."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return all(word.encode() in head for word in words)
