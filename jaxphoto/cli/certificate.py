"""`jaxphoto certificate`: a calibration as a document to sign, from a folder of results."""

import math
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from jaxphoto.camera.conditions import Conditions
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.two_cameras import check_one_sensor, share_measurements
from jaxphoto.errors import InputError
from jaxphoto.io.cameras import CameraFile, read_camera_file
from jaxphoto.io.cameras.own_cameras import results_in
from jaxphoto.io.conditions import CONDITIONS, conditions_of, read_conditions
from jaxphoto.io.input_hashes import INPUTS, read_inputs
from jaxphoto.io.json_file import read_json
from jaxphoto.io.results_judged import read_summary, reservation
from jaxphoto.io.sound_photographs import pictures_in
from jaxphoto.io.text_tables import read_csv
from jaxphoto.report.certificate import (
    Certified,
    ExteriorCorrelation,
    FormatBand,
    LastCalibration,
    certificate_page,
)
from jaxphoto.report.page import write_pdf
from jaxphoto.writing import check_room, whole_file
from jaxphoto.writing.inputs import InputFile, input_file

_SUFFIXES = (".html", ".pdf")
# Of a map over the format.
_LEAST_CELLS = 4
# What a last calibration is read from, and named by.
_OF_CAMERA = ("interior.csv", "correlation.csv", "camera.toml", "block.toml")


@command("certificate")
def certificate_command(
    output: Output,
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="Folder of results of adjust or fly.")],
    out: Annotated[Path, typer.Option(help="The certificate: a file that ends in .html or .pdf; replaced if there.")],
    last: Annotated[
        Path | None, typer.Option(help="The last calibration: results or a camera file, to tell whether it changed.")
    ] = None,
    halves: Annotated[Path | None, typer.Option(help="Results of jaxphoto halves on the block, for its band.")] = None,
    photographs: Annotated[
        list[Path] | None, typer.Option(help="Photographs, or folders of them, where the results name none.")
    ] = None,
    camera: Annotated[str | None, typer.Option(help="Which camera, where there are several.")] = None,
) -> None:
    """Write the certificate of a calibration: what was found, how sure it is, and of which inputs."""
    if out.suffix.lower() not in _SUFFIXES:
        raise InputError(f"--out {out}: name a file that ends in {' or '.join(_SUFFIXES)}")
    check_room(out)
    with output.progress.status(f"writing {out}"):
        document = certificate_document(results, camera, last, halves, photographs or [])
        write_certificate(document, out)
    if against := reservation(read_summary(results)):
        output.warn(against)
    output.wrote(out, f"certificate in {out}")


def write_certificate(document: str, path: Path) -> None:
    """Write it as HTML or, printed by a browser, as PDF."""
    with whole_file(path) as work:
        if path.suffix.lower() == ".pdf":
            write_pdf(document, work)
        else:
            work.write_text(document, encoding="utf-8")


def certificate_document(
    folder: Path,
    camera: str | None = None,
    last: Path | None = None,
    halves: Path | None = None,
    photographs: list[Path] | None = None,
) -> str:
    """The certificate of a folder of results; of a flight, that of its largest part.

    Raises InputError for a folder that holds none, and for an adjustment that did not converge.
    """
    folder = results_in(folder)
    if not (folder / "interior.csv").is_file():
        raise InputError(f"{folder} holds no interior.csv: name a folder that jaxphoto adjust or fly wrote")
    file = read_camera_file(folder, camera=camera)
    conditions: list[Conditions] = []
    inputs: list[InputFile] = []
    if photographs:
        conditions = [conditions_of(path) for path in pictures_in(photographs)]
        inputs = [input_file(path) for path in pictures_in(photographs)]
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
            with_exterior=_with_exterior(folder, file.name),
            conditions=conditions,
            inputs=inputs,
            all_inputs=(folder / INPUTS).is_file(),
            last=_last(file, folder, last) if last else None,
            band=_band(halves) if halves else None,
        )
    )


def _with_exterior(folder: Path, camera: str) -> list[ExteriorCorrelation]:
    path = folder / "correlation_summary.csv"
    if not path.is_file():
        return []
    table = read_csv(path, ("camera", "exterior", "interior", "mean_abs_rho", "max_abs_rho"), text=("exterior",))
    own = table.take(table.ids("camera") == camera)
    mean, largest = own.numbers("mean_abs_rho").tolist(), own.numbers("max_abs_rho").tolist()
    names = own.ids("exterior").tolist(), own.ids("interior").tolist()
    return [ExteriorCorrelation(*row) for row in zip(*names, mean, largest, strict=True)]


def _last(this: CameraFile, folder: Path, last: Path) -> LastCalibration:
    try:
        file = read_camera_file(last, camera=this.name)
    except InputError:
        # The one camera of the other file, whatever it is called there.
        file = read_camera_file(last)
    check_one_sensor(this, file, folder, last)
    inside = results_in(last)
    path = next((inside / name for name in _OF_CAMERA if (inside / name).is_file()), last) if last.is_dir() else last
    shared = share_measurements(folder, last)
    return LastCalibration(last.name, file.interior, file.covariance, input_file(path, f"last/{path.name}"), shared)


def _band(folder: Path) -> FormatBand:
    path, summary = folder / "cells.csv", read_json(folder / "summary.json")
    columns = ("x_mm", "y_mm", "band_px")
    table = read_csv(path, columns, ("promised_px", "factor", "halves_px", "halves_band_px"))
    x, y, band = (table.numbers(name) for name in columns)
    factor, sigma = (summary.get(name) for name in ("factor", "sigma_factor"))
    if not all(isinstance(v, int | float) and math.isfinite(v) for v in (factor, sigma)) or len(band) < _LEAST_CELLS:
        raise InputError(f"{folder} is no result of jaxphoto halves: name the folder that it wrote")
    return FormatBand(np.stack([x, y], axis=1), band, float(factor), float(sigma), input_file(path, "halves/cells.csv"))  # type: ignore[arg-type]
