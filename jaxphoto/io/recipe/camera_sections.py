"""Cameras that change, in a recipe: [camera_rates], [thermal_rates] and the temperature that they go with."""

from collections.abc import Iterable

from jaxphoto.camera import RATES, ThermalRates
from jaxphoto.io.block_folder.declared_unknowns import keys_of, read_parameters
from jaxphoto.io.block_folder.section import Section
from jaxphoto.parameters import AbstractParameters
from jaxphoto.simulation import Cooling, SimulatedChange

CHANGES: dict[str, type[AbstractParameters]] = {kind.kind: kind for kind in RATES}
"""What may change cameras, by the names of their tables."""


def read_changes(top: Section, cameras: Iterable[str]) -> dict[str, dict[str, SimulatedChange]]:
    """By kind and owner, what truly changes, and what the block knows of it. Raises InputError."""
    changes = {name: _changes(kind, top.section(name), tuple(cameras)) for name, kind in CHANGES.items() if name in top}
    if ThermalRates.kind in changes and "temperature" not in top:
        raise top.error(ThermalRates.kind, "the recipe says nothing of the temperature; add a table [temperature]")
    return {name: owners for name, owners in changes.items() if owners}


def _changes(kind: type[AbstractParameters], section: Section, owners: tuple[str, ...]) -> dict[str, SimulatedChange]:
    """Of a table that holds nothing but a `truth` the block's model does not know."""
    section.known("default", *owners)
    keys, changes = [key.start for key in keys_of(kind)], {}
    for name in owners:
        key = name if name in section else "default"
        if key not in section:
            continue
        own = section.section(key)
        truth, told = own.section("truth"), {word: v for word, v in own.values.items() if word != "truth"}
        truth.known(*keys)
        start, prior = read_parameters(kind, Section(own.file, own.path, told))
        true = {word: v for word, v in told.items() if word in keys} | dict(truth.values)
        changes[name] = SimulatedChange(
            read_parameters(kind, Section(truth.file, truth.path, true))[0], (start, prior) if told else None
        )
    return changes


def read_temperature(top: Section) -> Cooling | None:
    """[temperature]. Raises InputError for what cannot be."""
    if "temperature" not in top:
        return None
    section = top.section("temperature")
    section.known("begin_c", "air_c", "time_constant_s", "reference_c")
    air, begin = section.number("air_c"), section.number("begin_c")
    return Cooling(begin, air, section.positive("time_constant_s"), section.number("reference_c", air))


def refuse_changes(top: Section) -> None:
    """Raise InputError where cameras are to change in a set of images that has no times."""
    for key in (*CHANGES, "temperature"):
        if key in top:
            raise top.error(key, "a convergent set has no times that a camera could change in; remove the table")
