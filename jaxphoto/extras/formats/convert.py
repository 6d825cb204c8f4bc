"""Read and write projects, camera files and control files of any registered format."""

import dataclasses
import inspect
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.camera import AbstractDistortion, InteriorOrientation, Perspective, Sensor
from jaxphoto.camera.conversion import Conversion, converted
from jaxphoto.errors import InputError, few
from jaxphoto.extras.formats.camera_models import CameraModel
from jaxphoto.extras.formats.files import CameraFormat, Format, by_content
from jaxphoto.extras.formats.project import Project
from jaxphoto.io.block_folder import BlockTables, assemble, write_block
from jaxphoto.io.block_folder.block_reader import read_folder
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.camera_files import CAMERA_READERS, is_camera_file, joined_notes, reading, write_block_camera
from jaxphoto.io.text_files import read_legacy_text
from jaxphoto.procedures.control.surveyed import GivenControl, Marks, SurveyedPoints
from jaxphoto.writing import check_folder, whole_file, whole_folder

# One module per program, in the order of docs and help. To add a format, write a module and add its line below.
# ruff: isort: off
from jaxphoto.extras.formats import dbat as dbat
from jaxphoto.extras.formats import photomodeler as photomodeler
from jaxphoto.extras.formats import aicon as aicon
from jaxphoto.extras.formats import opencv as opencv
from jaxphoto.extras.formats import colmap as colmap
from jaxphoto.extras.formats import metashape as metashape
from jaxphoto.extras.formats import opensfm as opensfm
from jaxphoto.extras.formats import openmvg as openmvg
from jaxphoto.extras.formats import blocksexchange as blocksexchange
from jaxphoto.extras.formats import nerfstudio as nerfstudio
from jaxphoto.extras.formats import radial as radial
from jaxphoto.extras.formats import texts as texts
from jaxphoto.extras.formats import orthority as orthority
from jaxphoto.extras.formats import pix4d as pix4d
from jaxphoto.extras.formats import gis as gis
from jaxphoto.extras.formats import smac as smac
from jaxphoto.extras.formats import control as control
# ruff: isort: on

_MODULES = [module for module in globals().values() if inspect.ismodule(module)]


def _declared(name: str) -> list[Any]:
    return [format for module in _MODULES for format in getattr(module, name, ())]


_BLOCK = Format("block", "block folder", by_content(TOML, lambda p: p.name == TOML), lambda p: read_folder(p.parent))
_DECLARED: tuple[Format, ...] = (_BLOCK, *_declared("FORMATS"))
FORMATS = {format.name: format for format in _DECLARED if format.read}
"""Project formats that can be read."""
EXPORTS = {format.name: format for format in _DECLARED if format.write}
"""Project formats that can be written, in the order of docs and help."""
_CAMERAS: list[CameraFormat] = _declared("CAMERAS")
CAMERA_FORMATS = {format.name: format for format in (*_CAMERAS, CameraFormat("block", suffixes=(".toml",)))}
"""Camera file formats of other programs, and block.toml."""
CAMERA_READERS.update({format.name: format.reader for format in _CAMERAS if format.reader})
CAMERAS_WRITTEN = tuple(name for name, format in CAMERA_FORMATS.items() if format.write or name == "block")
CAMERA_MODELS = tuple(dict.fromkeys(name for format in CAMERA_FORMATS.values() for name in format.models))
"""Camera models that can be requested by name."""
CONTROL_FORMATS = {f.name: f for f in (*gis.CONTROL[::-1], *metashape.CONTROL, *control.CONTROL)}
"""Control file formats recognised by content; every other text file is a table."""
FORMS = (*(f.about for f in CONTROL_FORMATS.values()), control.TABLES.about)
"""Control formats for the help text."""
LOSS_PX = 1.0
"""Default maximum loss of a camera conversion at the worst point (px)."""


# Projects -----------------------------------------------------------------------------------------------------


def recognise(source: Path) -> list[str]:
    """Return the formats of a file or folder; a fallback format only if no other matches."""
    names = [name for name, format in FORMATS.items() if format.find and len(format.find(source)) == 1]
    return [name for name in names if not FORMATS[name].fallback] or names


def read_tables(source: str | Path, format: str | None = None) -> BlockTables:
    """Read the tables of a file or folder in one of `FORMATS`. The format is detected unless `format` names it."""
    source = Path(source)
    if not source.exists():
        raise InputError(f"file or folder not found: {source}; correct the name")
    name = _format_name(source, format)
    if name == "block":
        return read_folder(source if source.is_dir() else source.parent)
    chosen = FORMATS[name]
    assert chosen.find is not None and chosen.read is not None
    files = chosen.find(source)
    if len(files) != 1 and source.is_file():
        files = [source]
    if len(files) != 1:
        names = f" ({few([path.name for path in files])})" if files else ""
        raise InputError(f"{source}: {len(files)} files of {name}{names}, {chosen.about}; give one")
    with reading(files[0], chosen.about):
        content = chosen.read(files[0])
        return content.tables() if isinstance(content, Project) else content


def read_source(source: str | Path, format: str | None = None, *, stations: bool = True) -> Block:
    """Read the block in a file or folder in one of `FORMATS`. The format is detected unless `format` names it.

    `stations=False` omits observed camera positions. Raises InputError for an unknown format, and the errors of
    `jaxphoto.io.read_block`.
    """
    source = Path(source)
    tables = read_tables(source, format)
    if not stations:
        kept = {name: table for name, table in tables.tables.items() if name != "stations"}
        tables = BlockTables(tables.settings, kept, tables.file)
    block = assemble(tables)
    name = format or _format_name(source, None)
    if name == "block":
        return block
    return dataclasses.replace(block, converted_from=f"{name}: {'/'.join(source.resolve().parts[-2:])}")


def convert(source: str | Path, folder: str | Path, format: str | None = None, *, stations: bool = True) -> Block:
    """Read a block by `read_source`, write it as a block folder, and return it."""
    block = read_source(source, format, stations=stations)
    write_block(block, folder)
    return block


def _format_name(source: Path, name: str | None) -> str:
    known = ", ".join(FORMATS)
    if name is not None:
        if name not in FORMATS:
            raise InputError(f"unknown format {name!r}; choose one of {known}")
        return name
    names = recognise(source)
    if len(names) == 1:
        return names[0]
    if not names and source.is_file() and is_camera_file(source):
        raise InputError(f"{source} is a camera file, without photographs; jaxphoto camera converts it")
    if not names and source.is_file() and is_control_file(source):
        raise InputError(f"{source} is a control file, without photographs; jaxphoto control adds it to a block")
    what = f"fits several formats ({', '.join(names)})" if names else "has an unknown format"
    raise InputError(f"{source} {what}; give the format, one of {known}")


class Misfit(NamedTuple):
    """RMS and maximum length of image point displacements (px)."""

    rms_px: float
    max_px: float


class Exported(NamedTuple):
    """Losses of an export."""

    cameras: dict[str, Conversion]
    map_misfit: Misfit | None
    """Displacements if collinearity is computed in map coordinates; None in a Cartesian frame."""
    moved: Misfit | None = None
    """Displacements if the format preserves rays instead of image points."""


def export(project: Project, folder: str | Path, format: str) -> Exported:
    """Write a project into `folder` in one of `EXPORTS`, and return the losses.

    Interior orientations are converted exactly if the format supports their distortion, otherwise fitted over the image
    format. Warns of corrections that the format cannot represent. Raises InputError for an unknown format, a folder
    with other content, and a camera or frame that the format cannot represent.
    """
    if format not in EXPORTS:
        raise InputError(f"unknown export format {format!r}; choose one of {', '.join(EXPORTS)}")
    chosen, folder = EXPORTS[format], Path(folder)
    assert chosen.write is not None
    check_folder(folder)
    cameras = {name: _converted(project, name, chosen) for name in project.cameras}
    if project.changes:
        corrections = ", ".join(project.changes)
        warnings.warn(f"{format} does not support {corrections}: points will not fit the photographs", stacklevel=2)
    written = project._replace(
        cameras={name: c._replace(interior=cameras[name].interior) for name, c in project.cameras.items()}
    )
    moved = None
    if chosen.keeps_rays:
        written = written._replace(column_row=radial.on_same_rays(project, cameras))
        moved = _misfit(written.column_row - project.column_row)
    with whole_folder(folder) as work:
        chosen.write(written, work)
    on_map = chosen.in_map and project.frame.kind == "epsg"
    return Exported(cameras, map_misfit(project) if on_map else None, moved)


def _converted(project: Project, name: str, format: Format) -> Conversion:
    """Convert a camera to the model of the format."""
    sensor, interior, _ = project.cameras[name]
    model = format.plane if type(interior.projection) is Perspective else format.fisheye
    if format.plane is None:
        return Conversion(interior, 0.0, 0.0, 1.0)
    if model is None:
        # Perspective polynomials misfit fisheye images by hundreds of pixels at the border.
        others = ", ".join(key for key, other in EXPORTS.items() if other.fisheye)
        raise InputError(
            f"camera {name} is a fisheye, but cameras of {format.name} are perspective; write one of {others}, "
            "or undistort its photographs"
        )
    try:
        return converted(interior, model.distortion, sensor, model.lacks, model.projection)
    except ValueError as error:
        raise InputError(f"camera {name} cannot be written as {format.name}: {error}") from None


def map_misfit(project: Project) -> Misfit | None:
    """Return the misfit of collinearity in map coordinates, without distortion; None if they are not in metres."""
    on_map = project.in_map()
    if on_map.geographic or not len(project.image):
        return None
    return _misfit(_ideal_px(on_map) - _ideal_px(project))


def _ideal_px(p: Project) -> Float[np.ndarray, "n 2"]:
    ray = np.asarray(p.xyz)[p.point] - np.asarray(p.exterior.position)[p.image]
    in_camera = np.einsum("nij,nj->ni", np.asarray(p.exterior.camera_from_object)[p.image], ray)
    of_row, ideal = np.array(p.image_camera, object)[p.image], np.zeros((len(ray), 2))
    for name, (sensor, interior, _) in p.cameras.items():
        rows = of_row == name
        xy = interior.projection.ideal_from_direction(to_numpy(interior.c), *in_camera[rows].T)
        ideal[rows] = np.stack([to_numpy(v) for v in xy], axis=1) / sensor.pixel_mm
    return ideal


def _misfit(displacements: Float[np.ndarray, "n 2"]) -> Misfit:
    lengths = np.linalg.norm(displacements, axis=1)
    return Misfit(float(np.sqrt(np.mean(lengths**2))), float(lengths.max())) if len(lengths) else Misfit(0.0, 0.0)


# Camera files -------------------------------------------------------------------------------------------------


def write_camera_file(
    path: str | Path,
    sensor: Sensor,
    interior: InteriorOrientation,
    format: str | None = None,
    *,
    name: str = "camera",
    distortion: type[AbstractDistortion] | None = None,
    covariance: np.ndarray | None = None,
    reservation: str = "",
    model: str | None = None,
    loss_px: float = LOSS_PX,
) -> Conversion:
    """Write a camera in one of `CAMERAS_WRITTEN`, and return the difference between the file's camera and `interior`.

    If `format` is None, the suffix determines it; cameras.txt is COLMAP's. The distortion is converted exactly if the
    file's model has all its terms, otherwise fitted over the image format. `model`, one of `CAMERA_MODELS`, is the
    largest model of the format to use. The loss is written as a comment if the format has comments; a loss of more than
    `loss_px` at the worst point is an error. `distortion` is the model in a block.toml. A block.toml also stores the
    `reservation` about the calibration and, if the model is unchanged, the `covariance` of `parameter_names(interior)`.

    Raises InputError for an unknown format, a `distortion` or `model` that the format does not support, and a camera
    that it cannot represent.
    """
    path = Path(path)
    if format is None:
        by_suffix = [key for key, other in CAMERA_FORMATS.items() if path.suffix.lower() in other.suffixes]
        format = "colmap" if path.name == "cameras.txt" else by_suffix[0] if by_suffix else ""
    if format not in CAMERAS_WRITTEN:
        raise InputError(f"{path}: unknown camera format; give one of {', '.join(CAMERAS_WRITTEN)}")
    chosen = CAMERA_FORMATS[format]
    target = _target(path, chosen, interior, model, distortion)
    try:
        conversion = converted(interior, target.distortion, sensor, target.lacks, target.projection)
    except ValueError as error:
        raise InputError(f"{path} cannot be written: {error}") from None
    if not conversion.max_px <= loss_px:
        raise InputError(
            f"{path} would change the camera ({conversion.lost}): choose a model or format with more terms, "
            f"or allow the loss (--loss-px {np.ceil(conversion.max_px):.0f})"
        )
    with whole_file(path) as work:
        if chosen.write is None:
            kept = covariance if type(conversion.interior.distortion) is type(interior.distortion) else None
            write_block_camera(work, name, sensor, conversion.interior, kept, reservation)
        else:
            chosen.write(work, name, sensor, conversion.interior)
            note = joined_notes(reservation, conversion.lost if conversion.max_px else "")
            # JSON has no comments.
            if note and chosen.comment and path.suffix.lower() != ".json":
                text = work.read_text(encoding="utf-8")
                # Keep the first line of OpenCV's YAML and of XML first. Two dashes would end an XML comment.
                first, end, rest = text.partition("\n") if text.startswith(("%YAML", "<?xml")) else ("", "", text)
                work.write_text(
                    f"{first}{end}{chosen.comment.format(note.replace('--', '- -'))}\n{rest}", encoding="utf-8"
                )
    return conversion


def _target(
    path: Path,
    format: CameraFormat,
    interior: InteriorOrientation,
    model: str | None,
    distortion: type[AbstractDistortion] | None,
) -> CameraModel:
    """Return the camera model to write."""
    if format.plane is not None and format.fisheye is None and type(interior.projection) is not Perspective:
        others = ", ".join(n for n in CAMERAS_WRITTEN if CAMERA_FORMATS[n].fisheye or not CAMERA_FORMATS[n].plane)
        raise InputError(
            f"{path}: the camera is a fisheye, but cameras of {format.name} are perspective; write one of {others}"
        )
    if model is not None and model not in format.models:
        there = f"use one of {', '.join(format.models)}" if format.models else "omit the model"
        raise InputError(f"{path}: unknown model {model} of format {format.name}; {there}")
    target = format.model_of(interior) if model is None else format.models[model]
    if target is None:
        return CameraModel(distortion or type(interior.distortion), (), interior.projection)
    if distortion not in (None, target.distortion):
        raise InputError(
            f"{path}: format {format.name} has the distortion {target.distortion.__name__}, not "
            f"{distortion.__name__}; omit the distortion, or write a .toml"
        )
    return target


# Control ------------------------------------------------------------------------------------------------------


def is_control_file(path: Path) -> bool:
    """Return True for a control file of any format but plain tables, by its content."""
    text = "" if gis.is_geopackage(path) else read_legacy_text(path)
    return any(format.recognise(path, text) for format in CONTROL_FORMATS.values())


def read_control(control: str | Path, marks: str | Path | None = None) -> GivenControl:
    """Read the points and marks of the file `control`, and further marks from the file `marks`.

    The format, one of `FORMS`, is detected from the content. Raises InputError if it is not detected.
    """
    content = _read_control(Path(control))
    if isinstance(content, Marks):
        raise InputError(f"{Path(control).name} has marks but no coordinates; give it as marks")
    points, seen = content if isinstance(content, GivenControl) else (content, Marks.none())
    if marks is not None:
        other = _read_control(Path(marks))
        if isinstance(other, SurveyedPoints):
            raise InputError(f"{Path(marks).name} has coordinates but no marks; give rows of image, point, x_px, y_px")
        other = other.marks if isinstance(other, GivenControl) else other
        # Marks of the second file replace repeated ones of the first.
        repeated = set(zip(other.image, other.point, strict=True))
        kept = np.array([key not in repeated for key in zip(seen.image, seen.point, strict=True)], bool)
        seen = Marks.joined(seen.take(kept), other)
    if seen.point and not set(seen.point) & set(points.ids):
        raise InputError(
            f"{seen.places[0]}: no marked point ({few(list(dict.fromkeys(seen.point)))}) is in {points.file} "
            f"({few(points.ids)}); use the same names in both"
        )
    return GivenControl(points, seen)


def _read_control(path: Path) -> GivenControl | SurveyedPoints | Marks:
    text = "" if gis.is_geopackage(path) else read_legacy_text(path)
    chosen = next((f for f in CONTROL_FORMATS.values() if f.recognise(path, text)), control.TABLES)
    with reading(path, chosen.about):
        return chosen.read(path, text)
