"""What every command says of the cloud it reads."""

from pathlib import Path
from typing import Annotated, get_args

import typer

from jaxphoto.cli.choices import one_of
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_reader import Returns
from jaxphoto.io.clouds.coordinate_system import UNITS

Classes = Annotated[str | None, typer.Option("--class", help="Classes to take, by commas: 2,6.")]
ReturnsOption = Annotated[Returns, one_of(get_args(Returns), "--returns", help="Returns to take.")]
CloudEpsg = Annotated[int | None, typer.Option(help="EPSG code of the cloud, in place of what it says.")]
CloudUnit = Annotated[str | None, one_of(UNITS, help="What the cloud counts in.")]


def class_numbers(text: str | None) -> list[int] | None:
    """The numbers in "2,6"; None for all classes. Raises InputError for anything else."""
    if text is None:
        return None
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdigit() for part in parts):
        raise InputError(f"--class {text}: give numbers of classes by commas, like 2,6")
    return [int(part) for part in parts]


def corrected_name(cloud: Path) -> str:
    """File name of a corrected cloud: that of LAS and LAZ, which keep all other dimensions; COPC becomes LAZ."""
    if cloud.name.lower().endswith(".copc.laz"):
        return f"{cloud.name[: -len('.copc.laz')]}.laz"
    return cloud.name if cloud.suffix.lower() in (".las", ".laz") else f"corrected_{cloud.name}"
