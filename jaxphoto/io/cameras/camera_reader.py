"""A camera file of any known format -> `CameraFile`."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.cameras import agisoft, colmap, kalibr, mrcal, open_cv, own_cameras, smac_report
from jaxphoto.io.cameras.camera_file import CameraFile, CameraSource
from jaxphoto.io.whole_text import SMALL, read_text


class _ReadFormat(NamedTuple):
    """What tells a format by name and content of a file, and its reader."""

    recognises: Callable[[Path, str], bool]
    read: Callable[[CameraSource], CameraFile]


_FORMATS = {
    "interior": _ReadFormat(lambda path, text: text.startswith("camera,parameter,value"), own_cameras.read_results),
    "block": _ReadFormat(lambda path, text: path.suffix == ".toml", own_cameras.read_block_camera),
    "agisoft": _ReadFormat(agisoft.recognises, agisoft.read_agisoft),
    "smac": _ReadFormat(smac_report.recognises, smac_report.read_smac_report),
    "colmap": _ReadFormat(colmap.recognises, colmap.read_colmap),
    "mrcal": _ReadFormat(mrcal.recognises, mrcal.read_mrcal),
    "kalibr": _ReadFormat(kalibr.recognises, kalibr.read_kalibr),
    "opencv": _ReadFormat(open_cv.recognises, open_cv.read_open_cv),
}
CAMERAS_READ = (
    "OpenCV's and ROS' YAML, COLMAP's cameras.txt, Agisoft's XML, mrcal's .cameramodel, Kalibr's camera chain, a "
    "SMAC report, interior.csv and block.toml"
)
"""The camera files that `read_camera_file` knows, in words."""
# In a folder, what its camera file is called.
_IN_FOLDER = (own_cameras.INTERIOR, TOML, own_cameras.CAMERA, colmap.TEXT, colmap.BINARY)


def is_camera_file(path: Path) -> bool:
    """Whether a file tells a camera of another program by its content."""
    try:
        text = read_text(path, SMALL)
    except InputError:
        return False
    return any(known.recognises(path, text) for name, known in _FORMATS.items() if name != "block")


def read_camera_file(
    path: str | Path,
    *,
    camera: str | None = None,
    pixel_mm: float | None = None,
    size_px: tuple[int, int] | None = None,
    block: str | Path | None = None,
) -> CameraFile:
    """The camera in a file of another program (docs/camera_files.md), or of jaxphoto itself.

    The format is told by the content. `path` may be a folder of results, of a flight, a block folder or a COLMAP model.
    `camera` names one where there are several; `pixel_mm` is the size of a pixel and `size_px` the width and height
    where the file does not give them; `block` is the block of which an interior.csv is, needed where results do not
    say it.

    Raises InputError for files that are missing, cut off or of no known format, for models that are not known here, for
    what is missing in a file and for a pixel that a file has otherwise.
    """
    path = Path(path)
    if path.is_dir():
        path = own_cameras.results_in(path)
        inside = [path / name for name in _IN_FOLDER if (path / name).is_file()]
        if not inside:
            raise InputError(f"{path} holds none of {', '.join(_IN_FOLDER)}; name the camera file")
        path = inside[0]
    if not path.is_file():
        raise InputError(f"there is no file {path}; correct the name")
    source = CameraSource(path, camera, pixel_mm, size_px, Path(block) if block is not None else None)
    text = "" if path.name == colmap.BINARY else source.text()
    for known in _FORMATS.values():
        if known.recognises(path, text):
            found = known.read(source)
            if pixel_mm is not None and not math.isclose(found.sensor.pixel_mm, pixel_mm, rel_tol=1e-6):
                raise source.error(
                    f"it says itself that a pixel is {found.sensor.pixel_mm:g} mm, not {pixel_mm:g}: leave --pixel-mm "
                    "out, or, where that was assumed, make a file of pixels of it first: jaxphoto camera "
                    f"{quoted(str(path))} --out pixels.yml"
                )
            return found
    if not text.strip():
        raise source.error("the file is empty; write it anew")
    raise source.error(f"this is no camera file that is known; {CAMERAS_READ} are")
