"""Read results of `jaxphoto adjust` or `jaxphoto fly` as a block with adjusted values.

Results contain values by id only. Image points, cameras of images and frame are read from the block, which is named in
summary.json of the result, or in the list of parts of a flight.
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
"""File with the file name of the photograph of each image in a flight."""
_from_angles = eqx.filter_jit(ExteriorOrientation.from_angles)
_CURE = "name the block that was adjusted by --block, or adjust again"
_PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".dng", ".bmp", ".webp", ".jp2")


def is_result(folder: Path) -> bool:
    """Return True for a result folder of `adjust` or `fly`."""
    return (folder / INTERIOR).is_file() or _parts(folder) is not None


def adjusted_block(folder: str | Path, block: str | Path | None = None, part: int = 1) -> Block:
    """Return the block of a result, with the adjusted cameras, orientations and object points as initial values.

    `folder` is the output folder of `jaxphoto adjust` or `jaxphoto fly`. `part` is the number of the block of a flight;
    1 is the largest. `block` is the block folder if the result does not name it, or if it was moved. Mounts, strips and
    other unknowns have the initial values of the block.

    Warns if the verdict is red. Raises InputError for folders without results, an adjustment that did not converge, or
    results of a different block.
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
    """Return the photograph's file name of each image: from `folders`, else from the table of a `flight`.

    Raises InputError if two photographs in `folders` belong to one image.
    """
    pictures: dict[str, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"folder not found: {folder}; give the folder of the photographs")
        for file in sorted(folder.iterdir()):
            if file.suffix.lower() in _PICTURES and file.stem in set(images):
                if file.stem in pictures:
                    raise InputError(f"{pictures[file.stem]} and {file} both have the image name {file.stem}; give one")
                pictures[file.stem] = file
    listed = {} if flight is None else _listed(flight)
    return listed | {name: file.name for name, file in pictures.items()}


def write_photograph_files(files: Mapping[str, str], flight: Path) -> None:
    """Write the photograph's file name of each image of a flight."""
    table = pd.DataFrame({"image": list(files), "file": list(files.values())})
    table.to_csv(flight / PHOTOGRAPHS, index=False, quoting=csv.QUOTE_NONNUMERIC)


def _listed(flight: Path) -> dict[str, str]:
    """Read the photograph table of a flight, or of the flight that contains a result."""
    path = next((p for p in (flight / PHOTOGRAPHS, flight.parent / PHOTOGRAPHS) if p.is_file()), None)
    if path is None:
        return {}
    table = read_csv(path, ("image", "file"))
    return dict(zip(table.ids("image").tolist(), table.ids("file").tolist(), strict=True))


def _parts(folder: Path) -> list[Any] | None:
    """Return the list of parts of a flight; None for other folders."""
    parts = read_json(folder / SUMMARY).get("parts") if (folder / SUMMARY).is_file() else None
    return parts if isinstance(parts, list) else None


def _sources(folder: Path, block: Path | None, part: int) -> tuple[Path, Path]:
    """Return the result folder and the block folder."""
    result = folder
    parts = None if (folder / INTERIOR).is_file() else _parts(folder)
    if parts is not None:
        if not 1 <= part <= len(parts):
            raise InputError(f"{folder} has {len(parts)} part(s); unknown part {part}")
        names = parts[part - 1] if isinstance(parts[part - 1], dict) else {}
        inside = [_below(folder, names.get(key)) for key in ("result", "block")]
        if inside[0] is None or inside[1] is None:
            raise InputError(f"{folder / SUMMARY} has no folder for part {part}; repeat jaxphoto fly")
        result, block = inside[0], block or inside[1]
    elif not (folder / INTERIOR).is_file():
        raise InputError(f"{folder} has no {INTERIOR}; give a folder that jaxphoto adjust or jaxphoto fly wrote")
    elif part != 1:
        raise InputError(f"{folder} is the result of one block; only the folder of a flight has a part {part}")
    block = block or _block_of(folder)
    if not (block / TOML).is_file():
        raise InputError(
            f"the block of {result} should be {block}, but {TOML} is missing there; give the block by --block"
        )
    return result, block


def _block_of(folder: Path) -> Path:
    """Return the block folder named in the summary of the result, or of the flight that contains it."""
    name = read_json(folder / SUMMARY).get("block") if (folder / SUMMARY).is_file() else None
    if isinstance(name, str) and name:
        return folder / name
    for other in _parts(folder.parent) or []:
        if isinstance(other, dict) and other.get("result") == folder.name:
            block = _below(folder.parent, other.get("block"))
            if block is not None:
                return block
    raise InputError(f"{folder} has no reference to its block; give the block folder by --block")


def _below(folder: Path, name: Any) -> Path | None:
    """Return the subfolder `name` of `folder`; None for any other path."""
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
    """Read numeric columns of a result table in the order of the block. Raise InputError for different ids."""
    path = result / file
    if not path.is_file():
        raise InputError(f"{path} is missing in the results; adjust again")
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
