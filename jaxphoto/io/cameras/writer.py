"""An interior orientation -> a camera file of another program, converted exactly where that can be."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from jaxphoto.camera import AbstractDistortion, Agisoft, InteriorOrientation, OpenCv, Sensor, Smac
from jaxphoto.camera.conversion import Conversion, converted
from jaxphoto.errors import InputError
from jaxphoto.io.cameras.agisoft import write_agisoft
from jaxphoto.io.cameras.colmap import write_colmap
from jaxphoto.io.cameras.open_cv import write_open_cv
from jaxphoto.io.cameras.results import write_block_camera
from jaxphoto.io.cameras.smac_report import write_smac_report
from jaxphoto.io.whole_file import whole_file


class _Format(NamedTuple):
    """How a format is written, its distortion (None: any), coefficients that it lacks, and how its files are called."""

    write: Callable[[Path, str, Sensor, InteriorOrientation], None]
    distortion: type[AbstractDistortion] | None
    lacks: tuple[str, ...]
    suffixes: tuple[str, ...]


_FORMATS = {
    "opencv": _Format(write_open_cv, OpenCv, ("b2",), (".yml", ".yaml", ".json")),
    "colmap": _Format(write_colmap, OpenCv, ("b2",), ()),
    "agisoft": _Format(write_agisoft, Agisoft, ("p3", "p4"), (".xml",)),
    "smac": _Format(write_smac_report, Smac, (), (".txt", ".rpt")),
    "block": _Format(write_block_camera, None, (), (".toml",)),
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
) -> Conversion:
    """Write a camera in one of `CAMERA_FORMATS`, and say by how much the file's camera differs from `interior`.

    `format` None: cameras.txt is COLMAP's, else the suffix tells. The distortion is converted exactly where its terms
    allow it, else fitted over the format (`camera.conversion`). `distortion` chooses the model in a block.toml.

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
    if distortion not in (None, known.distortion) and known.distortion is not None:
        raise InputError(
            f"{path}: the format {format} has the distortion {known.distortion.__name__}, not {distortion.__name__}; "
            "leave the distortion out, or write a .toml"
        )
    target = known.distortion or distortion or type(interior.distortion)
    try:
        conversion = converted(interior, target, sensor, known.lacks)
    except ValueError as error:
        raise InputError(f"{path} cannot be written: {error}") from None
    with whole_file(path) as work:
        known.write(work, name, sensor, conversion.interior)
    return conversion
