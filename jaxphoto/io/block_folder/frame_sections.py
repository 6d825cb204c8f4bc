"""The [frame] and [corrections] tables of block.toml."""

import warnings
from typing import Any

from jaxphoto.block import Frame
from jaxphoto.errors import InputError, quoted
from jaxphoto.georeferencing import Corrections
from jaxphoto.georeferencing.map_frame import check_heights, map_system
from jaxphoto.io.block_folder.section import Section

_KINDS = ("local", "enu", "grid", "epsg")


def read_frame(section: Section) -> Frame:
    """The frame that a [frame] table describes; of kind epsg without an origin where the table gives none."""
    kind = section.text("kind", "local")
    if kind not in _KINDS:
        raise section.error("kind", f'{quoted(kind)} is no frame; write "local", "enu", "grid" or "epsg"')
    if kind != "epsg":
        section.known("kind")
        return Frame(kind)  # type: ignore[arg-type]
    section.known("kind", "code", "vertical", "yaw", "origin")
    code = section.count("code")
    try:
        system = map_system(code)
    except InputError as error:
        raise section.error("code", str(error)) from None
    vertical = section.values.get("vertical", "ellipsoidal")
    if "vertical" not in section:
        warnings.warn(
            f"{section.file}, [frame]: heights are taken as above the ellipsoid (GNSS); write "
            'vertical = "ellipsoidal", or the EPSG code of their system (5773 for EGM96) if they are not',
            UserWarning,
            stacklevel=2,
        )
    if vertical != "ellipsoidal":
        vertical = section.count("vertical")
        try:
            check_heights(code, vertical)
        except InputError as error:
            raise section.error("vertical", str(error)) from None
    yaw = section.text("yaw", "true")
    if yaw not in ("true", "grid"):
        raise section.error("yaw", f'{quoted(yaw)} is no north; write "true" or "grid"')
    origin = None
    if "origin" in section:
        longitude, latitude, height = section.vector("origin")
        if abs(longitude) > 360 or abs(latitude) > 90:
            raise section.error("origin", "this is no place; give [longitude, latitude, height] in degrees and metres")
        origin = (longitude, latitude, height)
    if yaw == "grid" and system.is_geographic:
        raise section.error("yaw", f'EPSG:{code} has no grid; write yaw = "true"')
    return Frame("epsg", code, None if vertical == "ellipsoidal" else vertical, yaw, origin)  # type: ignore[arg-type]


def frame_section(frame: Frame) -> dict[str, Any]:
    """The [frame] table that `read_frame` reads as `frame`."""
    if frame.kind != "epsg":
        return {"kind": frame.kind}
    vertical = "ellipsoidal" if frame.vertical is None else frame.vertical
    assert frame.origin is not None
    return {
        "kind": "epsg", "code": frame.code, "vertical": vertical, "yaw": frame.yaw, "origin": list(frame.origin),
    }  # fmt: skip


def read_corrections(section: Section, frame: Frame) -> Corrections:
    """The corrections that a [corrections] table switches on, if they are right in `frame`, which has its origin."""
    section.known("refraction", "curvature", "sea_level_m")
    refraction, curvature = (section.truth(key) for key in ("refraction", "curvature"))
    if curvature and frame.kind != "grid":
        raise section.error(
            "curvature",
            f'a frame of kind "{frame.kind}" is Cartesian, where the earth curves of itself; remove the key (only '
            'map-grid coordinates taken as they stand, kind = "grid", need it)',
        )
    if frame.kind == "epsg":
        if "sea_level_m" in section:
            raise section.error("sea_level_m", "a frame of kind epsg knows its heights; remove the key")
        return Corrections(refraction, curvature, frame.map.sea_level() if refraction else 0.0)
    if "sea_level_m" in section and not refraction:
        raise section.error("sea_level_m", "only refraction = true needs it; remove the key or switch refraction on")
    if refraction and frame.kind != "grid" and "sea_level_m" not in section:
        raise section.error(
            "sea_level_m",
            f'refraction depends on heights above the sea, which a frame of kind "{frame.kind}" does not know; give '
            "the Z of the sea",
        )
    return Corrections(refraction, curvature, section.number("sea_level_m", 0.0))


def corrections_section(corrections: Corrections, frame: Frame) -> dict[str, Any]:
    """The [corrections] table that `read_corrections` reads as `corrections`; empty where nothing is on."""
    written: dict[str, Any] = {name: True for name in ("refraction", "curvature") if getattr(corrections, name)}
    if corrections.refraction and frame.kind != "epsg":
        written["sea_level_m"] = corrections.sea_level_m
    return written
