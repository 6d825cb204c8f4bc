"""Read whole files: bytes, text and JSON objects."""

import codecs
import json
import re
from pathlib import Path
from typing import Any

from jaxphoto.errors import InputError

# Maximum number of bytes searched for words that identify a format.
_HEAD = 2_000_000
# First bytes of spreadsheet workbooks: ZIP archive, and the older binary format.
_DECLARED = re.compile(rb"\s*<\?xml[^>]*?\bencoding=[\"']([\w.-]+)")
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
    """Read a text file in any encoding of `decoded`. Raises InputError for workbooks and other binary files."""
    content = read_bytes(path)
    if content.startswith(_WORKBOOK):
        raise InputError(f"{path.name} is a workbook (xlsx, ods) or another archive; save the sheet as CSV, UTF-8")
    text = decoded(content)
    if "\0" in text:
        raise InputError(f"{path.name} is not a text file; save it as text, UTF-8")
    return text


def decoded(content: bytes) -> str:
    """Decode text, normalise line ends and remove the byte order mark.

    UTF-16 is recognised by its byte order mark. Other text is UTF-8 or, if it is not valid UTF-8, in the encoding that
    an XML file declares, or else Windows-1252, which includes the printable characters of Latin-1.
    """
    declared = [match[1].decode() for match in [_DECLARED.match(content)] if match]
    utf = "utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    for encoding in (utf, *declared):
        try:
            text = content.decode(encoding)
            break
        except (UnicodeDecodeError, LookupError):
            continue
    else:
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
        head = decoded(file.read(_HEAD))
    return all(word in head for word in words)
