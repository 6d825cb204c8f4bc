"""What results tell of where they come from: inputs with hashes, conditions, options, certificate."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxphoto.camera.conditions import Conditions
from jaxphoto.cli.certificate import certificate_document, write_certificate
from jaxphoto.errors import InputError
from jaxphoto.io.conditions import CONDITIONS, conditions_of, marked, read_conditions, write_conditions
from jaxphoto.io.input_hashes import block_inputs, write_inputs
from jaxphoto.writing.inputs import InputFile, input_file

CERTIFICATE = "certificate"


class Provenance(NamedTuple):
    """The files that results were made of, how their photographs were taken, and the options."""

    conditions: Sequence[Conditions]
    inputs: Sequence[InputFile]
    told: Mapping[str, Any]

    @classmethod
    def of(cls, photographs: Sequence[Path], others: Sequence[Path], options: Mapping[str, Any]) -> "Provenance":
        """A flight by what the files of `photographs` say; `others` are the files of control and of exposures."""
        conditions = [conditions_of(path) for path in photographs]
        inputs = [*_files(conditions, photographs), *map(input_file, others)]
        return cls(conditions, inputs, {"method": {"command": "fly", **options}})

    @classmethod
    def of_block(
        cls,
        command: str,
        block: Path,
        options: Mapping[str, Any],
        others: Sequence[Path] = (),
        photographs: Sequence[Path] = (),
    ) -> "Provenance":
        """What is computed by `command` from a block folder, files besides, and photographs looked at anew.

        Conditions are those that the block folder has, else those of the `photographs`.
        """
        looked_at = [conditions_of(path) for path in photographs]
        kept = block / CONDITIONS
        conditions = read_conditions(kept) if kept.is_file() else looked_at
        inputs = [*block_inputs(block), *map(input_file, others)]
        inputs += _files(looked_at, photographs)
        return cls(conditions, inputs, {"method": {"command": command, **options}})

    def conditions_for(self, images: Sequence[str]) -> list[Conditions]:
        """The conditions of all photographs, those of `images` marked as used."""
        return marked(self.conditions, images)

    def write(self, images: Sequence[str], folder: Path) -> None:
        """inputs.csv, and conditions.csv of all photographs where they are known, those of `images` marked as used."""
        if self.conditions:
            write_conditions(self.conditions, folder, images)
        write_inputs(self.inputs, folder)

    def certify(self, flight: Path) -> str:
        """Write certificate.html of the largest part, or return why there is none."""
        try:
            document = certificate_document(flight)
        except InputError as error:
            return str(error)
        write_certificate(document, (flight / CERTIFICATE).with_suffix(".html"))
        return ""


def _files(conditions: Sequence[Conditions], photographs: Sequence[Path]) -> list[InputFile]:
    return [InputFile(c.file, path.stat().st_size, c.sha256) for c, path in zip(conditions, photographs, strict=True)]
