"""Provenance of results: input files with hashes, conditions of photographs, command and certificate."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from jaxphoto.camera.conditions import Conditions
from jaxphoto.errors import InputError
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.conditions import CONDITIONS, conditions_of, marked, read_conditions, write_conditions
from jaxphoto.io.input_hashes import block_inputs, write_inputs
from jaxphoto.writing import InputFile, input_file
from jaxphoto_command.certificate import certificate_document, write_certificate

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
