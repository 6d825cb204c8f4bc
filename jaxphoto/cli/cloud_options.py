"""What every command says of the cloud it reads."""

from typing import Annotated

import typer

from jaxphoto.errors import InputError

Classes = Annotated[str | None, typer.Option("--class", help="Classes to take, by commas: 2,6.")]
ReturnsOption = Annotated[str, typer.Option("--returns", help="Returns to take: all, first, last, only.")]
CloudEpsg = Annotated[int | None, typer.Option(help="EPSG code of the cloud, in place of what it says.")]
CloudUnit = Annotated[str | None, typer.Option(help="What the cloud counts in: m, ft, us_ft.")]


def class_numbers(text: str | None) -> list[int] | None:
    """The numbers in "2,6"; None for all classes. Raises InputError for anything else."""
    if text is None:
        return None
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdigit() for part in parts):
        raise InputError(f"--class {text}: give numbers of classes by commas, like 2,6")
    return [int(part) for part in parts]
