"""The result folder of `jaxphoto adjust`, or the folder of `jaxphoto fly` -> its block with the adjusted values.

A result has the values, by ids; image points, cameras of images and the frame are those of its block. Which block that
is stands in summary.json: beside the result of `adjust`, in the list of parts of a flight.
"""

import csv
import dataclasses
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import equinox as eqx
import numpy as np
import pandas as pd

from jaxphoto.arrays import on_device
from jaxphoto.block import Block, Start
from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError, few
from jaxphoto.io.block_folder import read_block
from jaxphoto.io.block_folder.images import check_angles
from jaxphoto.io.block_folder.table_layout import ANGLES, TOML, XYZ
from jaxphoto.io.camera_files import INTERIOR, read_camera_file
from jaxphoto.io.json_file import read_json
from jaxphoto.io.names import control_in
from jaxphoto.io.results_judged import SUMMARY
from jaxphoto.io.text_tables import Table, read_csv

EXTERIOR, POINTS = "exterior.csv", "object_points.csv"
PHOTOGRAPHS = "photographs.csv"
"""Of a flight: the file of the photograph that each image is."""
_from_angles = eqx.filter_jit(ExteriorOrientation.from_angles)
_MEND = "name the block that was adjusted by --block, or adjust again"
# Bytes of a name, characters of a path as seen from another folder.
_LONGEST_NAME, _LONGEST_PATH = 255, 1000
_PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".dng", ".bmp", ".webp", ".jp2")


class _Sources(NamedTuple):
    result: Path
    block: Path


def is_result(folder: Path) -> bool:
    """Whether `folder` is one of results of `adjust`, or one of `fly`."""
    return (folder / INTERIOR).is_file() or _parts(folder) is not None


def adjusted_block(folder: str | Path, block: str | Path | None = None, part: int = 1) -> Block:
    """The block that was adjusted, with the adjusted interior and exterior orientations and object points as its start.

    `folder` is that of `jaxphoto adjust --out`, or of `jaxphoto fly`, of which `part` counts the blocks, the largest
    being 1. `block` is the block folder where the result does not say it, or it lies elsewhere now. Mounts, strips and
    other unknowns keep the start values of the block.

    Warns (UserWarning) where the verdict on it is red. Raises InputError where it is no result, of an adjustment that
    did not converge, or not of that block.
    """
    sources = _sources(Path(folder), None if block is None else Path(block), part)
    given = read_block(sources.block)
    cameras = dict.fromkeys(given.image_camera)
    interior = {name: _camera(sources, name, given) for name in given.start.unknowns.interior if name in cameras}
    exterior = _values(sources, EXTERIOR, "image", given.images, (*XYZ, *ANGLES))
    points = _values(sources, POINTS, "point", given.points, XYZ)
    unknowns = dataclasses.replace(
        given.start.unknowns,
        interior=given.start.unknowns.interior | interior,
        exterior=call_compiled(_from_angles, exterior[:, :3], np.deg2rad(exterior[:, 3:])),
        points=on_device(points),
    )
    known = Start(unknowns, np.ones(len(given.images), bool), np.ones(len(given.points), bool))
    return dataclasses.replace(given, start=known)


def photograph_files(images: Sequence[str], folders: Iterable[Path], flight: Path | None = None) -> dict[str, str]:
    """The names of photographs by the ids of images: pictures in `folders` that are called so but for the ending.

    What a `flight` notes of its photographs comes first. Images without one are left out. Raises InputError where two
    pictures of `folders` would be one image.
    """
    wanted, found = set(images), {} if flight is None else _noted(flight)
    seen: dict[str, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"there is no folder {folder}; name that of the photographs")
        for file in sorted(folder.iterdir()):
            if file.suffix.lower() in _PICTURES and file.stem in wanted:
                if file.stem in seen:
                    raise InputError(f"{seen[file.stem]} and {file} would both be the image {file.stem}; give one")
                seen[file.stem] = file
    return found | {name: file.name for name, file in seen.items()}


def write_photograph_files(files: Mapping[str, str], flight: Path) -> None:
    """Write into the folder of a flight the names of its photographs by the ids of images."""
    table = pd.DataFrame({"image": list(files), "file": list(files.values())})
    table.to_csv(flight / PHOTOGRAPHS, index=False, quoting=csv.QUOTE_NONNUMERIC)


def _noted(flight: Path) -> dict[str, str]:
    # Of a flight, or of the result in one.
    path = flight / PHOTOGRAPHS if (flight / PHOTOGRAPHS).is_file() else flight.parent / PHOTOGRAPHS
    if not path.is_file():
        return {}
    table = read_csv(path, ("image", "file"))
    return dict(zip(table.ids("image").tolist(), table.ids("file").tolist(), strict=True))


def _parts(folder: Path) -> list[Any] | None:
    """The list of parts of a flight; None where `folder` is none."""
    if not (folder / SUMMARY).is_file():
        return None
    parts = read_json(folder / SUMMARY).get("parts")
    return parts if isinstance(parts, list) else None


def _sources(folder: Path, block: Path | None, part: int) -> _Sources:
    parts = None if (folder / INTERIOR).is_file() else _parts(folder)
    if parts is not None:
        if not 1 <= part <= len(parts):
            raise InputError(f"{folder} has {len(parts)} part(s), the largest being 1; there is no part {part}")
        told = parts[part - 1] if isinstance(parts[part - 1], dict) else {}
        result, own = (_below(folder, told.get(key)) for key in ("result", "block"))
        if result is None or own is None:
            raise InputError(f"{folder / SUMMARY} does not say where part {part} is; fly again")
        return _checked(result, block or own)
    if not (folder / INTERIOR).is_file():
        raise InputError(f"{folder} has no {INTERIOR}; give a folder that jaxphoto adjust or jaxphoto fly wrote")
    if part != 1:
        raise InputError(f"{folder} is the result of one block; only the folder of a flight has a part {part}")
    if block is None:
        block = _own_block(folder)
    return _checked(folder, block)


def _own_block(folder: Path) -> Path:
    """The block of a result: what its summary says, or the flight that it lies in."""
    summary = read_json(folder / SUMMARY) if (folder / SUMMARY).is_file() else {}
    told = summary.get("block")
    if _is_path(told):
        return folder / told
    for other in _parts(folder.parent) or []:
        if isinstance(other, dict) and other.get("result") == folder.name:
            own = _below(folder.parent, other.get("block"))
            if own is not None:
                return own
    raise InputError(f"{folder} does not say of which block it is the result; name the block folder by --block")


def _below(folder: Path, name: Any) -> Path | None:
    """A folder in `folder`; None for a name that is none, or leads elsewhere."""
    return folder / name if _is_path(name) and name not in (".", "..") and not set(name) & set("/\\") else None


def _is_path(text: Any) -> TypeGuard[str]:
    """Whether a word of a file can be the path of a folder, of a length that systems know."""
    if not isinstance(text, str) or text == "" or control_in(text) or len(text) > _LONGEST_PATH:
        return False
    return max(len(part.encode()) for part in text.split("/")) <= _LONGEST_NAME


def _checked(result: Path, block: Path) -> _Sources:
    if not (block / TOML).is_file():
        raise InputError(f"the block of {result} should be {block}, where there is no {TOML}; name it by --block")
    return _Sources(result, block)


def _camera(sources: _Sources, name: str, block: Block) -> InteriorOrientation:
    read = read_camera_file(sources.result / INTERIOR, camera=name)
    if read.note:
        warnings.warn(f"{sources.result}: {read.note}", UserWarning, stacklevel=3)
    if read.sensor != block.sensors[name]:
        raise InputError(f"{sources.result}: camera {name} has another sensor than in {sources.block}; {_MEND}")
    return read.interior


def _values(sources: _Sources, file: str, column: str, ids: Sequence[str], numbers: tuple[str, ...]) -> np.ndarray:
    """The numbers of a table of results in the order of the block. Raises InputError where it has other ids."""
    table = _table(sources.result / file, column, numbers)
    place: Mapping[str, int] = {name: k for k, name in enumerate(table.ids(column).tolist())}
    missing = [name for name in ids if name not in place]
    if missing or len(place) != len(ids) or len(table) != len(ids):
        odd = missing or [name for name in place if name not in set(ids)] or list(place)
        raise InputError(f"{sources.result / file} is not of the block {sources.block}: {column} {few(odd)}; {_MEND}")
    values = np.stack([table.numbers(name) for name in numbers], axis=1)
    return values[[place[name] for name in ids]]


def _table(path: Path, column: str, numbers: tuple[str, ...]) -> Table:
    if not path.is_file():
        raise InputError(f"{path} is missing, which results have; adjust again")
    table = read_csv(path, (column, *numbers), (*(f"sigma_{name}" for name in numbers), "n_images", "angle_deg"))
    if ANGLES[0] in numbers:
        check_angles(table, np.stack([table.numbers(name) for name in ANGLES], axis=1), ANGLES)
    return table
