"""Photographs of one flight: what can be used of files and folders, and why the rest cannot."""

import collections
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from jaxphoto.errors import InputError
from jaxphoto.io.photographs import ONE_CAMERA, Photograph, read_photograph
from jaxphoto.writing.inputs import input_file

# Of files that are taken from a folder.
_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
# A JPEG is decoded to about this size, an eighth at least, which tells as surely whether it is whole.
_SMALL_PX = (512, 512)


def sound_photographs(paths: Sequence[str | Path]) -> tuple[list[Photograph], dict[str, str]]:
    """The photographs of one camera among files and folders `paths`, and why each other file is left out.

    Of a folder all pictures, in the order of their names. Left out, a sentence each: what is no picture or is cut off,
    a second of the same name, one that is another's copy byte for byte (of the two that with the longer name), and
    those of another size, orientation flag, camera or focal length than most. Raises InputError for what is neither
    file nor folder, and where nothing is left.
    """
    files = pictures_in(paths)
    if missing := [file for file in files if not file.is_file()]:
        raise InputError(f"{missing[0]}: there is no such photograph or folder; correct the name")
    left: dict[str, str] = {}
    read: dict[str, Photograph] = {}
    content: dict[str, Photograph] = {}
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
        if twin is not None and len(twin.name) <= len(photograph.name):
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
    left |= {str(file): f"{file}: it is a copy of {content[digest].path.name}" for file, digest in copies.items()}
    kept = list(read.values())
    for what, of, _ in ONE_CAMERA:
        said = [of(p) for p in kept]
        usual = collections.Counter(v for v in said if v is not None).most_common(1)
        for p, own in zip(kept, said, strict=True):
            if own is not None and own != usual[0][0]:
                left[str(p.path)] = f"{p.path}: its {what} is {own}, that of most is {usual[0][0]}"
        kept = [p for p in kept if str(p.path) not in left]
    if not kept:
        beside = f"; {next(iter(left.values()))}" if left else ""
        raise InputError(f"{', '.join(map(str, paths))}: there is no photograph that can be read{beside}")
    return kept, left


def pictures_in(paths: Sequence[str | Path]) -> list[Path]:
    """The files among `paths`, and all pictures of folders among them, in the order of their names."""
    return [file for path in map(Path, paths) for file in (_pictures(path) if path.is_dir() else [path])]


def _pictures(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES and file.is_file())


def _check_whole(file: Path) -> None:
    """Raise InputError for a JPEG that is cut off; other formats show it when they are read."""
    try:
        with Image.open(file) as picture:
            if picture.format == "JPEG":
                picture.draft("L", _SMALL_PX)
                picture.load()
    except OSError as error:
        raise InputError(f"{file}: the picture is cut off or damaged ({error}); copy it anew") from error
