"""Camera files that are compared or combined: of one format and one size of pixel."""

import math
from pathlib import Path

import equinox as eqx

from jaxphoto.errors import InputError
from jaxphoto.io.camera_files import CameraFile, read_camera_file, results_in
from jaxphoto.io.conditions import CONDITIONS, read_conditions
from jaxphoto.io.input_hashes import INPUTS, read_inputs
from jaxphoto.io.sound_photographs import SUFFIXES
from jaxphoto.report.stability import Compared

_MEASURED = ("image_points.csv", *SUFFIXES)


def read_two(
    paths: tuple[Path, Path], cameras: tuple[str | None, str | None], pixel_mm: float | None, block: Path | None
) -> tuple[CameraFile, CameraFile]:
    """A and B; the camera of B is called as that of A where it has no other name. Raises what the reader raises."""
    names = (cameras[0], cameras[1] if cameras[1] is not None else cameras[0])
    a, b = (
        read_camera_file(path, camera=name, pixel_mm=pixel_mm, block=block)
        for path, name in zip(paths, names, strict=True)
    )
    check_one_sensor(a, b, *paths)
    return a, b


def compared(letter: str, path: Path, file: CameraFile) -> Compared:
    """What tables and pictures call a camera file."""
    return Compared(f"{letter} ({path})", file.interior, file.covariance is not None, file.sensor)


def check_two_calibrations(a: CameraFile, b: CameraFile, first: Path, second: Path) -> None:
    """Raise InputError where two camera files hold the same numbers: no test of two tells anything of one."""
    if bool(eqx.tree_equal((a.interior, a.covariance), (b.interior, b.covariance))):
        raise InputError(
            f"{first} and {second} are one calibration, which tells no change; name one by other photographs"
        )


def share_measurements(first: Path, second: Path) -> bool:
    """Whether two folders of results say that a photograph, or a file of image points, is the same."""
    return not _measured(first).isdisjoint(_measured(second))


def _measured(results: Path) -> set[str]:
    """SHA-256 of the photographs and files of image points that a folder of results names; none where it names none."""
    inputs, conditions = (results_in(results) / name for name in (INPUTS, CONDITIONS))
    read = read_inputs(inputs) if inputs.is_file() else []
    found = {f.sha256 for f in read if f.file.lower().endswith(_MEASURED)}
    # Of a block, whose inputs are its tables, these name the photographs behind them.
    return found | ({c.sha256 for c in read_conditions(conditions)} if conditions.is_file() else set())


def check_one_sensor(a: CameraFile, b: CameraFile, first: Path, second: Path) -> None:
    """Raise InputError where two camera files are of different formats or sizes of pixel."""
    one, other = a.sensor, b.sensor
    if (one.width_px, one.height_px) != (other.width_px, other.height_px):
        raise InputError(
            f"{first} is of {one.width_px} x {one.height_px} px, {second} of {other.width_px} x {other.height_px} px; "
            "compare two sets of one camera"
        )
    if not math.isclose(one.pixel_mm, other.pixel_mm, rel_tol=1e-6):
        raise InputError(
            f"the pixel of {first} is {one.pixel_mm:g} mm, that of {second} {other.pixel_mm:g} mm; where one of them "
            "was assumed, give the true one by --pixel-mm, and where results say the assumed one, make a file of "
            "pixels of them first: jaxphoto camera RESULTS --out pixels.yml"
        )
