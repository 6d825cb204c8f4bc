"""Files that users name, read whole: regular files of a bounded size, text in UTF-8."""

import stat
from pathlib import Path

from jaxphoto.errors import InputError, JaxphotoError

SMALL = 16_000_000
"""Bytes of the largest file of settings, camera or report. A block.toml has some 300 a camera."""
LARGE = 1_000_000_000
"""Bytes of the largest table: some twenty million image points, which take 10 GB of memory as they are read."""
# Bytes in which what tells a format stands, such as the first oriented camera below sensors with their covariances.
_HEAD = 2_000_000
# Files of the system tell no size.
_UNTOLD = 1_000_000


def read_whole(path: Path, most: int) -> bytes:
    """The content of a file of at most `most` bytes.

    Raises InputError where there is none, where it cannot be read, is too large, or is no file: a folder, a pipe or a
    device has no end.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or a device"
            raise InputError(f"{path} is {kind}; name a file")
        if status.st_size > most:
            raise _too_large(path, most)
        with path.open("rb") as file:
            content = file.read(max(status.st_size, _UNTOLD) + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"there is no file {path}; add it, or correct the name") from None
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror}); check that it is a readable file") from None
    except JaxphotoError:
        raise
    except ValueError:
        # A zero in the name.
        raise InputError(f"no file can be called {path}; correct the name") from None
    if len(content) > max(status.st_size, _UNTOLD):
        raise InputError(f"{path} grows while it is read; name a file that is complete")
    return content


# What archives begin with: ZIP, as which spreadsheets keep their workbooks, and that of older ones.
_WORKBOOK = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")


def read_text(path: Path, most: int) -> str:
    """The text of a file of at most `most` bytes, without byte order mark. Raises as `read_whole`, and for no UTF-8."""
    content = read_whole(path, most)
    if content.startswith(_WORKBOOK):
        raise InputError(f"{path.name} is a workbook (xlsx, ods) or another archive; save the sheet as CSV, UTF-8")
    try:
        # Any line ends, as everywhere.
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        row = error.object[: error.start].count(b"\n") + 1
        raise InputError(
            f"{path.name}, row {row}: the text is not UTF-8; save the file as UTF-8 (in a spreadsheet: CSV UTF-8)"
        ) from None


def has_words(path: Path, *words: str) -> bool:
    """Whether a file is there and all `words` stand in its first two megabytes, by which its format is told."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return all(word.encode() in head for word in words)


def _too_large(path: Path, most: int) -> InputError:
    return InputError(
        f"{path} has more than the {most / 1e6:g} MB that a file of its kind may have; give a smaller one"
    )
