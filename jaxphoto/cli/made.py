"""What a command tells its report of how the results came about."""

from collections.abc import Iterator
from pathlib import Path

import typer

from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.input_hashes import block_inputs
from jaxphoto.report.made import Made
from jaxphoto.writing.inputs import InputFile, input_file

# Of a folder of results, what is read again.
_READ = (".csv", ".json", ".toml")


def made_by(context: typer.Context, *inputs: Path | None) -> Made:
    """The command with its options, and the hashes of the files and folders that it reads, as they are now."""
    given = [path for path in inputs if path is not None]
    # Where results lie is not how they were made.
    options = {name: value for name, value in context.params.items() if name != "out"}
    return Made(str(context.info_name), options, [f for path in given for f in _files(path)])


def _files(path: Path) -> Iterator[InputFile]:
    if path.is_file():
        yield input_file(path)
    elif (path / TOML).is_file():
        yield from (f._replace(file=f"{path.name}/{f.file}") for f in block_inputs(path))
    else:
        files = (file for file in sorted(path.iterdir()) if file.suffix in _READ and not file.name.startswith("."))
        yield from (input_file(file, f"{path.name}/{file.name}") for file in files)
