"""Photographs of one flight: what can be used of files and folders, and why the rest cannot."""

import collections
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image

from jaxphoto.errors import InputError, counted, few
from jaxphoto.io.photographs import ONE_CAMERA, Photograph, read_photograph
from jaxphoto.writing import MARKER
from jaxphoto.writing.inputs import input_file

# Of files that are taken from a folder.
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
# What cameras write; a folder of PNG beside photographs is seldom one of a camera.
_OF_CAMERAS = tuple(suffix for suffix in SUFFIXES if suffix != ".png")
_RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".rw2", ".orf", ".raf", ".srw", ".pef")
# A JPEG is decoded to about this size, an eighth at least, which tells as surely whether it is whole.
_SMALL_PX = (512, 512)
# As many files as have a sentence each, where it is the same for all.
_SOME = 3


def sound_photographs(paths: Sequence[str | Path]) -> tuple[list[Photograph], dict[str, str]]:
    """The photographs of one camera among files and folders `paths`, and why each other file is left out.

    Of a folder all pictures, in the order of their names. Left out, a sentence each: what is no picture or is cut off,
    a second of the same name, one that is another's copy byte for byte (of the two that whose name is less like those
    of the others, then the longer one) or that was changed since, and those that differ from most in what `ONE_CAMERA`
    names. Raises InputError for what is neither file nor folder, and where nothing is left.
    """
    files = pictures_in(paths)
    if missing := [file for file in files if not (file.is_file() or file.is_symlink())]:
        raise InputError(f"{missing[0]}: there is no such photograph or folder; correct the name")
    left: dict[str, str] = {}
    read: dict[str, Photograph] = {}
    content: dict[str, Photograph] = {}
    alike = collections.Counter(_series(file.stem) for file in files)
    oddness = lambda name: (-alike[_series(name)], len(name))  # noqa: E731
    copies: dict[Path, str] = {}
    for file in files:
        try:
            photograph = read_photograph(file)
            _check_whole(file)
        except InputError as error:
            left[str(file)] = str(error)
            continue
        digest = input_file(file).sha256
        twin = content.get(digest)
        if twin is not None and oddness(twin.name) <= oddness(photograph.name):
            copies[file] = digest
            continue
        if photograph.name in read:
            left[str(file)] = f"{file}: {read[photograph.name].path} has the same name; rename one of them"
            continue
        if twin is not None:
            # "DJI_0002 (1).jpg" comes before the photograph that tables and marks name.
            copies[twin.path] = digest
            del read[twin.name]
        content[digest] = read[photograph.name] = photograph
    left |= {
        str(file): f"{file}: it is a copy of {_told(content[digest].path, file)}" for file, digest in copies.items()
    }
    left |= _edited(read)
    kept = [p for p in read.values() if str(p.path) not in left]
    for what, of, mend in ONE_CAMERA:
        said = [of(p) for p in kept]
        usual = collections.Counter(v for v in said if v is not None).most_common(1)
        for p, own in zip(kept, said, strict=True):
            if own is not None and own != usual[0][0]:
                left[str(p.path)] = f"{p.path}: its {what} is {own}, that of most is {usual[0][0]}; {mend}"
        kept = [p for p in kept if str(p.path) not in left]
    if not kept:
        beside = f"; {next(iter(left.values()))}" if left else "".join(f"; {hint}" for hint in _hints(paths))
        raise InputError(f"{', '.join(map(str, paths))}: there is no photograph that can be read{beside}")
    return kept, left


def in_short(left_out: Mapping[str, str]) -> list[str]:
    """The sentences of files that are left out; one of all where more than three are for the same reason."""
    alike: dict[str, list[str]] = {}
    for path, why in left_out.items():
        alike.setdefault(why.removeprefix(f"{path}: "), []).append(path)
    said = []
    for why, paths in alike.items():
        if len(paths) > _SOME:
            said.append(f"{len(paths)} files ({few([Path(path).name for path in paths])}), each: {why}")
        else:
            said += [left_out[path] for path in paths]
    return said


def pictures_in(paths: Sequence[str | Path]) -> list[Path]:
    """The files among `paths`, and all pictures of folders among them, in the order of their names."""
    return [file for path in map(Path, paths) for file in (_pictures(path) if path.is_dir() else [path])]


def folders_not_looked_into(paths: Sequence[str | Path]) -> dict[str, str]:
    """Of folders among `paths`, the folders in them that hold pictures, a sentence each; those in `paths` are not."""
    given = {Path(path).resolve() for path in paths}
    found = {}
    for folder in (Path(path) for path in paths if Path(path).is_dir()):
        for inner, number in _with_pictures(folder):
            if inner.resolve() not in given:
                found[str(inner)] = f"{inner}: {counted(number, 'picture')} in a folder that is not named; name it, too"
    return found


def _with_pictures(folder: Path) -> list[tuple[Path, int]]:
    """The folders in a folder that hold pictures of cameras, but for those that jaxphoto wrote, and how many."""
    inner = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    inner = [path for path in inner if os.access(path, os.R_OK | os.X_OK) and not (path / MARKER).exists()]
    counts = ((path, sum(f.suffix.lower() in _OF_CAMERAS for f in path.iterdir())) for path in inner)
    return [(path, number) for path, number in counts if number]


def _hints(paths: Sequence[str | Path]) -> list[str]:
    """What there is in folders without pictures."""
    folders = [Path(path) for path in paths if Path(path).is_dir()]
    inner = [str(path) for folder in folders for path, _ in _with_pictures(folder)]
    raw = [file for folder in folders for file in folder.iterdir() if file.suffix.lower() in _RAW]
    hints = [f"there are pictures in {few(inner)}: name these folders"] if inner else []
    if raw:
        hints.append(
            f"raw files such as {raw[0].name} are not read: develop all alike to JPEG or TIFF, without a correction of "
            "the lens"
        )
    return hints


def _edited(read: dict[str, Photograph]) -> dict[str, str]:
    """Copies that were changed: "DJI_0002-edited" beside "DJI_0002", taken at the same time in the same place."""
    left = {}
    for name, own in read.items():
        for other in (other for other in read.values() if name.startswith(other.name) and name != other.name):
            same = (own.taken, own.gps) == (other.taken, other.gps) != (None, None)
            if same and not name[len(other.name)].isalnum():
                left[str(own.path)] = f"{own.path}: it is {other.path.name} again, changed: of the same time and place"
    return left


def _told(path: Path, beside: Path) -> str:
    """The name of a file, with its folder where `beside` has the same."""
    return str(path) if path.name == beside.name else path.name


def _series(name: str) -> str:
    """A name without its numbers: the same for DJI_0001 and DJI_0002."""
    return re.sub(r"\d+", "#", name)


def _pictures(folder: Path) -> list[Path]:
    """All pictures but hidden ones, as macOS has beside each; links to what is not there are told, not lost."""
    named = (f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and not f.name.startswith("."))
    return sorted(file for file in named if file.is_file() or (file.is_symlink() and not file.exists()))


def _check_whole(file: Path) -> None:
    """Raise InputError for a JPEG that is cut off; other formats show it when they are read."""
    try:
        with Image.open(file) as picture:
            if picture.format == "JPEG":
                picture.draft("L", _SMALL_PX)
                picture.load()
    except OSError as error:
        raise InputError(f"{file}: the picture is cut off or damaged ({error}); copy it anew") from error
