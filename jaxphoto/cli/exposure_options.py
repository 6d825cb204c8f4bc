"""Options that tell more of recorded positions than their files do."""

from typing import get_args

from jaxphoto.errors import InputError, quoted
from jaxphoto.georeferencing.gps import Heights
from jaxphoto.georeferencing.map_frame import check_heights, map_system
from jaxphoto.io.text_tables import finite, natural


def lever_arm_of(text: str | None) -> tuple[float, float, float] | None:
    """Metres to the right, forward and up. Raises InputError for what is none."""
    if text is None:
        return None
    numbers = [finite(part.strip()) for part in text.split(",")]
    known = [v for v in numbers if v is not None]
    if len(numbers) != 3 or len(known) != 3:
        raise InputError(f"--lever-arm is {quoted(text)}; give three numbers of metres, right,forward,up: 0,0.03,0.19")
    return known[0], known[1], known[2]


def map_codes(text: str | None) -> tuple[int | None, int | None]:
    """EPSG codes of a map system and of its heights, of "25832+7837". Raises InputError for what is none."""
    if text is None:
        return None, None
    plan, plus, heights = text.removeprefix("EPSG:").partition("+")
    code, vertical = natural(plan), natural(heights)
    if code is None or (plus and vertical is None):
        raise InputError(f"--epsg is {quoted(text)}; give the code of a map system, 25832, or with heights, 25832+7837")
    if (system := map_system(code)).is_geographic:
        raise InputError(
            f"--epsg {code} ({system.name}) is longitude and latitude; give the code of a map system in metres, as "
            "25832 is, or leave it out for the zone of UTM"
        )
    if vertical is not None:
        check_heights(code, vertical)
    return code, vertical


def heights_of(text: str | None) -> Heights | int | None:
    """Above what heights are, or the EPSG code of their system. Raises InputError for what is none."""
    for kind in get_args(Heights):
        if text == kind != "unknown":
            return kind
    if text is None:
        return None
    code = natural(text.removeprefix("EPSG:"))
    if code is None:
        raise InputError(
            f"--heights is {quoted(text)}; give ellipsoid, geoid, take-off, or the EPSG code of their system (5773 is "
            "EGM96)"
        )
    return code
