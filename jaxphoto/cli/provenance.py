"""What a flight's results tell of where they come from: photographs with hashes, conditions, options, certificate."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxphoto.camera.conditions import Conditions
from jaxphoto.cli.certificate import certificate_document, write_certificate
from jaxphoto.errors import InputError
from jaxphoto.io.conditions import conditions_of, marked, write_conditions
from jaxphoto.io.input_hashes import write_inputs
from jaxphoto.procedures.flight import FlightPart
from jaxphoto.writing.inputs import InputFile, input_file

CERTIFICATE = "certificate"


class Provenance(NamedTuple):
    """The photographs of a flight and the options it was computed with."""

    conditions: Sequence[Conditions]
    inputs: Sequence[InputFile]
    told: Mapping[str, Any]

    @classmethod
    def of(cls, photographs: Sequence[Path], others: Sequence[Path], options: Mapping[str, Any]) -> "Provenance":
        """What the files of `photographs` say; `others` are the files of control and of exposures."""
        conditions = [conditions_of(path) for path in photographs]
        inputs = [
            InputFile(c.file, path.stat().st_size, c.sha256) for c, path in zip(conditions, photographs, strict=True)
        ]
        inputs += [input_file(path) for path in others]
        return cls(conditions, inputs, {"method": {"command": "fly", **options}})

    def conditions_for(self, part: FlightPart) -> list[Conditions]:
        """The conditions of all photographs, those of `part` marked as used."""
        return marked(self.conditions, part.adjusted.block.images)

    def write(self, part: FlightPart, folder: Path) -> None:
        """conditions.csv and inputs.csv of all photographs, those of `part` marked as used."""
        write_conditions(self.conditions, folder, part.adjusted.block.images)
        write_inputs(self.inputs, folder)

    def certify(self, flight: Path) -> str:
        """certificate.html and certificate.pdf of the largest part, or why there is none."""
        try:
            document = certificate_document(flight)
        except InputError as error:
            return str(error)
        for suffix in (".html", ".pdf"):
            write_certificate(document, (flight / CERTIFICATE).with_suffix(suffix))
        return ""
