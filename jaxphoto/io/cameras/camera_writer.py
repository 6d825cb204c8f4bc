"""An interior orientation -> a camera file of another program, converted exactly where that can be."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxphoto.camera import AbstractDistortion, InteriorOrientation, Perspective, Sensor, Smac
from jaxphoto.camera.conversion import Conversion, converted
from jaxphoto.errors import InputError
from jaxphoto.io.cameras import agisoft, colmap, mrcal, open_cv
from jaxphoto.io.cameras.camera_file import CameraModel
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

    def model_of(self, interior: InteriorOrientation) -> CameraModel | None:
        """What a camera is written as."""
        return self.plane if type(interior.projection) is Perspective else self.fisheye


_FORMATS = {
    "opencv": _WriteFormat(write_open_cv, open_cv.PLANE, open_cv.FISHEYE, (".yml", ".yaml", ".json"), "# {}"),
    "colmap": _WriteFormat(write_colmap, colmap.PLANE, colmap.FISHEYE, (), "# {}"),
    "agisoft": _WriteFormat(agisoft.write_agisoft, agisoft.PLANE, agisoft.FISHEYE, (".xml",), "<!-- {} -->"),
    "mrcal": _WriteFormat(mrcal.write_mrcal, open_cv.PLANE, None, (".cameramodel",), "# {}"),
    "ros": _WriteFormat(open_cv.write_ros, open_cv.PLANE, open_cv.FISHEYE, (), "# {}"),
    "smac": _WriteFormat(write_smac_report, CameraModel(Smac, (), Perspective()), None, (".txt", ".rpt")),
    "block": _WriteFormat(write_block_camera, None, None, (".toml",)),
}
CAMERA_FORMATS = tuple(_FORMATS)
"""The formats that `write_camera_file` knows."""


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
) -> Conversion:
    """Write a camera in one of `CAMERA_FORMATS`, and say by how much the file's camera differs from `interior`.

    `format` None: cameras.txt is COLMAP's, else the suffix tells. The distortion is converted exactly where its terms
    allow it, else fitted over the format (`camera.conversion`). `distortion` chooses the model in a block.toml, where
    the `covariance` of `parameter_names(interior)` is kept, too, if the model stays what it is. The `reservation` about
    the calibration that it is from is kept there, and in a comment of formats that have such.

    Raises InputError for unknown formats, for a `distortion` that is not the format's and for cameras that the format
    cannot hold.
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
    model = known.model_of(interior)
    if model is None:
        model = CameraModel(distortion or type(interior.distortion), (), interior.projection)
    if distortion not in (None, model.distortion):
        raise InputError(
            f"{path}: the format {format} has the distortion {model.distortion.__name__}, not {distortion.__name__}; "
            "leave the distortion out, or write a .toml"
        )
    try:
        conversion = converted(interior, model.distortion, sensor, model.lacks, model.projection)
    except ValueError as error:
        raise InputError(f"{path} cannot be written: {error}") from None
    with whole_file(path) as work:
        if format == "block":
            own = covariance if type(conversion.interior.distortion) is type(interior.distortion) else None
            write_block_camera(work, name, sensor, conversion.interior, own, reservation)
        else:
            known.write(work, name, sensor, conversion.interior)
            # JSON has no comments.
            if reservation and known.comment and path.suffix.lower() != ".json":
                _mark(work, known.comment, reservation)
    return conversion


def _mark(file: Path, comment: str, reservation: str) -> None:
    """Put what speaks against a camera at the head of its file."""
    text = file.read_text(encoding="utf-8")
    # The first line of YAML by OpenCV and of XML says what the file is. Two dashes would end a comment of XML.
    first, begins, rest = text.partition("\n") if text.startswith(("%YAML", "<?xml")) else ("", "", text)
    line = comment.format(reservation.replace("--", "- -"))
    file.write_text(f"{first}{begins}{line}\n{rest}", encoding="utf-8")
