"""Kinds of keys that recipes have and block.toml has not."""

from collections.abc import Collection, Sequence

from jaxphoto.errors import quoted
from jaxphoto.io.block_folder.section import MOST, Section
from jaxphoto.simulation.recipe import Triple


def tables(section: Section, key: str) -> list[Section]:
    """The tables of a list, [[key]], none where it is absent."""
    values = section.values.get(key, [])
    path = f"{section.path}.{key}" if section.path else key
    if not isinstance(values, list) or not all(isinstance(value, dict) for value in values):
        raise section.error(key, f"this is no list of tables; write each as [[{path}]]")
    return [Section(section.file, f"{path}, number {k + 1}", value) for k, value in enumerate(values)]


def camera_of(section: Section, cameras: Collection[str]) -> str:
    """The camera that `section` names, or the only one there is."""
    camera = section.text("camera", next(iter(cameras)) if len(cameras) == 1 else None)
    if camera not in cameras:
        raise section.error("camera", f"there is no table [cameras.{camera}]; use one of {', '.join(cameras)}")
    return camera


def not_negative(section: Section, key: str, default: float | None = None) -> float:
    """A finite number, zero or more."""
    value = section.number(key, default)
    if value < 0:
        raise section.error(key, f"{value:g} is negative; give zero or more")
    return value


def whole(section: Section, key: str, default: int, most: int = MOST) -> int:
    """A whole number, zero or more, and not above `most`."""
    value = section.values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise section.error(key, f"{quoted(value)} is not a whole number of zero or more; give one")
    if value > most:
        raise section.error(key, f"{quoted(value)} is too large, the most are {most}; ask for fewer")
    return value


def flag(section: Section, key: str) -> bool:
    """true or false, false where it is absent."""
    value = section.values.get(key, False)
    if not isinstance(value, bool):
        raise section.error(key, f"{quoted(value)} is neither true nor false; write one of them")
    return value


def one_or_more(section: Section, key: str, default: float | None = None) -> tuple[float, ...]:
    """A finite number, or a list of some."""
    value = section.values.get(key)
    if not isinstance(value, list):
        return (section.number(key, default),)
    if not value:
        raise section.error(key, "the list is empty; give at least one number")
    return tuple(Section(section.file, section.path, {key: v}).number(key) for v in value)


def sigmas(section: Section, key: str, default: Triple | None = None, *, positive: bool = False) -> Triple | None:
    """Standard deviations of three axes from three numbers or one for all."""
    if key not in section:
        return default
    value = section.values[key]
    one, two, three = section.vector(key) if isinstance(value, list) else [section.number(key)] * 3
    least = min(one, two, three)
    if least < 0 or (positive and least == 0):
        raise section.error(key, f"{value} is not {'positive' if positive else 'zero or more'}; give the true value")
    return float(one), float(two), float(three)


def places(section: Section, key: str, sizes: Sequence[int]) -> tuple[tuple[float, ...], ...]:
    """A list of places of so many numbers each."""
    values = section.values.get(key, [])
    allowed = " or ".join(map(str, sizes))
    if not isinstance(values, list):
        raise section.error(key, f"{quoted(values)} is no list; write places like [[0.0, 0.0], [100.0, 0.0]]")
    for place in values:
        if not isinstance(place, list) or len(place) not in sizes:
            raise section.error(key, f"{quoted(place)} is no place; give {allowed} numbers, like [0.0, 0.0]")
    each = [[Section(section.file, section.path, {key: v}).number(key) for v in place] for place in values]
    return tuple(map(tuple, each))
