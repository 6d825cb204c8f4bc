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

# One module per program, in the order of docs and help; a new format is one file here and its line below.
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
"""The formats of projects that are read."""
EXPORTS = {format.name: format for format in _DECLARED if format.write}
"""The formats of projects that are written, in the order of docs and help."""
_CAMERAS: list[CameraFormat] = _declared("CAMERAS")
CAMERA_FORMATS = {format.name: format for format in (*_CAMERAS, CameraFormat("block", suffixes=(".toml",)))}
"""The formats of camera files of other programs, and block.toml."""
CAMERA_READERS.update({format.name: format.reader for format in _CAMERAS if format.reader})
CAMERAS_WRITTEN = tuple(name for name, format in CAMERA_FORMATS.items() if format.write or name == "block")
CAMERA_MODELS = tuple(dict.fromkeys(name for format in CAMERA_FORMATS.values() for name in format.models))
"""The models of camera formats that may be requested."""
CONTROL_FORMATS = {f.name: f for f in (*gis.CONTROL[::-1], *metashape.CONTROL, *control.CONTROL)}
"""The formats of control files that are recognised by their content; every other text is a table."""
FORMS = (*(f.about for f in CONTROL_FORMATS.values()), control.TABLES.about)
"""What `read_control` reads, for help."""
LOSS_PX = 1.0
"""The largest loss of a camera conversion, at its worst point, unless more is allowed."""


# Projects -----------------------------------------------------------------------------------------------------


def recognise(source: Path) -> list[str]:
    """Return the formats of a file or folder; a fallback format only if there is no other."""
    names = [name for name, format in FORMATS.items() if format.find and len(format.find(source)) == 1]
    return [name for name in names if not FORMATS[name].fallback] or names


def read_tables(source: str | Path, format: str | None = None) -> BlockTables:
    """Return the tables of a file or folder of any of `FORMATS`, recognised unless `format` names it."""
    source = Path(source)
    if not source.exists():
        raise InputError(f"there is no file or folder {source}; correct the name")
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
        raise InputError(f"{source} holds {len(files)} files of {name}{names}, {chosen.about}; name one")
    with reading(files[0], chosen.about):
        content = chosen.read(files[0])
        return content.tables() if isinstance(content, Project) else content


def read_source(source: str | Path, format: str | None = None, *, stations: bool = True) -> Block:
    """Return the block in a file or folder of any of `FORMATS`, recognised unless `format` names it.

    `stations` False leaves observed camera positions out. Raises InputError for an unknown format, and what
    `jaxphoto.io.read_block` raises.
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
    """Write what `read_source` reads as a block folder, and return it."""
    block = read_source(source, format, stations=stations)
    write_block(block, folder)
    return block


def _format_name(source: Path, name: str | None) -> str:
    known = ", ".join(FORMATS)
    if name is not None:
        if name not in FORMATS:
            raise InputError(f"the format {name!r} is unknown; choose one of {known}")
        return name
    names = recognise(source)
    if len(names) == 1:
        return names[0]
    if not names and source.is_file() and is_camera_file(source):
        raise InputError(f"{source} is a camera file, without photographs; jaxphoto camera converts it")
    if not names and source.is_file() and is_control_file(source):
        raise InputError(f"{source} is control, without photographs; jaxphoto control takes it to a block")
    what = f"is of several formats ({', '.join(names)})" if names else "is of no format that is known"
    raise InputError(f"{source} {what}; name the format, one of {known}")


class Misfit(NamedTuple):
    """Lengths of displacements of image points in pixels."""

    rms_px: float
    max_px: float


class Exported(NamedTuple):
    """Losses of an export."""

    cameras: dict[str, Conversion]
    map_misfit: Misfit | None
    """Of the image points, if collinearity is computed in map coordinates; None in a Cartesian frame."""
    moved: Misfit | None = None
    """Of the image points, if the format keeps their rays."""


def export(project: Project, folder: str | Path, format: str) -> Exported:
    """Write a project into `folder` in one of `EXPORTS`, and return the losses.

    Interior orientations are converted exactly if the format holds their distortion, else fitted over the image format.
    Warns of corrections that other programs do not have. Raises InputError for an unknown format, a folder that holds
    something else, and a camera or frame that the format cannot hold.
    """
    if format not in EXPORTS:
        raise InputError(f"nothing can be exported as {format!r}; choose one of {', '.join(EXPORTS)}")
    chosen, folder = EXPORTS[format], Path(folder)
    assert chosen.write is not None
    check_export_target(folder)
    cameras = {name: _converted(project, name, chosen) for name in project.cameras}
    if project.changes:
        corrections = ", ".join(project.changes)
        warnings.warn(f"{format} knows no {corrections}: points will not fit the photographs by it", stacklevel=2)
    written = project._replace(
        cameras={name: c._replace(interior=cameras[name].interior) for name, c in project.cameras.items()}
    )
    moved = None
    if chosen.keeps_rays:
        written = written._replace(column_row=radial.on_same_rays(project, cameras))
        moved = _misfit(written.column_row - project.column_row)
    with whole_folder(folder, lambda name: True) as work:
        chosen.write(written, work)
    on_map = chosen.in_map and project.frame.kind == "epsg"
    return Exported(cameras, map_misfit(project) if on_map else None, moved)


def check_export_target(folder: Path, *inputs: Path) -> None:
    """Raise InputError if nothing can be written, or anything else lies in the folder, which programs would read."""
    check_folder(folder, *inputs, clashes=lambda name: True)


def _converted(project: Project, name: str, format: Format) -> Conversion:
    """A camera as one that the format has."""
    sensor, interior, _ = project.cameras[name]
    model = format.plane if type(interior.projection) is Perspective else format.fisheye
    if format.plane is None:
        return Conversion(interior, 0.0, 0.0, 1.0)
    if model is None:
        # A polynomial on the plane misses by hundreds of pixels at the border of a fisheye image.
        others = ", ".join(key for key, other in EXPORTS.items() if other.fisheye)
        raise InputError(
            f"camera {name} cannot be written as {format.name}, whose cameras are perspective, because it is a "
            f"fisheye; write one of {others}, or undistort its photographs"
        )
    try:
        return converted(interior, model.distortion, sensor, model.lacks, model.projection)
    except ValueError as error:
        raise InputError(f"camera {name} cannot be written as {format.name}: {error}") from None


def map_misfit(project: Project) -> Misfit | None:
    """Return the misfit of collinearity in map coordinates, before distortion; None if these are no metres."""
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

    `format` None: cameras.txt is COLMAP's, else the suffix decides. The distortion is converted exactly if its terms
    allow it, else fitted over the image format. `model` is the largest of the format's own models to use, one of
    `CAMERA_MODELS`. The loss is a comment of formats that have such; more than `loss_px` at the worst point is an
    error. `distortion` chooses the model in a block.toml, which keeps the `covariance` of `parameter_names(interior)`
    if the model stays, and the `reservation` about the calibration.

    Raises InputError for unknown formats, a `distortion` or `model` that the format does not have, and cameras that it
    cannot hold.
    """
    path = Path(path)
    if format is None:
        by_suffix = [key for key, other in CAMERA_FORMATS.items() if path.suffix.lower() in other.suffixes]
        format = "colmap" if path.name == "cameras.txt" else by_suffix[0] if by_suffix else ""
    if format not in CAMERAS_WRITTEN:
        raise InputError(f"{path}: the name does not tell the format; name one of {', '.join(CAMERAS_WRITTEN)}")
    chosen = CAMERA_FORMATS[format]
    target = _target(path, chosen, interior, model, distortion)
    try:
        conversion = converted(interior, target.distortion, sensor, target.lacks, target.projection)
    except ValueError as error:
        raise InputError(f"{path} cannot be written: {error}") from None
    if not conversion.max_px <= loss_px:
        raise InputError(
            f"{path} would not be this camera any more ({conversion.lost}): choose a model or format with more terms, "
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
                # The first line of YAML by OpenCV and of XML must stay. Two dashes would end a comment of XML.
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
    """The model in which a camera is written."""
    if format.plane is not None and format.fisheye is None and type(interior.projection) is not Perspective:
        others = ", ".join(n for n in CAMERAS_WRITTEN if CAMERA_FORMATS[n].fisheye or not CAMERA_FORMATS[n].plane)
        raise InputError(f"{path}: cameras of {format.name} are perspective, this is a fisheye; write one of {others}")
    if model is not None and model not in format.models:
        there = f"it has {', '.join(format.models)}" if format.models else "leave the model out"
        raise InputError(f"{path}: {model} is no model of the format {format.name}; {there}")
    target = format.model_of(interior) if model is None else format.models[model]
    if target is None:
        return CameraModel(distortion or type(interior.distortion), (), interior.projection)
    if distortion not in (None, target.distortion):
        raise InputError(
            f"{path}: the format {format.name} has the distortion {target.distortion.__name__}, not "
            f"{distortion.__name__}; leave the distortion out, or write a .toml"
        )
    return target


# Control ------------------------------------------------------------------------------------------------------


def is_control_file(path: Path) -> bool:
    """Return True if the content of a file is that of a control file other than a plain table."""
    text = "" if gis.is_geopackage(path) else read_legacy_text(path)
    return any(format.recognise(path, text) for format in CONTROL_FORMATS.values())


def read_control(control: str | Path, marks: str | Path | None = None) -> GivenControl:
    """Return the points of the file `control` with the marks in it, and those of the file `marks`.

    The content tells the format of `FORMS`. Raises InputError if either is none.
    """
    content = _read_control(Path(control))
    if isinstance(content, Marks):
        raise InputError(f"{Path(control).name} has marks but no coordinates; give it as the marks")
    points, seen = content if isinstance(content, GivenControl) else (content, Marks.none())
    if marks is not None:
        other = _read_control(Path(marks))
        if isinstance(other, SurveyedPoints):
            raise InputError(f"{Path(marks).name} has coordinates but no marks; give rows of image, point, x_px, y_px")
        other = other.marks if isinstance(other, GivenControl) else other
        # Of a mark in both files the second is taken.
        repeated = set(zip(other.image, other.point, strict=True))
        kept = np.array([key not in repeated for key in zip(seen.image, seen.point, strict=True)], bool)
        seen = Marks.joined(seen.take(kept), other)
    if seen.point and not set(seen.point) & set(points.ids):
        raise InputError(
            f"{seen.places[0]}: no mark is of a point that {points.file} has ({few(list(dict.fromkeys(seen.point)))}; "
            f"there are {few(points.ids)}); use the same names in both"
        )
    return GivenControl(points, seen)


def _read_control(path: Path) -> GivenControl | SurveyedPoints | Marks:
    text = "" if gis.is_geopackage(path) else read_legacy_text(path)
    chosen = next((f for f in CONTROL_FORMATS.values() if f.recognise(path, text)), control.TABLES)
    with reading(path, chosen.about):
        return chosen.read(path, text)
