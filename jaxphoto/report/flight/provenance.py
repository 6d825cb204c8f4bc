"""Where the numbers of a flight come from: dates, camera, conditions, command, versions, hashes of all inputs."""

from collections.abc import Iterator

from jaxphoto.report.certificate_conditions import dates, told_conditions
from jaxphoto.report.document import Element, Heading, Paragraph, Rows
from jaxphoto.report.flight.source import FlightSource
from jaxphoto.report.made import option_word, versions
from jaxphoto.writing.inputs import digest_of_all


def provenance_section(source: FlightSource) -> Iterator[Element]:
    """Names and values, and the hash of every file that is no photograph."""
    yield Heading("Provenance")
    yield Rows(("", ""), tuple(_rows(source)))
    photographs = {c.file for c in source.conditions}
    if others := [f for f in source.inputs if f.file not in photographs]:
        yield Rows(
            ("file besides photographs", "bytes", "SHA-256"), tuple((f.file, str(f.n_bytes), f.sha256) for f in others)
        )
    if source.inputs:
        yield Paragraph(
            "result/inputs.csv has the SHA-256 of every file; where the calibration may be signed, certificate.html "
            "and certificate.pdf say what is to be signed. The same inputs, options and versions give the same numbers."
        )


def _rows(source: FlightSource) -> Iterator[tuple[str, str]]:
    if source.written:
        yield "computed", source.written
    if source.conditions:
        if any(c.time for c in source.conditions):
            yield "photographs taken", dates(source.conditions)
        for name, field in (("camera", "camera"), ("aircraft", "drone")):
            if said := ", ".join(dict.fromkeys(v for c in source.conditions if (v := getattr(c, field)))):
                yield name, said
        # What no photograph says is told in the certificate.
        yield from told_conditions(source.conditions)
    if source.command:
        yield "command", source.command
    method = {k: v for k, v in dict(source.told.get("method", {})).items() if k != "command" and v is not None}
    if method:
        yield "options as used", ", ".join(f"{k} {option_word(v)}" for k, v in method.items())
    yield "versions", ", ".join(f"{name} {number}" for name, number in versions().items())
    if source.inputs:
        yield f"SHA-256 of all {len(source.inputs)} inputs", digest_of_all(source.inputs)
