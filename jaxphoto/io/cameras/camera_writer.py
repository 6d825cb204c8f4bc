"""An interior orientation -> a camera file of another program, converted exactly where that can be."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from jaxphoto.camera import AbstractDistortion, InteriorOrientation, Perspective, Sensor, Smac
from jaxphoto.camera.conversion import Conversion, converted
from jaxphoto.errors import InputError
from jaxphoto.io.cameras import agisoft, colmap, mrcal, open_cv
from jaxphoto.io.cameras.camera_file import CameraModel, joined_notes
from jaxphoto.io.cameras.colmap import write_colmap
from jaxphoto.io.cameras.open_cv import write_open_cv
from jaxphoto.io.cameras.own_cameras import write_block_camera
from jaxphoto.io.cameras.smac_report import write_smac_report
from jaxphoto.writing import whole_file


class _WriteFormat(NamedTuple):
    """How a format is written, what its perspective cameras and its fisheyes are (None: it has no such, and
    where it has neither any camera goes), and how its files are called."""

    write: Callable[[Path, str, Sensor, InteriorOrientation], None]
    plane: CameraModel | None
    fisheye: CameraModel | None
    suffixes: tuple[str, ...]
    comment: str = ""
    """What makes a line of a sentence that other programs skip; "" where nothing does."""
    models: Mapping[str, CameraModel] = MappingProxyType({})
    """Models of the format that may be asked for, by its own names."""

    def model_of(self, interior: InteriorOrientation) -> CameraModel | None:
        """What a camera is written as."""
        return self.plane if type(interior.projection) is Perspective else self.fisheye


_FORMATS = {
    "opencv": _WriteFormat(
        write_open_cv, open_cv.PLANE, open_cv.FISHEYE, (".yml", ".yaml", ".json"), "# {}", open_cv.MODELS
    ),
    "colmap": _WriteFormat(write_colmap, colmap.PLANE, colmap.FISHEYE, (), "# {}", colmap.PARTS),
    "agisoft": _WriteFormat(agisoft.write_agisoft, agisoft.PLANE, agisoft.FISHEYE, (".xml",), "<!-- {} -->"),
    "mrcal": _WriteFormat(mrcal.write_mrcal, open_cv.PLANE, None, (".cameramodel",), "# {}", mrcal.MODELS),
    "ros": _WriteFormat(open_cv.write_ros, open_cv.PLANE, open_cv.FISHEYE, (), "# {}", open_cv.ROS_MODELS),
    "smac": _WriteFormat(write_smac_report, CameraModel(Smac, (), Perspective()), None, (".txt", ".rpt")),
    "block": _WriteFormat(write_block_camera, None, None, (".toml",)),
}
CAMERA_FORMATS = tuple(_FORMATS)
"""The formats that `write_camera_file` knows."""
CAMERA_MODELS = tuple(dict.fromkeys(name for known in _FORMATS.values() for name in known.models))
"""The models of these formats that may be asked for."""
LOSS_PX = 1.0
"""What a conversion may lose at its worst, in pixels, unless told otherwise: ten times what images are measured to."""


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
    """Write a camera in one of `CAMERA_FORMATS`, and say by how much the file's camera differs from `interior`.

    `format` None: cameras.txt is COLMAP's, else the suffix tells. The distortion is converted exactly where its terms
    allow it, else fitted over the format (`camera.conversion`). `model` is the largest of the format's own models that
    is used, one of `CAMERA_MODELS`, such as OpenCV's of five coefficients. What is lost stands in a comment of formats
    that have such; more than `loss_px` at the worst point is refused. `distortion` chooses the model in a block.toml,
    where the `covariance` of `parameter_names(interior)` is kept, too, if the model stays what it is. The `reservation`
    about the calibration that it is from is kept there, and in a comment of formats that have such.

    Raises InputError for unknown formats, for a `distortion` or `model` that is not the format's, and for cameras that
    the format cannot hold, or not well enough.
    """
    path = Path(path)
    if format is None:
        by_suffix = [key for key, known in _FORMATS.items() if path.suffix.lower() in known.suffixes]
        format = "colmap" if path.name == "cameras.txt" else by_suffix[0] if by_suffix else ""
    if format not in _FORMATS:
        raise InputError(f"{path}: the name does not tell the format; name one of {', '.join(_FORMATS)}")
    known = _FORMATS[format]
    if known.plane is not None and known.fisheye is None and type(interior.projection) is not Perspective:
        # A polynomial on the plane misses by hundreds of pixels where the fisheye looks aside.
        others = ", ".join(key for key, other in _FORMATS.items() if other.fisheye or not other.plane)
        raise InputError(
            f"{path}: cameras of {format} are perspective, and this one is a fisheye; write one of {others}"
        )
    if model is not None and model not in known.models:
        there = f"it has {', '.join(known.models)}" if known.models else "leave the model out"
        raise InputError(f"{path}: {model} is no model of the format {format}; {there}")
    held = known.model_of(interior) if model is None else known.models[model]
    if held is None:
        held = CameraModel(distortion or type(interior.distortion), (), interior.projection)
    if distortion not in (None, held.distortion):
        raise InputError(
            f"{path}: the format {format} has the distortion {held.distortion.__name__}, not {distortion.__name__}; "
            "leave the distortion out, or write a .toml"
        )
    try:
        conversion = converted(interior, held.distortion, sensor, held.lacks, held.projection)
    except ValueError as error:
        raise InputError(f"{path} cannot be written: {error}") from None
    if not conversion.max_px <= loss_px:
        raise InputError(
            f"{path} would not be this camera any more ({conversion.lost}): choose a model or format with more terms, "
            f"or allow the loss (--loss-px {np.ceil(conversion.max_px):.0f})"
        )
    with whole_file(path) as work:
        if format == "block":
            own = covariance if type(conversion.interior.distortion) is type(interior.distortion) else None
            write_block_camera(work, name, sensor, conversion.interior, own, reservation)
        else:
            known.write(work, name, sensor, conversion.interior)
            said = joined_notes(reservation, conversion.lost if conversion.max_px else "")
            # JSON has no comments.
            if said and known.comment and path.suffix.lower() != ".json":
                _mark(work, known.comment, said)
    return conversion


def _mark(file: Path, comment: str, said: str) -> None:
    """Put what is to be known of a camera at the head of its file."""
    text = file.read_text(encoding="utf-8")
    # The first line of YAML by OpenCV and of XML says what the file is. Two dashes would end a comment of XML.
    first, begins, rest = text.partition("\n") if text.startswith(("%YAML", "<?xml")) else ("", "", text)
    line = comment.format(said.replace("--", "- -"))
    file.write_text(f"{first}{begins}{line}\n{rest}", encoding="utf-8")
