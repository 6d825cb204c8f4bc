"""Cameras that change, in a recipe: tables as those of [unknowns] with their truth, and temperature."""

from collections.abc import Sequence
from typing import Any

from jaxphoto.camera import RATES, CameraSpline, StripCamera, ThermalRates
from jaxphoto.georeferencing import RigCamera
from jaxphoto.io.block_folder.declared_unknowns import keys_of, read_parameters, static_fields
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.recipe.keys import not_negative
from jaxphoto.parameters import AbstractParameters, dynamic_fields
from jaxphoto.simulation import CameraWalk, Cooling, Sigmas, SimulatedChange
from jaxphoto.simulation.recipe import Triple
from jaxphoto.unknowns import FREE

_KINDS: tuple[type[AbstractParameters], ...] = (*RATES, CameraSpline, StripCamera)
CHANGES = {kind.kind: kind for kind in _KINDS}
"""What may change cameras, by the names of their tables."""
WALK = "camera_walk"
RIG = RigCamera.kind


def read_changes(top: Section, cameras: Sequence[str], strips: Sequence[str]) -> dict[str, dict[str, SimulatedChange]]:
    """By kind and owner, what truly changes, and what the block knows of it. Raises InputError."""
    owners = {"camera": cameras, "strip": strips}
    changes = {
        name: _changes(kind, top.section(name), owners[kind.owner]) for name, kind in CHANGES.items() if name in top
    }
    if ThermalRates.kind in changes and "temperature" not in top:
        raise top.error(ThermalRates.kind, "the recipe says nothing of the temperature; add a table [temperature]")
    if WALK in top and not changes.get(StripCamera.kind):
        raise top.error(WALK, "the cameras of strips walk, but there are none; add a table [strip_cameras.default]")
    return {name: owners for name, owners in changes.items() if owners}


def flown_cameras(top: Section, cameras: Sequence[str]) -> list[str]:
    """Those that are flown: all, or the one that the others sit beside in a rig. Raises InputError."""
    section = top.section(RIG)
    section.known(*cameras)
    flown = [name for name in cameras if name not in section]
    if section.values and len(flown) != 1:
        raise section.error("", "all cameras but one sit in a rig beside that one; give each of them a table")
    if section.values and "convergent" in top:
        raise top.error("convergent", "a rig is flown; remove the table, or that of the rig")
    return flown


def read_rig(top: Section, cameras: Sequence[str], stated: Sigmas) -> dict[str, SimulatedChange]:
    """[rig_cameras]: those that sit beside the one that is flown. Raises InputError for what cannot be."""
    if RIG in top and (stated.rig_place_m is None or stated.rig_turn_deg is None):
        raise top.section("sigmas").error("", "nothing says how rigid the rig is; add rig_place_m and rig_turn_deg")
    return _changes(RigCamera, top.section(RIG), cameras)


def _changes(kind: type[AbstractParameters], section: Section, owners: Sequence[str]) -> dict[str, SimulatedChange]:
    """Of a table that holds nothing but a `truth` the block's model does not know."""
    section.known("default", *owners)
    keys, static, changes = keys_of(kind), static_fields(kind), {}
    for name in owners:
        key = name if name in section else "default"
        if key not in section:
            continue
        own = section.section(key)
        truth, told = own.section("truth"), {word: v for word, v in own.values.items() if word != "truth"}
        # What the truth does not name is as the block says, but for what it does not know.
        same = {word: v for word, v in told.items() if word in static or word in [key.start for key in keys]}
        true, spread = read_parameters(kind, Section(truth.file, truth.path, same | dict(truth.values)))
        for field in dynamic_fields(kind):
            if getattr(spread, field) == FREE:
                raise truth.error(field, "what is true is not free; give its value, or the sigma that it is drawn by")
        model: Any = read_parameters(kind, Section(own.file, own.path, told)) if told else None
        changes[name] = SimulatedChange(true, spread, model)
    return changes


def read_walk(top: Section) -> CameraWalk | None:
    """[camera_walk]: how the cameras of strips walk. Raises InputError for what cannot be."""
    if WALK not in top:
        return None
    section = top.section(WALK)
    section.known("c_mm", "xp_mm", "yp_mm", "truth")
    truth = section.section("truth")
    truth.known("c_mm", "xp_mm", "yp_mm")
    told = set(section.values) - {"truth"}
    if told and not all(section.number(key, 0.0) > 0 for key in ("c_mm", "xp_mm", "yp_mm")):
        raise section.error("", "the steps of c, x_p and y_p are all observed; give c_mm, xp_mm and yp_mm above zero")
    stated = _three(section) if told else None
    return CameraWalk(_three(truth) if truth.values else stated or (0.0, 0.0, 0.0), stated)


def _three(section: Section) -> Triple:
    c, x_p, y_p = (not_negative(section, key, 0.0) for key in ("c_mm", "xp_mm", "yp_mm"))
    return c, x_p, y_p


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
    for key in (*CHANGES, "temperature", WALK):
        if key in top:
            raise top.error(key, "a convergent set has no times that a camera could change in; remove the table")
