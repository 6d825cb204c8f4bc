"""Read and write initial values and priors of parameters: [mounts.X], [strips.X], [scanner], [unknowns.KIND.OWNER].

Keys are derived from the class: `shift_m` has the initial value of the field `shift`, in the unit suffix of its
component names (degrees in files for rad), and `shift` its prior. A field without a unit has `shift_start`.
"""

import dataclasses
import functools
import typing
from collections.abc import Container, Iterable
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.arrays import annotated, as_jax_array
from jaxphoto.block import Block
from jaxphoto.camera import ImageMotion, RollingShutter
from jaxphoto.errors import BlockError, counted, few, quoted
from jaxphoto.georeferencing import IMAGE_X, Mount, Scanner, StripBias
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.toml import Section, status
from jaxphoto.observations.columns import FILE_UNITS
from jaxphoto.parameters import AbstractParameters, dynamic_fields, unit_of
from jaxphoto.unknowns import FIXED, UNKNOWNS, Unknowns, Weighted

Kind = type[AbstractParameters]
Pairs = tuple[dict[str, Any], dict[str, Any]]
"""Initial values and priors, by owner."""
_DEG = np.pi / 180
# Kinds with a table outside [unknowns].
_SEPARATE = ("scanner", "mounts", "strips")
_OWNERS = ("image", "camera", "mount", "strip", "block")
# Owners without a name (one per block), and the owner whose names occur only in this section.
_ONE, _NAMED = ("block", "lidar"), "knot"
# Minimum and maximum readout time of a sensor (ms).
_FASTEST_MS, _SLOWEST_MS = 0.5, 1000.0


class Key(NamedTuple):
    """Keys of a field."""

    field: str
    start: str
    unit: str
    """Optional suffix of the keys of a prior, such as _m."""
    scale: float
    shape: tuple[int, ...]


def known_unknowns(more: Iterable[Kind]) -> tuple[Kind, ...]:
    """Return the classes allowed in [unknowns], with `more` last. Raises BlockError for duplicate names."""
    kinds = tuple(
        kind for kind in dict.fromkeys((*UNKNOWNS, *more)) if kind not in UNKNOWNS or kind.kind not in _SEPARATE
    )
    taken = set(_SEPARATE)
    for kind in kinds:
        if kind.kind in taken:
            raise BlockError(f"[unknowns.{kind.kind}] is of another class; give {kind.__name__}.kind another name")
        taken.add(kind.kind)
    return kinds


@functools.cache
def keys_of(kind: Kind) -> tuple[Key, ...]:
    """Return the keys of the fields of a class. Raises TypeError for fields that are neither scalars nor vectors."""
    hints, keys = typing.get_type_hints(kind), []
    for field in dynamic_fields(kind):
        names = kind.names[field]
        axes, _ = annotated(hints[field]) or (["n"] * (len(names) > 1), False)
        units = {unit_of(name) for name in names}
        if len(axes) > 1 or len(units) > 1:
            raise TypeError(
                f"{kind.__name__}.{field} is not a number or vector of one unit; split it into several fields"
            )
        (unit,) = units
        in_files = FILE_UNITS.get(unit, unit)
        end = f"_{in_files}" if in_files else ""
        shape = (len(names),) if axes and not kind.sized else ()
        keys.append(Key(field, f"{field}{end or '_start'}", end, _DEG if in_files != unit else 1.0, shape))
    return tuple(keys)


def static_fields(kind: Kind) -> dict[str, Any]:
    """Return the fields without unknowns, with their defaults."""
    return {f.name: f.default for f in dataclasses.fields(kind) if f.name not in dynamic_fields(kind)}


def read_parameters(kind: Kind, table: Section) -> tuple[Any, Any]:
    """Read initial values and priors of one owner."""
    keys, static = keys_of(kind), static_fields(kind)
    table.known(*(k.start for k in keys), *static, *(k.field for k in keys))
    starts: dict[str, Any] = {name: table.values.get(name, default) for name, default in static.items()}
    priors = dict(starts)
    # Fields of `sized` classes have the length given by a static field.
    empty = _instance(kind, starts | {key.field: np.zeros(0) for key in keys}, table) if kind.sized else None
    for key in keys:
        shape = (getattr(empty, kind.sized),) if kind.sized else key.shape
        value = table.vector(key.start, *shape) if shape else np.asarray(table.number(key.start, 0.0))
        starts[key.field] = as_jax_array(value * key.scale)
        given, walk = table.values.get(key.field), f"walk{key.unit}"
        if empty is not None and isinstance(given, dict) and walk in given:
            # Standard deviation of the drift in one hour.
            drift = table.section(key.field)
            drift.known(walk)
            covariance = as_jax_array(empty.walk * drift.positive(walk) ** 2)
            priors[key.field] = Weighted(as_jax_array(np.zeros(len(empty.walk))), covariance=covariance)
        else:
            priors[key.field] = table.prior(key.field, value * key.scale, key.unit, key.scale)
    return _instance(kind, starts, table), _instance(kind, priors, table)


def _instance(kind: Kind, values: dict[str, Any], table: Section) -> Any:
    try:
        return kind(**values)
    except (ValueError, TypeError) as error:
        raise table.error("", f"{error}; correct it") from None


def parameters_section(parameters: AbstractParameters, priors: AbstractParameters) -> dict[str, Any]:
    """Return the table from which `read_parameters` restores `parameters` and `priors`."""
    written = {name: getattr(parameters, name) for name in static_fields(type(parameters))}
    for key in keys_of(type(parameters)):
        value = np.asarray(getattr(parameters, key.field))
        written[key.start] = (value / key.scale).tolist()
        written[key.field] = status(getattr(priors, key.field), value, key.scale)
    return written


def _read_each(kind: Kind, tables: dict[str, Section]) -> Pairs:
    pairs = {name: read_parameters(kind, table) for name, table in tables.items()}
    return {name: start for name, (start, _) in pairs.items()}, {name: prior for name, (_, prior) in pairs.items()}


def by_owner(section: Section, owners: Iterable[str]) -> dict[str, Section]:
    """Return the table of each owner, else the table "default"."""
    owners = list(owners)
    section.known("default", *owners)
    keys = {name: name if name in section else "default" for name in owners}
    return {name: section.section(key) for name, key in keys.items() if key in section}


def read_mounts(section: Section, cameras: Iterable[str]) -> Pairs:
    """Read mounts and their priors by name: "default" or the id of a camera."""
    section.known("default", *cameras)
    for table in map(section.section, section):
        if table.values.get("image_x", "forward") not in IMAGE_X:
            raise table.error("image_x", f"{quoted(table.values['image_x'])} is unknown; write {', '.join(IMAGE_X)}")
    mounts, priors = _read_each(Mount, {name: section.section(name) for name in section})
    for name, mount in mounts.items():
        if np.any(np.abs(mount.lever_arm) > 100):
            arm = np.asarray(mount.lever_arm).tolist()
            raise section.section(name).error("lever_arm_m", f"{arm} m is not a plausible lever arm; give it in metres")
    return mounts, priors


def mounts_of(cameras: Iterable[str], mounts: Container[str]) -> dict[str, str]:
    """Return the mount of each camera: of the same name, else "default", else none ("")."""
    return {name: name if name in mounts else "default" if "default" in mounts else "" for name in cameras}


def read_strips(section: Section, strips: Iterable[str]) -> Pairs:
    """Read shift and drift, and their priors, of every strip that has a table or uses the default table."""
    strips = list(strips)
    if section.values and not strips:
        raise section.error("", "images.csv has no column strip; add it or remove the tables")
    return _read_each(StripBias, by_owner(section, strips))


def read_scanner(section: Section) -> tuple[Scanner | None, Scanner | None]:
    """Read the scanner and its priors; None without [scanner]."""
    section.known("boresight_deg", "boresight", "shifts")
    if not section.values:
        return None, None
    shifts, priors, tables = {}, {}, section.section("shifts")
    for name in tables:
        table = tables.section(name)
        table.known("shift_m", "shift")
        shift = table.vector("shift_m")
        shifts[name], priors[name] = as_jax_array(shift), table.prior("shift", shift, "_m")
    boresight = section.vector("boresight_deg") * _DEG
    prior = section.prior("boresight", boresight, "_deg", _DEG)
    return Scanner(as_jax_array(boresight), shifts), Scanner(prior, priors)  # type: ignore[arg-type]


def scanner_section(scanner: Scanner | None, priors: Scanner | None) -> dict[str, Any]:
    """Return the [scanner] table of `scanner`; empty without one."""
    if scanner is None or priors is None:
        return {}
    return {
        "boresight_deg": (np.asarray(scanner.boresight) / _DEG).tolist(),
        "boresight": status(priors.boresight, scanner.boresight, _DEG),
        "shifts": {
            name: {"shift_m": np.asarray(shift).tolist(), "shift": status(priors.shifts[name], shift)}
            for name, shift in scanner.shifts.items()
        },
    }


def read_unknowns(section: Section, kinds: Iterable[Kind], block: Block) -> tuple[dict, dict]:
    """Read initial values and priors of [unknowns] by kind and owner."""
    known = {kind.kind: kind for kind in kinds}
    starts: dict[str, dict[str, Any]] = {}
    priors: dict[str, dict[str, Any]] = {}
    for name in section:
        if name not in known:
            raise section.error(
                name,
                "no class is known for these unknowns; pass it as read_block(folder, more=(...,)), or use  "
                + ", ".join(known),
            )
    for name, kind in known.items():
        if name in section:
            starts[name], priors[name] = _read_each(kind, _tables(kind, section.section(name), block))
    return starts, priors


def _tables(kind: Kind, section: Section, block: Block) -> dict[str, Section]:
    """Return the table of each owner."""
    if kind.owner in _ONE:
        return {"": section}
    if kind.owner == _NAMED:
        return {name: section.section(name) for name in section}
    if kind.owner not in (*_OWNERS, *block.partitions):
        raise section.error(
            "",
            f"images have no partition {kind.owner}; add the column {kind.owner} to images.csv and "
            f'partitions = ["{kind.owner}"] to the top of {section.file}',
        )
    return by_owner(section, (name for name in dict.fromkeys(block.owners(kind.owner)) if name))


def unknown_sections(block: Block) -> dict[str, Any]:
    """Return the [unknowns] table of a block."""
    priors, written = block.priors.more, {}
    for kind, owners in block.start.unknowns.more.items():
        tables: dict[str, Any] = {
            n: parameters_section(parameters, priors[kind][n]) for n, parameters in owners.items()
        }
        if any(type(parameters).owner in _ONE for parameters in owners.values()):
            if set(tables) != {""}:
                given = ", ".join(tables)
                raise BlockError(f"{kind} applies to the whole block, but is given for {given}; use the single key ''")
            tables = tables[""]
        if tables:
            written[kind] = tables
    return written


def check_shutters(images: Iterable[tuple[str, str]], starts: Unknowns, priors: Unknowns) -> None:
    """Raise BlockError for readout times not in milliseconds, shutters without motion, and motion without shutters.

    `images` are pairs (image, camera). A free readout time may have any initial value below one second.
    """
    shutters: dict[str, Any] = starts.more.get(RollingShutter.kind, {})
    known_before: dict[str, Any] = priors.more.get(RollingShutter.kind, {})
    motions = starts.more.get(ImageMotion.kind, {})
    for camera, shutter in shutters.items():
        place = f"{TOML}, [unknowns.{RollingShutter.kind}.{camera}]"
        readout, prior = abs(float(shutter.readout)), known_before[camera].readout
        known = prior == FIXED or (isinstance(prior, Weighted) and float(prior.sigma) < _FASTEST_MS)
        if readout > _SLOWEST_MS or (known and 0 < readout < _FASTEST_MS):
            raise BlockError(
                f"{place} readout_ms: {float(shutter.readout):g} ms is not a plausible readout time; give "
                "milliseconds, for most cameras 5 to 100, or 0 for a global shutter"
            )
        if missing := [image for image, its_camera in images if its_camera == camera and image not in motions]:
            raise BlockError(
                f"{place}: {counted(len(missing), 'photograph')} of this camera ({few(missing)}) have no motion; give "
                f"velocity_m_per_s of each in [unknowns.{ImageMotion.kind}.IMAGE]"
            )
    if motions and not shutters:
        raise BlockError(
            f"{TOML}, [unknowns.{ImageMotion.kind}]: motion during the exposure matters with a rolling shutter only; "
            f"add [unknowns.{RollingShutter.kind}.CAMERA], or remove it"
        )
