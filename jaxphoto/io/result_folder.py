"""Results of `jaxphoto adjust` or `jaxphoto fly` -> their block with the adjusted values.

Results have values by ids; image points, cameras of images and the frame are those of the block, which summary.json
names: beside the result of `adjust`, in the list of parts of a flight.
"""

import csv
import dataclasses
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import pandas as pd

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Block, Start
from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError, few
from jaxphoto.io.block_folder import read_block
from jaxphoto.io.block_folder.table_layout import ANGLES, TOML, XYZ, check_angles
from jaxphoto.io.camera_files import INTERIOR, read_camera_file
from jaxphoto.io.result_tables import SUMMARY
from jaxphoto.io.text_files import read_json
from jaxphoto.io.text_tables import read_csv

EXTERIOR, POINTS = "exterior.csv", "object_points.csv"
PHOTOGRAPHS = "photographs.csv"
"""Names of the photographs of a flight by the ids of images."""
_from_angles = eqx.filter_jit(ExteriorOrientation.from_angles)
_CURE = "name the block that was adjusted by --block, or adjust again"
_PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".dng", ".bmp", ".webp", ".jp2")


def is_result(folder: Path) -> bool:
    """Return True for a folder of results of `adjust` or of `fly`."""
    return (folder / INTERIOR).is_file() or _parts(folder) is not None


def adjusted_block(folder: str | Path, block: str | Path | None = None, part: int = 1) -> Block:
    """Return the block of results with the adjusted cameras, orientations and object points as its start.

    `folder` is that of `jaxphoto adjust --out`, or of `jaxphoto fly`, of which `part` counts the blocks, the largest
    being 1. `block` is the block folder if the results do not name it, or it was moved. Mounts, strips and other
    unknowns keep the start values of the block.

    Warns if the verdict is red. Raises InputError for folders without results, of an adjustment that did not converge,
    or of another block.
    """
    result, source = _sources(Path(folder), None if block is None else Path(block), part)
    of = read_block(source)
    cameras = set(of.image_camera)
    interior = {name: _camera(result, name, of, source) for name in of.start.unknowns.interior if name in cameras}
    exterior = _values(result, source, EXTERIOR, "image", of.images, (*XYZ, *ANGLES))
    points = _values(result, source, POINTS, "point", of.points, XYZ)
    unknowns = dataclasses.replace(
        of.start.unknowns,
        interior=of.start.unknowns.interior | interior,
        exterior=call_compiled(_from_angles, exterior[:, :3], np.deg2rad(exterior[:, 3:])),
        points=as_jax_array(points),
    )
    start = Start(unknowns, np.ones(len(of.images), bool), np.ones(len(of.points), bool))
    return dataclasses.replace(of, start=start)


def photograph_files(images: Sequence[str], folders: Iterable[Path], flight: Path | None = None) -> dict[str, str]:
    """Return the names of photographs by the ids of images: pictures in `folders`, else those that a `flight` lists.

    Raises InputError if two pictures of `folders` would be one image.
    """
    pictures: dict[str, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"there is no folder {folder}; name that of the photographs")
        for file in sorted(folder.iterdir()):
            if file.suffix.lower() in _PICTURES and file.stem in set(images):
                if file.stem in pictures:
                    raise InputError(f"{pictures[file.stem]} and {file} would both be the image {file.stem}; give one")
                pictures[file.stem] = file
    listed = {} if flight is None else _listed(flight)
    return listed | {name: file.name for name, file in pictures.items()}


def write_photograph_files(files: Mapping[str, str], flight: Path) -> None:
    """Write the names of the photographs of a flight by the ids of images."""
    table = pd.DataFrame({"image": list(files), "file": list(files.values())})
    table.to_csv(flight / PHOTOGRAPHS, index=False, quoting=csv.QUOTE_NONNUMERIC)


def _listed(flight: Path) -> dict[str, str]:
    """Names in the table of a flight, or of the flight around a result."""
    path = next((p for p in (flight / PHOTOGRAPHS, flight.parent / PHOTOGRAPHS) if p.is_file()), None)
    if path is None:
        return {}
    table = read_csv(path, ("image", "file"))
    return dict(zip(table.ids("image").tolist(), table.ids("file").tolist(), strict=True))


def _parts(folder: Path) -> list[Any] | None:
    """The list of parts of a flight; None for other folders."""
    parts = read_json(folder / SUMMARY).get("parts") if (folder / SUMMARY).is_file() else None
    return parts if isinstance(parts, list) else None


def _sources(folder: Path, block: Path | None, part: int) -> tuple[Path, Path]:
    """The folders of the results and of the block."""
    result = folder
    parts = None if (folder / INTERIOR).is_file() else _parts(folder)
    if parts is not None:
        if not 1 <= part <= len(parts):
            raise InputError(f"{folder} has {len(parts)} part(s), the largest being 1; there is no part {part}")
        names = parts[part - 1] if isinstance(parts[part - 1], dict) else {}
        inside = [_below(folder, names.get(key)) for key in ("result", "block")]
        if inside[0] is None or inside[1] is None:
            raise InputError(f"{folder / SUMMARY} does not say where part {part} is; fly again")
        result, block = inside[0], block or inside[1]
    elif not (folder / INTERIOR).is_file():
        raise InputError(f"{folder} has no {INTERIOR}; give a folder that jaxphoto adjust or jaxphoto fly wrote")
    elif part != 1:
        raise InputError(f"{folder} is the result of one block; only the folder of a flight has a part {part}")
    block = block or _block_of(folder)
    if not (block / TOML).is_file():
        raise InputError(f"the block of {result} should be {block}, where there is no {TOML}; name it by --block")
    return result, block


def _block_of(folder: Path) -> Path:
    """The block of results that their summary names, or the flight around them."""
    name = read_json(folder / SUMMARY).get("block") if (folder / SUMMARY).is_file() else None
    if isinstance(name, str) and name:
        return folder / name
    for other in _parts(folder.parent) or []:
        if isinstance(other, dict) and other.get("result") == folder.name:
            block = _below(folder.parent, other.get("block"))
            if block is not None:
                return block
    raise InputError(f"{folder} does not say of which block it is the result; name the block folder by --block")


def _below(folder: Path, name: Any) -> Path | None:
    """A folder in `folder`; None for any other name."""
    return folder / name if isinstance(name, str) and name != ".." and Path(name).name == name != "" else None


def _camera(result: Path, name: str, block: Block, source: Path) -> InteriorOrientation:
    camera = read_camera_file(result / INTERIOR, camera=name)
    if camera.note:
        warnings.warn(f"{result}: {camera.note}", UserWarning, stacklevel=3)
    if camera.sensor != block.sensors[name]:
        raise InputError(f"{result}: camera {name} has another sensor than in {source}; {_CURE}")
    return camera.interior


def _values(
    result: Path, block: Path, file: str, column: str, ids: Sequence[str], numbers: tuple[str, ...]
) -> np.ndarray:
    """The numbers of a table of results in the order of the block. Raise InputError for other ids."""
    path = result / file
    if not path.is_file():
        raise InputError(f"{path} is missing, which results have; adjust again")
    table = read_csv(path, (column, *numbers), (*(f"sigma_{name}" for name in numbers), "n_images", "angle_deg"))
    if ANGLES[0] in numbers:
        check_angles(table, np.stack([table.numbers(name) for name in ANGLES], axis=1), ANGLES)
    place = {name: k for k, name in enumerate(table.ids(column).tolist())}
    missing = [name for name in ids if name not in place]
    if missing or len(place) != len(ids) or len(table) != len(ids):
        odd = missing or [name for name in place if name not in set(ids)] or list(place)
        raise InputError(f"{path} is not of the block {block}: {column} {few(odd)}; {_CURE}")
    values = np.stack([table.numbers(name) for name in numbers], axis=1)
    return values[[place[name] for name in ids]]
