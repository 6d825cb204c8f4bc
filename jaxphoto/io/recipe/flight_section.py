"""[flight] and its strips: heights, overlaps and headings -> `FlightPlan`."""

from collections.abc import Mapping
from typing import NamedTuple

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import quoted
from jaxphoto.georeferencing.mount import ImageX
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.recipe import sizes
from jaxphoto.io.recipe.keys import camera_of, tables
from jaxphoto.simulation import FlightPlan, Strip, footprint

# Two ways to say each; a strip's own word goes before the flight's.
_EITHER = {
    "height": ("height_m", "gsd_m"),
    "base": ("base_m", "forward_overlap_percent"),
    "spacing": ("spacing_m", "side_overlap_percent"),
}
_SHARED = tuple(key for pair in _EITHER.values() for key in pair)
_OWN = (
    "name", "camera", "heading_deg", "images", "count", "along_m", "across_m", "along_bases", "across_spacings",
)  # fmt: skip


class Mounted(NamedTuple):
    """A camera as a flight is planned for it."""

    sensor: Sensor
    interior: InteriorOrientation
    image_x: ImageX


def read_flight(section: Section, cameras: Mapping[str, Mounted]) -> FlightPlan:
    """The plan that [flight] describes. Raises InputError for what cannot be flown."""
    section.known(*_SHARED, "speed_m_per_s", "turn_s", "strips")
    for pair in _EITHER.values():
        _one_of(section, pair)
    listed = tables(section, "strips")
    if not listed:
        raise section.error("strips", "there is no strip; add a table [[flight.strips]]")
    strips: list[Strip] = []
    names: set[str] = set()
    for table in listed:
        for strip in _strips(table, section, cameras):
            if strip.name in names:
                raise table.error("name", f"there is another strip {strip.name}; give each its own name")
            names.add(strip.name)
            strips.append(strip)
        if sum(s.images for s in strips) > sizes.IMAGES:
            raise table.error("images", f"there are more than {sizes.IMAGES} images in all; give fewer")
    if sum(s.images for s in strips) < 2:
        raise section.error("strips", "there is one image in all, so no point is seen twice; add images or strips")
    speed = section.positive("speed_m_per_s") if "speed_m_per_s" in section else FlightPlan.speed_m_per_s
    turn = section.positive("turn_s") if "turn_s" in section else FlightPlan.turn_s
    return FlightPlan(tuple(strips), speed, turn)


def _strips(table: Section, flight: Section, cameras: Mapping[str, Mounted]) -> list[Strip]:
    """The parallel strips of one table, flown to and fro, from left to right of the first."""
    table.known(*_OWN, *_SHARED)
    name, heading = table.name("name"), table.number("heading_deg")
    if not name or name == "default":
        raise table.error("name", f"a strip cannot be called {quoted(name)}; give it another name")
    if abs(heading) > 360:
        raise table.error("heading_deg", f"{heading:g} is more than a turn; give degrees clockwise from north")
    camera = camera_of(table, cameras)
    sensor, interior, image_x = cameras[camera]
    c = float(interior.c)
    where, key = _said("height", table, flight)
    height = where.positive(key) * (1.0 if key == "height_m" else c / sensor.pixel_mm)
    ground = footprint(sensor, c, height, image_x)
    base = _step("base", table, flight, ground.along)
    count = table.count("count", sizes.IMAGES) if "count" in table else 1
    across = table.number("across_spacings", 0.0)
    spacing = _step("spacing", table, flight, ground.across) if count > 1 or across else 0.0
    along_m = table.number("along_m", 0.0) + table.number("along_bases", 0.0) * base
    strips = []
    for k in range(count):
        # Along and across are those of the first strip's heading, and change sign for those flown the other way.
        back = k % 2
        right = table.number("across_m", 0.0) + (across + k - (count - 1) / 2) * spacing
        strips.append(
            Strip(
                name=f"{name}{k + 1}" if count > 1 else name,
                camera=camera,
                heading_deg=heading + 180 * back,
                images=table.count("images", sizes.IMAGES),
                base_m=base,
                height_m=height,
                footprint=ground,
                along_m=-along_m if back else along_m,
                across_m=-right if back else right,
            )
        )
    return strips


def _said(what: str, table: Section, flight: Section) -> tuple[Section, str]:
    """Where one of the two keys stands: in the strip, or else in [flight]."""
    pair = _EITHER[what]
    for section in (table, flight):
        if key := _one_of(section, pair):
            return section, key
    raise flight.error("", f"the {what} is not given; add {pair[0]} or {pair[1]}")


def _one_of(section: Section, pair: tuple[str, str]) -> str | None:
    given = [key for key in pair if key in section]
    if len(given) > 1:
        raise section.error(pair[1], f"it stands beside {pair[0]}, which says the same; keep one of them")
    return given[0] if given else None


def _step(what: str, table: Section, flight: Section, footprint_m: float) -> float:
    """From one exposure or one strip to the next, in m."""
    section, key = _said(what, table, flight)
    if key.endswith("_m"):
        return section.positive(key)
    overlap = section.number(key)
    if not 0 <= overlap < 100:
        raise section.error(key, f"an overlap of {overlap:g} % cannot be flown; give 0 or more and less than 100")
    return (1 - overlap / 100) * footprint_m
