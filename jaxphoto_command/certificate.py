"""Provenance of results (hashes of inputs, conditions of photographs), certificates, and pairs of camera files."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxphoto.camera.conditions import Conditions
from jaxphoto.errors import InputError
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.camera_files import CameraFile, read_camera_file, results_in
from jaxphoto.io.conditions import CONDITIONS, conditions_of, marked, read_conditions, write_conditions
from jaxphoto.io.photographs import SUFFIXES, picture_files
from jaxphoto.io.result_tables import INPUTS, block_inputs, read_inputs, write_inputs
from jaxphoto.io.text_files import read_json
from jaxphoto.io.text_tables import read_csv
from jaxphoto.report.certificate import Certified, ExteriorCorrelation, FormatBand, LastCalibration, certificate_page
from jaxphoto.report.page import write_pdf
from jaxphoto.report.stability import Compared
from jaxphoto.writing import InputFile, input_file, whole_file

_MIN_CELLS = 4
# Files that identify the last calibration.
_CAMERA_FILES = ("interior.csv", "correlation.csv", "camera.toml", "block.toml")
_MEASUREMENTS = ("image_points.csv", *SUFFIXES)


def write_certificate(page: str, path: Path) -> None:
    """Write HTML or, printed by a browser, PDF."""
    with whole_file(path) as work:
        if path.suffix.lower() == ".pdf":
            write_pdf(page, work)
        else:
            work.write_text(page, encoding="utf-8")


def certificate_document(
    folder: Path,
    camera: str | None = None,
    last: Path | None = None,
    halves: Path | None = None,
    photographs: list[Path] | None = None,
) -> str:
    """Return the certificate of a folder of results; for a flight, of its largest part.

    Raises InputError if there are no results or the adjustment did not converge.
    """
    folder = results_in(folder)
    if not (folder / "interior.csv").is_file():
        raise InputError(f"{folder} holds no interior.csv: name a folder that jaxphoto adjust or fly wrote")
    file = read_camera_file(folder, camera=camera)
    conditions: list[Conditions] = []
    inputs: list[InputFile] = []
    if photographs:
        conditions = [conditions_of(path) for path in picture_files(photographs)]
        inputs = [input_file(path) for path in picture_files(photographs)]
    elif (folder / CONDITIONS).is_file():
        conditions = read_conditions(folder / CONDITIONS)
    if (folder / INPUTS).is_file():
        inputs += read_inputs(folder / INPUTS)
    return certificate_page(
        Certified(
            camera=file.name,
            sensor=file.sensor,
            interior=file.interior,
            covariance=file.covariance,
            summary=read_json(folder / "summary.json"),
            with_exterior=_exterior_correlations(folder, file.name),
            conditions=conditions,
            inputs=inputs,
            all_inputs=(folder / INPUTS).is_file(),
            last=_last_calibration(file, folder, last) if last else None,
            band=_format_band(halves) if halves else None,
        )
    )


def _exterior_correlations(folder: Path, camera: str) -> list[ExteriorCorrelation]:
    path = folder / "correlation_summary.csv"
    if not path.is_file():
        return []
    table = read_csv(path, ("camera", "exterior", "interior", "mean_abs_rho", "max_abs_rho"), text=("exterior",))
    rows = table.take(table.ids("camera") == camera)
    labels = (rows.ids(name).tolist() for name in ("exterior", "interior"))
    values = (rows.numbers(name).tolist() for name in ("mean_abs_rho", "max_abs_rho"))
    return [ExteriorCorrelation(*row) for row in zip(*labels, *values, strict=True)]


def _last_calibration(current: CameraFile, folder: Path, last: Path) -> LastCalibration:
    try:
        file = read_camera_file(last, camera=current.name)
    except InputError:
        # The only camera of the other file may have another name.
        file = read_camera_file(last)
    check_one_sensor(current, file, folder, last)
    inside = results_in(last)
    path = next((inside / name for name in _CAMERA_FILES if (inside / name).is_file()), last) if last.is_dir() else last
    shared = share_measurements(folder, last)
    return LastCalibration(last.name, file.interior, file.covariance, input_file(path, f"last/{path.name}"), shared)


def _format_band(folder: Path) -> FormatBand:
    path, summary = folder / "cells.csv", read_json(folder / "summary.json")
    columns = ("x_mm", "y_mm", "band_px")
    table = read_csv(path, columns, ("promised_px", "factor", "halves_px", "halves_band_px"))
    x, y, band = (table.numbers(name) for name in columns)
    factor, sigma = (summary.get(name) for name in ("factor", "sigma_factor"))
    if not all(isinstance(v, int | float) and math.isfinite(v) for v in (factor, sigma)) or len(band) < _MIN_CELLS:
        raise InputError(f"{folder} is no result of jaxphoto halves: name the folder that it wrote")
    return FormatBand(np.stack([x, y], axis=1), band, float(factor), float(sigma), input_file(path, "halves/cells.csv"))  # type: ignore[arg-type]


def read_two(
    paths: tuple[Path, Path], cameras: tuple[str | None, str | None], pixel_mm: float | None, block: Path | None
) -> tuple[CameraFile, CameraFile]:
    """Read camera files A and B of one sensor; the camera of B has the name of that of A by default."""
    names = (cameras[0], cameras[1] if cameras[1] is not None else cameras[0])
    a, b = (
        read_camera_file(path, camera=name, pixel_mm=pixel_mm, block=block)
        for path, name in zip(paths, names, strict=True)
    )
    check_one_sensor(a, b, *paths)
    return a, b


def compared(letter: str, path: Path, file: CameraFile) -> Compared:
    """Return a camera file with its label for tables and figures."""
    return Compared(f"{letter} ({path})", file.interior, file.covariance is not None, file.sensor)


def check_one_sensor(a: CameraFile, b: CameraFile, first: Path, second: Path) -> None:
    """Raise InputError if the image formats or pixel sizes of two camera files differ."""
    one, other = a.sensor, b.sensor
    if (one.width_px, one.height_px) != (other.width_px, other.height_px):
        raise InputError(
            f"{first} is of {one.width_px} x {one.height_px} px, {second} of {other.width_px} x {other.height_px} px; "
            "compare two sets of one camera"
        )
    if not math.isclose(one.pixel_mm, other.pixel_mm, rel_tol=1e-6):
        raise InputError(
            f"the pixel of {first} is {one.pixel_mm:g} mm, that of {second} {other.pixel_mm:g} mm. If one of them was "
            "assumed, give the true one by --pixel-mm. Results that state the assumed one must be written in pixels "
            "first: jaxphoto camera RESULTS --out pixels.yml"
        )


def check_two_calibrations(a: CameraFile, b: CameraFile, first: Path, second: Path) -> None:
    """Raise InputError if two camera files are identical."""
    if bool(eqx.tree_equal((a.interior, a.covariance), (b.interior, b.covariance))):
        raise InputError(f"{first} and {second} are one calibration; name one by other photographs")


def share_measurements(first: Path, second: Path) -> bool:
    """Return True if two folders of results are based on the same photograph or file of image points."""
    return not _measurements(first).isdisjoint(_measurements(second))


def _measurements(results: Path) -> set[str]:
    """Return the SHA-256 of photographs and files of image points of a folder of results."""
    inputs, conditions = (results_in(results) / name for name in (INPUTS, CONDITIONS))
    files = read_inputs(inputs) if inputs.is_file() else []
    photographs = read_conditions(conditions) if conditions.is_file() else []
    return {f.sha256 for f in files if f.file.lower().endswith(_MEASUREMENTS)} | {c.sha256 for c in photographs}


# Files read of a folder of results or of an experiment.
_READ = (".csv", ".json", ".toml", ".py")


def hashes(path: Path) -> Iterator[InputFile]:
    """Yield the hashes of a file, or of the input files of a folder."""
    if path.is_file():
        yield input_file(path)
    elif (path / TOML).is_file():
        yield from (f._replace(file=f"{path.name}/{f.file}") for f in block_inputs(path))
    else:
        files = (file for file in sorted(path.iterdir()) if file.suffix in _READ and not file.name.startswith("."))
        yield from (input_file(file, f"{path.name}/{file.name}") for file in files)


class Provenance(NamedTuple):
    """Input files of results, and the conditions of their photographs."""

    conditions: Sequence[Conditions]
    inputs: Sequence[InputFile]

    @classmethod
    def of(cls, photographs: Sequence[Path], others: Sequence[Path]) -> "Provenance":
        """Return the provenance of a flight; `others` are files of control and exposures."""
        conditions = [conditions_of(path) for path in photographs]
        return cls(conditions, [*_photograph_hashes(conditions, photographs), *map(input_file, others)])

    @classmethod
    def of_block(cls, block: Path, others: Sequence[Path] = (), photographs: Sequence[Path] = ()) -> "Provenance":
        """Return the provenance of a block folder, other files and photographs; it prefers the block's conditions."""
        inspected = [conditions_of(path) for path in photographs]
        conditions = read_conditions(block / CONDITIONS) if (block / CONDITIONS).is_file() else inspected
        return cls(
            conditions, [*block_inputs(block), *map(input_file, others), *_photograph_hashes(inspected, photographs)]
        )

    def conditions_for(self, images: Sequence[str]) -> list[Conditions]:
        """Return the conditions of all photographs, with `images` marked as used."""
        return marked(self.conditions, images)

    def write(self, images: Sequence[str], folder: Path) -> None:
        """Write inputs.csv, and conditions.csv if known, with `images` marked as used."""
        if self.conditions:
            write_conditions(self.conditions, folder, images)
        write_inputs(self.inputs, folder)


def certify(flight: Path) -> str:
    """Write certificate.html of the largest part of a flight, or return why not."""
    try:
        page = certificate_document(flight)
    except InputError as error:
        return str(error)
    write_certificate(page, flight / "certificate.html")
    return ""


def _photograph_hashes(conditions: Sequence[Conditions], photographs: Sequence[Path]) -> list[InputFile]:
    return [InputFile(c.file, path.stat().st_size, c.sha256) for c, path in zip(conditions, photographs, strict=True)]
