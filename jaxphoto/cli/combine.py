"""`jaxphoto combine`: several calibrations in, one with covariance out, and whether they agree."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.two_cameras import check_one_sensor
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import write_camera_file
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.stability import combine
from jaxphoto.stability.analysis import SIGNIFICANT_P
from jaxphoto.writing import check_file


@command("combine")
def combine_command(
    output: Output,
    calibrations: Annotated[list[Path], typer.Argument(help="Results or camera files with a covariance.")],
    out: Annotated[Path, typer.Option(help="Camera file (.toml) to write, a prior for blocks.")],
    camera: Annotated[str | None, typer.Option(help="Which camera, where a file holds several.")] = None,
) -> None:
    """Combine calibrations of one camera by their full covariances. Exit code 1: written, but they do not agree."""
    if out.suffix != ".toml":
        raise InputError(f"--out {out}: only a .toml has a place for the covariance; name it so")
    check_file(out, *calibrations)
    read = [read_camera_file(path, camera=camera) for path in calibrations]
    names = [str(path) for path in calibrations]
    covariances: list[np.ndarray] = []
    for name, file in zip(names, read, strict=True):
        check_one_sensor(read[0], file, calibrations[0], Path(name))
        if file.covariance is None:
            raise InputError(f"{name} has no covariance; give results of jaxphoto adjust, or a camera file of them")
        covariances.append(file.covariance)
        if file.note:
            output.warn(f"{name}: {file.note}")
    done = combine([file.interior for file in read], covariances, names)
    write_camera_file(
        out,
        read[0].sensor,
        done.interior,
        "block",
        name=read[0].name,
        covariance=done.covariance,
        reservation="; ".join(f"{name}: {file.note}" for name, file in zip(names, read, strict=True) if file.note),
    )
    for parameter, variance in zip(parameter_names(done.interior), np.diagonal(done.covariance), strict=True):
        if variance > 0:
            value = float(get_parameter(done.interior, parameter))
            output.say(f"  {parameter} = {value:.9g} +- {variance**0.5:.2g}")
    agree = done.p_value >= SIGNIFICANT_P
    said = "they agree" if agree else "they do NOT agree: the camera has changed, or their covariances are too small"
    output.say(f"chi-square {done.chi_square:.1f} of {done.degrees_of_freedom}, p = {done.p_value:.2g}: {said}")
    for k, (name, p) in enumerate(zip(names, done.against_others, strict=True)):
        apart = ": it disagrees" if len(names) > 2 and k in done.disagreeing(SIGNIFICANT_P) else ""
        output.say(f"  {name} against the others: p = {p:.2g}{apart}")
    output.wrote(out, f"wrote {out}")
    output.tell(agree=agree, chi_square=done.chi_square, degrees_of_freedom=done.degrees_of_freedom)
    output.tell(p_value=done.p_value, p_against_others=dict(zip(names, done.against_others, strict=True)))
    if not agree:
        raise typer.Exit(1)
