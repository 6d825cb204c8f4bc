"""[unknowns.KIND.OWNER] of block.toml: start values and priors of declared parameters.

Keys follow from the class: `shift_m` with the start of the field `shift`, in the unit that ends the names of its
numbers (rad are degrees in files), and `shift` with its prior. A field without a unit starts as `shift_start`.
"""

import dataclasses
import typing
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.arrays import annotated, on_device
from jaxphoto.block import Block
from jaxphoto.errors import BlockError
from jaxphoto.io.block_folder.camera_section import status
from jaxphoto.io.block_folder.section import Section
from jaxphoto.observations.columns import FILE_UNITS
from jaxphoto.parameters import AbstractParameters, dynamic_fields, unit_of
from jaxphoto.unknowns import UNKNOWNS, Weighted

Kind = type[AbstractParameters]
# Those that have sections of their own.
_OWN = ("scanner", "mounts", "strips")
_OWNERS = ("image", "camera", "mount", "strip", "block")
# Of these there is one, without a name; knots have names of their own, which are nowhere else.
_ONE, _NAMED = ("block", "lidar"), "knot"


class Key(NamedTuple):
    """How block.toml gives a field."""

    field: str
    start: str
    unit: str
    """What may end the keys of a prior, such as _m."""
    scale: float
    shape: tuple[int, ...]


def known_unknowns(more: Iterable[Kind]) -> tuple[Kind, ...]:
    """The classes that [unknowns] may hold, `more` the last. Raises BlockError where two have one name."""
    kinds = tuple(kind for kind in dict.fromkeys((*UNKNOWNS, *more)) if not (kind.kind in _OWN and kind in UNKNOWNS))
    taken = set(_OWN)
    for kind in kinds:
        if kind.kind in taken:
            raise BlockError(f"[unknowns.{kind.kind}] is of another class; give {kind.__name__}.kind another name")
        taken.add(kind.kind)
    return kinds


def keys_of(kind: Kind) -> tuple[Key, ...]:
    """The keys of the fields of a class. Raises TypeError for fields that are neither numbers nor vectors."""
    hints, found = typing.get_type_hints(kind), []
    for field in dynamic_fields(kind):
        names = kind.names[field]
        axes, _ = annotated(hints[field]) or (["n"] * (len(names) > 1), False)
        units = {unit_of(name) for name in names}
        if len(axes) > 1 or len(units) > 1:
            raise TypeError(f"{kind.__name__}.{field} is no number or vector of one unit; make it several fields")
        (unit,) = units
        own = FILE_UNITS.get(unit, unit)
        end = f"_{own}" if own else ""
        shape = (len(names),) if axes and not kind.sized else ()
        found.append(Key(field, f"{field}{end or '_start'}", end, np.pi / 180 if own != unit else 1.0, shape))
    return tuple(found)


def read_unknowns(section: Section, kinds: Iterable[Kind], block: Block) -> tuple[dict, dict]:
    """Start values and priors by kind and owner. Raises InputError for what the classes and the block do not have."""
    kinds = tuple(kinds)
    for name in section:
        if name not in [kind.kind for kind in kinds]:
            raise section.error(
                name,
                "jaxphoto has no class for these unknowns; give yours to read_block(folder, more=(...,)), or use "
                + ", ".join(kind.kind for kind in kinds),
            )
    starts: dict[str, dict[str, Any]] = {}
    priors: dict[str, dict[str, Any]] = {}
    for kind in (kind for kind in kinds if kind.kind in section):
        given = section.section(kind.kind)
        of_each = {name: read_parameters(kind, table) for name, table in _tables(kind, given, block)}
        starts[kind.kind] = {name: start for name, (start, _) in of_each.items()}
        priors[kind.kind] = {name: prior for name, (_, prior) in of_each.items()}
    return starts, priors


def unknown_sections(block: Block) -> dict[str, Any]:
    """The [unknowns] table that `read_unknowns` reads as `more` of a block."""
    start, priors = block.start.unknowns.more, block.priors.more
    written: dict[str, Any] = {}
    for kind, owners in start.items():
        tables = {name: _section(own, priors[kind][name]) for name, own in owners.items()}
        if any(type(own).owner in _ONE for own in owners.values()):
            if set(tables) != {""}:
                raise BlockError(f"{kind} belongs to the whole block, whose name is '', not {', '.join(tables)}")
            tables = tables[""]
        if tables:
            written[kind] = tables
    return written


def _tables(kind: Kind, given: Section, block: Block) -> Iterator[tuple[str, Section]]:
    """The owners that have parameters, each with its table."""
    if kind.owner in _ONE:
        yield "", given
        return
    if kind.owner == _NAMED:
        yield from ((name, given.section(name)) for name in given)
        return
    if kind.owner not in (*_OWNERS, *block.partitions):
        raise given.error(
            "",
            f"these belong to a part of the images called {kind.owner}; add the column {kind.owner} to images.csv and "
            f'partitions = ["{kind.owner}"] to the top of {given.file}',
        )
    owners = [name for name in dict.fromkeys(block.owners(kind.owner)) if name]
    given.known("default", *owners)
    for name in owners:
        key = name if name in given else "default"
        if key in given:
            yield name, given.section(key)


def read_parameters(kind: Kind, table: Section) -> tuple[Any, Any]:
    """Start values and priors of one owner. Raises InputError for keys that the class does not have."""
    keys, static = keys_of(kind), static_fields(kind)
    table.known(*(k.start for k in keys), *static, *(k.field for k in keys))
    starts: dict[str, Any] = {name: table.values.get(name, default) for name, default in static.items()}
    priors = dict(starts)
    # How many numbers its fields have is known only where the field that counts them is sound.
    bare = _made(kind, starts | dict.fromkeys((key.field for key in keys), np.zeros(0)), table) if kind.sized else None
    for key in keys:
        shape = (getattr(bare, kind.sized),) if kind.sized else key.shape
        value = table.vector(key.start, *shape) if shape else np.asarray(table.number(key.start, 0.0))
        starts[key.field] = on_device(value * key.scale)
        walked = None if bare is None else _walked(table, key, bare)
        priors[key.field] = walked or table.prior(key.field, value * key.scale, key.unit, key.scale)
    return _made(kind, starts, table), _made(kind, priors, table)


def _made(kind: Kind, values: dict[str, Any], table: Section) -> Any:
    try:
        return kind(**values)
    except ValueError as error:
        raise table.error("", f"{error}; correct it") from None


def _walked(table: Section, key: Key, own: Any) -> Weighted | None:
    """The prior of coefficients that `{ walk_mm = ... }` describes: how far the camera wanders in an hour, or None."""
    given, word = table.values.get(key.field), f"walk{key.unit}"
    if not isinstance(given, dict) or word not in given:
        return None
    wander = table.section(key.field)
    wander.known(word)
    return Weighted(on_device(np.zeros(len(own.walk))), covariance=on_device(own.walk * wander.positive(word) ** 2))


def _section(own: AbstractParameters, priors: AbstractParameters) -> dict[str, Any]:
    kind, written = type(own), {}
    for name in static_fields(kind):
        written[name] = getattr(own, name)
    for key in keys_of(kind):
        value = np.asarray(getattr(own, key.field))
        written[key.start] = (value / key.scale).tolist()
        written[key.field] = status(getattr(priors, key.field), value, key.scale)
    return written


def static_fields(kind: Kind) -> dict[str, Any]:
    """Fields that hold no numbers to solve for, with their defaults."""
    return {f.name: f.default for f in dataclasses.fields(kind) if f.name not in dynamic_fields(kind)}
