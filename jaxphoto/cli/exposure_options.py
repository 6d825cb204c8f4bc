"""Options that tell more of recorded positions than their files do."""

from typing import get_args

from jaxphoto.errors import InputError, quoted
from jaxphoto.georeferencing.gps import Heights
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
