"""The mark of a folder that jaxphoto wrote: which files are its own, and as it left them.

Only such a folder is ever replaced, only where its files are unchanged, and whatever else lies in it stays.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from jaxphoto.errors import InputError

Clashes = Callable[[str], bool]
"""Whether a file of the user's, by its path in a folder, cannot stay there beside what jaxphoto writes."""
MARKER = ".jaxphoto.json"
"""The file that lists what jaxphoto wrote in a folder, by SHA-256."""
# What file managers leave in every folder that they show.
_DEBRIS = {".DS_Store", "Thumbs.db", "desktop.ini"}
# Of a marker file in bytes: some hundred thousand files.
_MOST = 50_000_000


def mark(folder: Path) -> None:
    """Write down all files in `folder` as jaxphoto's own."""
    files = {name: _digest(folder / name) for name, _ in _files(folder) if name != MARKER}
    text = json.dumps({"written by": "jaxphoto", "files": files}, indent=1)
    (folder / MARKER).write_text(text + "\n", encoding="utf-8")


def own_files(folder: Path, clashes: Clashes) -> set[str]:
    """The files that jaxphoto wrote in `folder`, by their paths in it; nothing for an empty folder.

    Raises InputError where that is not known, where one of them is no longer as it was written, and where another file
    `clashes` with what jaxphoto writes there.
    """
    if not set(os.listdir(folder)) - _DEBRIS:
        return set()
    known = _known(folder)
    if known is None:
        raise InputError(f"{folder} is not empty, and nothing in it says that jaxphoto wrote it: name a new folder")
    for name, digest in known.items():
        path = folder / name
        if os.path.lexists(path) and (path.is_symlink() or not path.is_file() or _digest(path) != digest):
            raise InputError(
                f"{path} was changed since jaxphoto wrote it, and would be lost: move it away, or name a new folder"
            )
    for name, _ in _files(folder):
        if name not in known and name != MARKER and Path(name).name not in _DEBRIS and clashes(name):
            raise InputError(
                f"{folder / name} is not jaxphoto's and would belong to what is written there: move it away, or name a "
                "new folder"
            )
    return set(known)


def keep(old: Path, new: Path, own: set[str]) -> None:
    """Have everything of `old` that is not its `own` in `new` as well, without a copy where that is possible.

    Raises InputError where `new` has something else of that name.
    """
    for name, is_folder in _files(old, folders=True):
        path, to = old / name, new / name
        try:
            if is_folder:
                # Folders of jaxphoto's come and go with what is in them.
                if not any(file.startswith(f"{name}/") for file in own):
                    to.mkdir(parents=True, exist_ok=True)
            elif name not in own and name != MARKER and path.name not in _DEBRIS:
                _keep_file(path, to)
        except (FileExistsError, NotADirectoryError):
            raise InputError(
                f"{path} is not jaxphoto's, and something of that name is to be written: move it away, or name a new "
                "folder"
            ) from None


def _keep_file(path: Path, to: Path) -> None:
    if os.path.lexists(to) and os.path.samestat(path.lstat(), to.lstat()):
        return
    to.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(path, to, follow_symlinks=False)
    except FileExistsError:
        raise
    except (OSError, NotImplementedError):
        # Some file systems know no second names.
        if os.path.lexists(to):
            raise FileExistsError(to) from None
        shutil.copy2(path, to, follow_symlinks=False)


def _known(folder: Path) -> dict[str, str] | None:
    """What the marker of `folder` lists; None where there is none that jaxphoto wrote."""
    path = folder / MARKER
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size > _MOST:
            return None
        files = json.loads(path.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None
    if not isinstance(files, dict) or not all(isinstance(digest, str) for digest in files.values()):
        return None
    return files


def _files(folder: Path, within: str = "", folders: bool = False) -> Iterator[tuple[str, bool]]:
    """Paths below `folder`, with slashes, each with whether it is a folder (only where `folders` are asked for)."""
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        if entry.is_dir(follow_symlinks=False):
            if folders:
                yield within + entry.name, True
            yield from _files(Path(entry.path), f"{within}{entry.name}/", folders)
        else:
            yield within + entry.name, False


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_in(folder: Path) -> list[str]:
    """The files that jaxphoto wrote in `folder`, by their paths in it; all that it holds where no marker lists them."""
    known = _known(folder)
    return sorted(known) if known is not None else [name for name, _ in _files(folder)]
