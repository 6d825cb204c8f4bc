"""Read and write projects, camera files and control files of any registered format."""

import dataclasses
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.block import Block
from jaxphoto.camera import AbstractDistortion, InteriorOrientation, Perspective, Sensor
from jaxphoto.camera.conversion import Conversion, converted
from jaxphoto.errors import InputError, few
from jaxphoto.extras.formats import (
    blocksexchange,
    colmap,
    control,
    dbat,
    geojson,
    metashape,
    opencv,
    opensfm,
    pix4d,
    radial,
    smac,
    texts,
)
from jaxphoto.extras.formats.files import CameraFormat, Format, by_content
from jaxphoto.extras.formats.project import CameraModel, Project
from jaxphoto.io.block_folder import BlockTables, assemble, write_block
from jaxphoto.io.block_folder.block_reader import read_folder
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.camera_files import CAMERA_READERS, is_camera_file, joined_notes, reading, write_block_camera
from jaxphoto.io.text_files import decoded, read_bytes, read_text
from jaxphoto.procedures.control.surveyed import GivenControl, Marks, SurveyedPoints
from jaxphoto.writing import check_folder, whole_file, whole_folder

# One module per program, in the order of docs and help. To add a format, write a module and add it here.
_MODULES = (
    dbat, opencv, colmap, metashape, opensfm, blocksexchange, radial, texts, pix4d, geojson, smac,
    control,
)  # fmt: skip


def _declared(name: str) -> list[Any]:
    return [format for module in _MODULES for format in getattr(module, name, ())]


_BLOCK = Format("block", "block folder", by_content(TOML, lambda p: p.name == TOML), lambda p: read_folder(p.parent))
_DECLARED: tuple[Format, ...] = (_BLOCK, *_declared("FORMATS"))
FORMATS = {format.name: format for format in _DECLARED if format.read}
"""Project formats that can be read."""
EXPORTS = {format.name: format for format in _DECLARED if format.write}
"""Project formats that can be written, in the order of docs and help."""
_CAMERAS: list[CameraFormat] = _declared("CAMERAS")
CAMERA_FORMATS = {f.name: f for f in (*_CAMERAS, CameraFormat("block", suffixes=(".toml",))) if f.write or f.suffixes}
"""Camera file formats that can be written: of other programs, and block.toml."""
CAMERA_READERS.update({format.name: format.reader for format in _CAMERAS if format.reader})
CAMERAS_WRITTEN = tuple(CAMERA_FORMATS)
CONTROL_FORMATS = {format.name: format for format in _declared("CONTROL")}
"""Control file formats recognised by content; every other text file is a table."""
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


def read_source(source: str | Path, format: str | None = None) -> Block:
    """Read the block in a file or folder in one of `FORMATS`. The format is detected unless `format` names it.

    Raises InputError for an unknown format, and the errors of `jaxphoto.io.read_block`.
    """
    source = Path(source)
    block = assemble(read_tables(source, format))
    name = format or _format_name(source, None)
    if name == "block":
        return block
    return dataclasses.replace(block, converted_from=f"{name}: {'/'.join(source.resolve().parts[-2:])}")


def convert(source: str | Path, folder: str | Path, format: str | None = None) -> Block:
    """Read a block by `read_source`, write it as a block folder, and return it."""
    block = read_source(source, format)
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
    if not names and source.is_file() and _control_format(source, decoded(read_bytes(source))) is not control.TABLES:
        raise InputError(f"{source} is a control file, without photographs; jaxphoto control adds it to a block")
    what = f"fits several formats ({', '.join(names)})" if names else "has an unknown format"
    raise InputError(f"{source} {what}; give the format, one of {known}")


class Exported(NamedTuple):
    """Losses of an export."""

    cameras: dict[str, Conversion]
    moved_px: tuple[float, float] | None = None
    """RMS and maximum displacement (px) if the format preserves rays instead of image points."""


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
    cameras = {
        name: _in_model(interior, sensor, chosen, EXPORTS, f"camera {name}")
        for name, (sensor, interior, _) in project.cameras.items()
    }
    if project.changes:
        corrections = ", ".join(project.changes)
        warnings.warn(f"{format} does not support {corrections}: points will not fit the photographs", stacklevel=2)
    written = project._replace(
        cameras={name: c._replace(interior=cameras[name].interior) for name, c in project.cameras.items()}
    )
    moved = None
    if chosen.keeps_rays:
        written = written._replace(column_row=radial.on_same_rays(project, cameras))
        lengths = np.linalg.norm(written.column_row - project.column_row, axis=1)
        moved = float(np.sqrt(np.mean(lengths**2))), float(lengths.max())
    with whole_folder(folder) as work:
        chosen.write(written, work)
    return Exported(cameras, moved)


def _in_model(
    interior: InteriorOrientation,
    sensor: Sensor,
    format: Format | CameraFormat,
    formats: Mapping[str, Format] | Mapping[str, CameraFormat],
    what: str,
    model: CameraModel | None = None,
) -> Conversion:
    """Convert a camera to `model`, by default the model of the format for its projection."""
    model = model or (format.plane if type(interior.projection) is Perspective else format.fisheye)
    if model is None and format.plane is None:
        return Conversion(interior, 0.0, 0.0, 1.0)
    if model is None:
        # Perspective polynomials misfit fisheye images by hundreds of pixels at the border.
        others = ", ".join(name for name, other in formats.items() if other.fisheye)
        raise InputError(
            f"{what} is a fisheye, but cameras of {format.name} are perspective; write one of {others}, or undistort "
            "its photographs"
        )
    try:
        return converted(interior, model.distortion, sensor, model.lacks, model.projection)
    except ValueError as error:
        raise InputError(f"{what} cannot be written as {format.name}: {error}") from None


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
    loss_px: float = LOSS_PX,
) -> Conversion:
    """Write a camera in one of `CAMERAS_WRITTEN`, and return the difference between the file's camera and `interior`.

    If `format` is None, the suffix determines it; cameras.txt is COLMAP's. The distortion is converted exactly if the
    file's model has all its terms, otherwise fitted over the image format. The loss is written as a comment if the
    format has comments; a loss of more than `loss_px` at the worst point is an error. `distortion` is the model in a
    block.toml. A block.toml also stores the `reservation` about the calibration and, if the model is unchanged, the
    `covariance` of `parameter_names(interior)`.

    Raises InputError for an unknown format, a `distortion` of another format, and a camera that it cannot represent.
    """
    path = Path(path)
    if format is None:
        by_suffix = [key for key, other in CAMERA_FORMATS.items() if path.suffix.lower() in other.suffixes]
        format = "colmap" if path.name == "cameras.txt" else by_suffix[0] if by_suffix else ""
    if format not in CAMERA_FORMATS:
        raise InputError(f"{path}: unknown camera format; give one of {', '.join(CAMERAS_WRITTEN)}")
    chosen = CAMERA_FORMATS[format]
    if distortion is not None and format != "block":
        raise InputError(f"{path}: --distortion {distortion.__name__} applies to a .toml; omit it, or write a .toml")
    target = None if distortion is None else CameraModel(distortion, (), interior.projection)
    conversion = _in_model(interior, sensor, chosen, CAMERA_FORMATS, f"{path}: the camera", target)
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
                # The first line of OpenCV's YAML and of XML must remain the first. Two dashes would end an XML comment.
                first, end, rest = text.partition("\n") if text.startswith(("%YAML", "<?xml")) else ("", "", text)
                work.write_text(
                    f"{first}{end}{chosen.comment.format(note.replace('--', '- -'))}\n{rest}", encoding="utf-8"
                )
    return conversion


# Control ------------------------------------------------------------------------------------------------------


def read_control(control: str | Path, marks: str | Path | None = None) -> GivenControl:
    """Read the points and marks of `control`, and further marks from the file `marks`.

    The format is detected from the content. Raises InputError if it is not detected.
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
    text = read_text(path)
    chosen = _control_format(path, text)
    with reading(path, chosen.about):
        return chosen.read(path, text)


def _control_format(path: Path, text: str) -> Any:
    return next((f for f in CONTROL_FORMATS.values() if f.recognise(path, text)), control.TABLES)
