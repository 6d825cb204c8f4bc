"""What a command tells its report of how the results came about."""

import shlex
from collections.abc import Iterator
from pathlib import Path

import typer

from jaxphoto.cli.output import OF_OUTPUT
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.input_hashes import block_inputs
from jaxphoto.report.page import Made
from jaxphoto.writing.inputs import InputFile, input_file

# Of a folder of results or of an experiment, what is read.
_READ = (".csv", ".json", ".toml", ".py")


def made_by(context: typer.Context, *inputs: Path | None) -> Made:
    """The command with its options, and the hashes of the files and folders that it reads, as they are now."""
    given = [path for path in inputs if path is not None]
    return Made(typed(context), [f for path in given for f in _files(path)])


def typed(context: typer.Context) -> str:
    """The command as it is typed, with all options, defaults too; where results lie is not how they were made."""
    words = ["jaxphoto", str(context.info_name)]
    for parameter in context.command.params:
        value = context.params.get(str(parameter.name))
        # An empty word that is the default says nothing.
        empty = value == "" and not parameter.default
        if parameter.name in ("out", *OF_OUTPUT) or value is None or value is False or empty:
            continue
        values = [] if value is True else list(value) if isinstance(value, list | tuple) else [value]
        if parameter.param_type_name == "argument":
            words += map(str, values)
        elif value is True or parameter.nargs > 1:
            words += [parameter.opts[0], *map(str, values)]
        else:
            words += (word for v in values for word in (parameter.opts[0], str(v)))
    return shlex.join(words)


def _files(path: Path) -> Iterator[InputFile]:
    if path.is_file():
        yield input_file(path)
    elif (path / TOML).is_file():
        yield from (f._replace(file=f"{path.name}/{f.file}") for f in block_inputs(path))
    else:
        files = (file for file in sorted(path.iterdir()) if file.suffix in _READ and not file.name.startswith("."))
        yield from (input_file(file, f"{path.name}/{file.name}") for file in files)
