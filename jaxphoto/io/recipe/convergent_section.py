"""[convergent] and its stations: distances, azimuths, tilts and rolls -> `ConvergentPlan`."""

import itertools
from collections.abc import Collection

from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.recipe import sizes
from jaxphoto.io.recipe.keys import camera_of, one_or_more, tables
from jaxphoto.simulation import ConvergentPlan, Field, Station


def read_convergent(section: Section, cameras: Collection[str]) -> ConvergentPlan:
    """The plan that [convergent] describes. Raises InputError for what cannot be photographed."""
    section.known("field_m", "stations")
    size = one_or_more(section, "field_m")
    if len(size) != 2 or min(size) <= 0:
        raise section.error("field_m", f"{list(size)} is no field; give its length along X and Y, like [1.2, 0.9]")
    stations: list[Station] = []
    names: set[str] = set()
    for table in tables(section, "stations"):
        name = table.name("name")
        if name in names:
            raise table.error("name", f"there are other stations {name}; give these another name")
        names.add(name)
        stations += _stations(name, table, cameras)
        if len(stations) > sizes.IMAGES:
            raise section.error("stations", f"there are more than {sizes.IMAGES} images in all; give fewer")
    if len(stations) < 2:
        raise section.error(
            "stations",
            f"there are {len(stations)} images in all, but a point is seen in 2; add [[convergent.stations]]",
        )
    return ConvergentPlan(tuple(stations), Field((size[0], size[1])))


def _stations(name: str, table: Section, cameras: Collection[str]) -> list[Station]:
    """Every distance of one table with every azimuth, tilt and roll."""
    table.known("name", "camera", "distance_m", "azimuth_deg", "tilt_deg", "roll_deg")
    camera = camera_of(table, cameras)
    distances, tilts = (one_or_more(table, key) for key in ("distance_m", "tilt_deg"))
    if min(distances) <= 0:
        raise table.error("distance_m", f"{min(distances):g} is not positive; give the true value")
    if min(tilts) < 0 or max(tilts) >= 90:
        raise table.error("tilt_deg", "a field is seen from tilts of 0 or more and less than 90; give one of these")
    azimuths, rolls = (one_or_more(table, key, 0.0) for key in ("azimuth_deg", "roll_deg"))
    n = len(distances) * len(azimuths) * len(tilts) * len(rolls)
    if n > sizes.IMAGES:
        raise table.error("", f"these are {n} images, the most are {sizes.IMAGES}; give fewer distances or angles")
    each = itertools.product(distances, azimuths, tilts, rolls)
    return [Station(f"{name}_{k:02d}", camera, *numbers) for k, numbers in enumerate(each, start=1)]
