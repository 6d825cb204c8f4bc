"""Provenance of results (hashes of inputs, conditions of photographs), certificates, pairs of camera files."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import pandas as pd

from jaxphoto.camera.conditions import Conditions
from jaxphoto.errors import InputError
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.camera_files import CameraFile, read_camera_file, results_in
from jaxphoto.io.conditions import CONDITIONS, conditions_of, marked, read_conditions, write_conditions
from jaxphoto.io.photographs import SUFFIXES, picture_files
from jaxphoto.io.result_tables import INPUTS, block_inputs, read_inputs, write_inputs
from jaxphoto.io.text_files import read_json
from jaxphoto.report.certificate import Certified, certificate_page
from jaxphoto.report.page import write_pdf
from jaxphoto.report.stability import Compared
from jaxphoto.writing import InputFile, input_file, whole_file

_MEASUREMENTS = ("image_points.csv", *SUFFIXES)


def write_certificate(page: str, path: Path) -> None:
    """Write the certificate as HTML, or as PDF printed by a browser."""
    with whole_file(path) as work:
        if path.suffix.lower() == ".pdf":
            write_pdf(page, work)
        else:
            work.write_text(page, encoding="utf-8")


def certificate_document(
    folder: Path,
    camera: str | None = None,
    photographs: list[Path] | None = None,
) -> str:
    """Return the certificate of a result folder; for a flight, of its largest part.

    Raises InputError if there are no results or the adjustment did not converge.
    """
    folder = results_in(folder)
    if not (folder / "interior.csv").is_file():
        raise InputError(f"{folder}: interior.csv not found; give a result folder of jaxphoto adjust or fly")
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
    path = folder / "correlation_summary.csv"
    correlations = pd.read_csv(path) if path.is_file() else pd.DataFrame({"camera": []})
    return certificate_page(
        Certified(
            camera=file.name,
            sensor=file.sensor,
            interior=file.interior,
            covariance=file.covariance,
            summary=read_json(folder / "summary.json"),
            with_exterior=correlations[correlations["camera"].astype(str) == file.name],
            conditions=conditions,
            inputs=inputs,
            all_inputs=(folder / INPUTS).is_file(),
        )
    )


def read_two(
    paths: tuple[Path, Path], cameras: tuple[str | None, str | None], pixel_mm: float | None, block: Path | None
) -> tuple[CameraFile, CameraFile]:
    """Read camera files A and B of one sensor. The default name of the camera in B is its name in A."""
    names = (cameras[0], cameras[1] if cameras[1] is not None else cameras[0])
    a, b = (
        read_camera_file(path, camera=name, pixel_mm=pixel_mm, block=block)
        for path, name in zip(paths, names, strict=True)
    )
    check_one_sensor(a, b, *paths)
    return a, b


def compared(letter: str, path: Path, file: CameraFile) -> Compared:
    """Label a camera file for tables and figures."""
    return Compared(f"{letter} ({path})", file.interior, file.covariance is not None, file.sensor)


def check_one_sensor(a: CameraFile, b: CameraFile, first: Path, second: Path) -> None:
    """Raise InputError if the image formats or pixel sizes of two camera files differ."""
    one, other = a.sensor, b.sensor
    if (one.width_px, one.height_px) != (other.width_px, other.height_px):
        raise InputError(
            f"image sizes differ: {first} {one.width_px} x {one.height_px} px, {second} {other.width_px} x "
            f"{other.height_px} px; compare two calibrations of one camera"
        )
    if not math.isclose(one.pixel_mm, other.pixel_mm, rel_tol=1e-6):
        raise InputError(
            f"pixel sizes differ: {first} {one.pixel_mm:g} mm, {second} {other.pixel_mm:g} mm; if one is assumed, give "
            "the true size with --pixel-mm (convert its results to pixels first: jaxphoto camera RESULTS --out "
            "pixels.yml)"
        )


def check_two_calibrations(a: CameraFile, b: CameraFile, first: Path, second: Path) -> None:
    """Raise InputError if two camera files are identical."""
    if bool(eqx.tree_equal((a.interior, a.covariance), (b.interior, b.covariance))):
        raise InputError(f"{first} and {second} are the same calibration; give one from other photographs")


def share_measurements(first: Path, second: Path) -> bool:
    """Return True if two result folders are based on the same photograph or file of image points."""
    return not _measurements(first).isdisjoint(_measurements(second))


def _measurements(results: Path) -> set[str]:
    """Return the SHA-256 of the photographs and files of image points of a result folder."""
    inputs, conditions = (results_in(results) / name for name in (INPUTS, CONDITIONS))
    files = read_inputs(inputs) if inputs.is_file() else []
    photographs = read_conditions(conditions) if conditions.is_file() else []
    return {f.sha256 for f in files if f.file.lower().endswith(_MEASUREMENTS)} | {c.sha256 for c in photographs}


# Suffixes of the hashed files of a result folder or an experiment.
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
        """Return the provenance of a flight. `others`: files of control and exposures."""
        conditions = [conditions_of(path) for path in photographs]
        return cls(conditions, [*_photograph_hashes(conditions, photographs), *map(input_file, others)])

    @classmethod
    def of_block(cls, block: Path, others: Sequence[Path] = (), photographs: Sequence[Path] = ()) -> "Provenance":
        """Return the provenance of a block folder, other files and photographs.

        Conditions of the block folder take precedence over the photographs.
        """
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
    """Write certificate.html of the largest part of a flight. Return "", or the reason for a missing certificate."""
    try:
        page = certificate_document(flight)
    except InputError as error:
        return str(error)
    write_certificate(page, flight / "certificate.html")
    return ""


def _photograph_hashes(conditions: Sequence[Conditions], photographs: Sequence[Path]) -> list[InputFile]:
    return [InputFile(c.file, path.stat().st_size, c.sha256) for c, path in zip(conditions, photographs, strict=True)]
