"""[[terrain.buildings]] and [[terrain.trees]] of a recipe -> `Settlement`."""

from jaxphoto.errors import quoted
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.recipe import sizes
from jaxphoto.io.recipe.keys import one_or_more, places, tables, whole
from jaxphoto.simulation import ROOFS, Buildings, Settlement, Trees
from jaxphoto.simulation.settlement import Range

# Steeper roofs would rise by more than they are wide.
_STEEPEST_DEG = 60.0


def read_settlement(terrain: Section) -> Settlement:
    """What stands on the terrain. Raises InputError for what cannot be built."""
    buildings, trees = (tables(terrain, key) for key in ("buildings", "trees"))
    return Settlement(tuple(map(_buildings, buildings)), tuple(map(_trees, trees)))


def _buildings(section: Section) -> Buildings:
    section.known("roof", "count", "at_m", "length_m", "width_m", "height_m", "slope_deg", "heading_deg")
    roof = section.text("roof", Buildings.roof)
    if roof not in ROOFS:
        raise section.error("roof", f"no roof is called {quoted(roof)}; use {', '.join(ROOFS)}")
    if roof == "flat" and "slope_deg" in section:
        raise section.error("slope_deg", "a flat roof has no slope; remove the key, or choose another roof")
    slope = _range(section, "slope_deg", Buildings.slope_deg)
    if slope[1] > _STEEPEST_DEG:
        raise section.error("slope_deg", f"{slope[1]:g} is steeper than {_STEEPEST_DEG:g} degrees; give less")
    return Buildings(
        roof=roof,
        count=whole(section, "count", 0, sizes.BUILDINGS),
        at_m=places(section, "at_m", (2,)),  # type: ignore[arg-type]
        length_m=_range(section, "length_m", Buildings.length_m),
        width_m=_range(section, "width_m", Buildings.width_m),
        height_m=_range(section, "height_m", Buildings.height_m),
        slope_deg=slope,
        heading_deg=_range(section, "heading_deg", Buildings.heading_deg, positive=False),
    )


def _trees(section: Section) -> Trees:
    section.known("count", "at_m", "height_m", "radius_m")
    return Trees(
        whole(section, "count", 0, sizes.TREES),
        places(section, "at_m", (2,)),  # type: ignore[arg-type]
        _range(section, "height_m", Trees.height_m),
        _range(section, "radius_m", Trees.radius_m),
    )


def _range(section: Section, key: str, default: Range, *, positive: bool = True) -> Range:
    """One number, or the least and the greatest."""
    if key not in section:
        return default
    values = one_or_more(section, key)
    if len(values) > 2 or values[0] > values[-1]:
        raise section.error(key, f"{list(values)} is no range; give one number, or the least and the greatest")
    if positive and values[0] <= 0:
        raise section.error(key, f"{values[0]:g} is not positive; give the true value")
    return values[0], values[-1]
