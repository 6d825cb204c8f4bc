"""Blocks that cannot tell something, each with a name for what is wrong and the cures that would mend it.

All are simulated, with noise in image points, control, stations and attitudes, from approximate values that are off by
metres and a degree.
"""

import dataclasses
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from jaxphoto import FIXED, Block, Datum, Distances, read_block, write_block
from jaxphoto.io import recipe_from
from jaxphoto.simulation import Simulation, simulate
from jaxphoto.variants import without_observations

Make = Callable[[int], Block]


class Cure(NamedTuple):
    """A cure, by words that the message must hold, and the block to which it was applied."""

    words: str
    applied: Make


class Case(NamedTuple):
    """A defect; `named` are regular expressions that what is said must match, all of them."""

    name: str
    broken: Make
    named: tuple[str, ...]
    cures: tuple[Cure, ...]


CAMERA = {
    "width_px": 4500, "height_px": 3000, "pixel_mm": 0.008, "distortion": "brown",
    "truth": {"c_mm": 34.2, "xp_mm": 0.05, "yp_mm": -0.08},
}  # fmt: skip
NEAR = {"c_mm": 34.0}
CROSS = [
    {"name": "E", "heading_deg": 90.0, "images": 6, "count": 2},
    {"name": "N", "heading_deg": 0.0, "images": 5},
]
STRIP = [{"name": "E", "heading_deg": 90.0, "images": 7}]
TO_AND_FRO = [{"name": "E", "heading_deg": 90.0, "images": 7, "count": 2}]
ONE_WAY = [
    {"name": "E1", "heading_deg": 90.0, "images": 7, "across_spacings": -0.5},
    {"name": "E2", "heading_deg": 90.0, "images": 7, "across_spacings": 0.5},
]
APART = [
    {"name": "E1", "heading_deg": 90.0, "images": 6, "across_m": -600.0},
    {"name": "E2", "heading_deg": 90.0, "images": 6, "across_m": 600.0},
]
TOGETHER = [strip | {"across_m": strip["across_m"] * 0.35} for strip in APART]
FOUR_EACH = [[x, y] for x in (-0.8, 0.8) for y in (-0.9, -0.4, 0.4, 0.9)]
IN_ONE = [[x, y] for x in (-0.8, 0.8) for y in (-0.8, -0.2)]
PAIR = [{"name": "E", "heading_deg": 90.0, "images": 2}]
CORNERS = [[-0.6, -0.35], [-0.6, 0.35], [0.6, -0.35], [0.6, 0.35], [0.0, 0.0]]
ROLLING = {"kind": "rolling"}
FLAT = {"kind": "flat", "roughness_m": 2.0}
LEVEL = {"kind": "flat"}
MOUNT = {"lever_arm_m": [0.0, 0.0, 0.0]}


def flown_with_truth(
    seed: int,
    strips: list[dict] = CROSS,
    control: list = CORNERS,
    terrain: Mapping = ROLLING,
    camera: Mapping[str, Any] | None = None,
    free: tuple[str, ...] = (),
    mount: Mapping | None = None,
    shift: Mapping | None = None,
    flight: Mapping | None = None,
    jitter: Mapping | None = None,
    line: list | None = None,
    ties: int = 70,
    start: Mapping | None = None,
    **sigmas: float,
) -> Simulation:
    """A flight 1000 m above ground; `control` in parts of half the block, `sigmas` of stations and attitudes."""
    # What is free starts elsewhere, what is held is right.
    camera = dict(CAMERA if camera is None else camera) | {"unknowns": dict.fromkeys(free, "free")}
    camera["interior"] = camera["truth"] | {name: NEAR.get(name, 0.0) for name in free}
    values: dict[str, Any] = {
        "title": "defect",
        "cameras": {"kodak": camera},
        "flight": {"height_m": 1000.0, "side_overlap_percent": 40.0}
        | dict(flight or {"forward_overlap_percent": 65.0})
        | {"strips": strips},
        "jitter": {"position_m": 5.0, "angle_deg": 1.5, "crab_deg": 2.0} | dict(jitter or {}),
        "terrain": dict(terrain),
        "points": {"ties": ties, "ends": 0.3},
        "targets": [{"role": "control", "prefix": "C", "at": control}] * bool(control)
        + [{"role": "tie", "prefix": "L", "at_m": line}] * bool(line),
        "sigmas": {"image_mm": 0.004, "control_m": 0.03} | sigmas,
        "start": {"position_m": 5.0, "angle_deg": 1.0} | dict(start or {}),
    }
    if mount is not None:
        values["mounts"] = {"default": MOUNT | dict(mount)}
    if shift is not None:
        values["strips"] = {"default": dict(shift)}
    return simulate(recipe_from(values), seed)


def flown(seed: int, **settings: Any) -> Block:
    """The block of `flown_with_truth`."""
    return flown_with_truth(seed, **settings).block


def made(**settings: Any) -> Make:
    """`flown` with these settings."""
    return partial(flown, **settings)


def then(change: Callable[[Block], Block], **settings: Any) -> Make:
    """`flown` with these settings, changed."""
    return lambda seed: change(flown(seed, **settings))


def inner(block: Block) -> Block:
    return dataclasses.replace(block, datum=Datum("inner"))


def in_plan(block: Block) -> Block:
    """Control without heights."""
    return dataclasses.replace(block, control=block.control.take(block.control.axis < 2))


def with_distance(seed: int, **settings: Any) -> Block:
    """`flown` with a distance between two points far apart, measured to 5 cm."""
    block, truth, _ = flown_with_truth(seed, **settings)
    rays = np.bincount(block.image_points.point, minlength=len(block.points))
    seen = np.flatnonzero(rays >= 3)
    ends = seen[[truth.points[seen, 0].argmin(), truth.points[seen, 0].argmax()]]
    noise = 0.05 * np.random.default_rng(seed).standard_normal()
    length = np.linalg.norm(np.subtract(*truth.points[ends])) + noise
    return dataclasses.replace(block, distances=Distances(ends[None], np.array([length]), np.array([0.05])))


def hold_first_shift(block: Block) -> Block:
    return eqx.tree_at(lambda b: b.priors.strips[b.image_strip[0]].shift, block, FIXED)


def station_of_one(block: Block) -> Block:
    """Of the first strip only one exposure keeps its station."""
    strip = block.image_strip[0]
    mine = np.array([name == strip for name in block.image_strip])[block.stations.who]
    return dataclasses.replace(block, stations=block.stations.take(~mine | (block.stations.who == 0)))


def without_rays(block: Block, out: np.ndarray) -> Block:
    rows = block.image_points
    return block.with_observations({rows.group: rows.take(~out)})


def without_lone_rays(block: Block, out: np.ndarray) -> Block:
    """Nor those points that are then left with one ray: that is a defect of its own."""
    return without_observations(block, {block.image_points.group: out})[0]


def two_points_in(image: int, block: Block) -> Block:
    """All but two points of an image are not measured in it."""
    mine = np.flatnonzero(block.image_points.image == image)
    out = np.zeros(len(block.image_points), bool)
    out[mine[2:]] = True
    return without_lone_rays(block, out)


def line_in(image: int, block: Block) -> Block:
    """Of an image only the points of a line are left."""
    rows = block.image_points
    on_line = np.array([name.startswith("L") for name in block.points])
    return without_lone_rays(block, (rows.image == image) & ~on_line[rows.point])


def one_ray(block: Block) -> Block:
    """The last tie point is measured once."""
    last = np.setdiff1d(block.image_points.point, block.control.who)[-1]
    mine = np.flatnonzero(block.image_points.point == last)
    out = np.zeros(len(block.image_points), bool)
    out[mine[1:]] = True
    return without_rays(block, out)


def narrow(block: Block) -> Block:
    """Three points keep only the rays of two exposures that are a metre apart."""
    rows = block.image_points
    pair = [k for k, name in enumerate(block.image_strip) if name == "R"]
    both = [p for p in np.unique(rows.point) if {*pair} <= {*rows.image[rows.point == p].tolist()}]
    chosen = [p for p in both if p not in block.control.who][:3]
    out = np.isin(rows.point, chosen) & ~np.isin(rows.image, pair)
    return without_rays(block, out)


def doubled(seed: int) -> Block:
    """Two rows of images.csv have one name."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "block"
        write_block(flown(seed), path)
        table = path / "images.csv"
        lines = table.read_text(encoding="utf-8").splitlines()
        table.write_text("\n".join([*lines, lines[1]]) + "\n", encoding="utf-8")
        return read_block(path)


LINE = [[-0.8, 0.0], [-0.3, 0.0], [0.2, 0.0], [0.8, 0.0]]
ROAD = [[x, 210.0] for x in np.linspace(-250.0, 550.0, 11).tolist()]
STEADY = {"angle_deg": 0.1, "crab_deg": 0.1}
TWO = [[-0.8, 0.0], [0.8, 0.0]]
THREE = ("c_mm", "xp_mm", "yp_mm")
SHIFTS = {"shift": "free", "truth": {"shift_sigma_m": 0.5}}
BORESIGHT = {"boresight": "free", "truth": {"boresight_deg": [0.2, -0.1, 0.3]}}
TRUE_ARM = {"lever_arm_m": [0.3, -0.5, 1.0]}
ARM = {"lever_arm": "free", "truth": TRUE_ARM}
LATE = {"time_offset": "free", "truth": {"time_offset_s": 0.02}}
SMAC = CAMERA | {"distortion": "smac"}
TURNED = {"attitude_deg": 0.005}
GNSS = {"station_m": 0.1}
POINT_AND_BORESIGHT = {"free": THREE[1:], "mount": BORESIGHT, "jitter": STEADY} | GNSS | TURNED
TRIPOD = {"base_m": 0.3}
SHORT = [*STRIP, {"name": "R", "heading_deg": 90.0, "images": 2, "base_m": 1.0}]

CASES = (
    Case(
        "no datum",
        made(control=[]),
        ("shift", "rotation", "scale"),
        (
            Cure("control", made()),
            Cure("stations", made(control=[], **GNSS)),
            Cure("inner", then(inner, control=[])),
        ),
    ),
    Case(
        "scale alone is open",
        made(control=CORNERS[:1], mount={}, **TURNED),
        ("scale",),
        (
            Cure("distance", partial(with_distance, control=CORNERS[:1], mount={}, **TURNED)),
            Cure("stations", made(control=CORNERS[:1], mount={}, **GNSS, **TURNED)),
        ),
    ),
    Case(
        "all but a rotation: two control points",
        made(control=TWO),
        ("rotation",),
        (Cure("control", made(control=[*TWO, [0.0, 0.7]])), Cure("stations", made(control=TWO, **GNSS))),
    ),
    Case(
        "control on a line",
        made(control=LINE, terrain=LEVEL),
        ("rotation about X",),
        (
            Cure("control", made(control=[*LINE, [0.0, 0.7]], terrain=LEVEL)),
            Cure("stations", made(control=LINE, terrain=LEVEL, **GNSS)),
        ),
    ),
    Case(
        "one straight strip, stations only",
        made(strips=STRIP, control=[], **GNSS),
        ("rotation about X",),
        (Cure("control", made(strips=STRIP, control=CORNERS[:4], **GNSS)), Cure("strip", made(control=[], **GNSS))),
    ),
    Case(
        "control without heights",
        then(in_plan),
        ("shift in Z",),
        (Cure("control", made()), Cure("stations", then(in_plan, **GNSS))),
    ),
    Case(
        "the shifts of all strips free, no control",
        made(control=[], shift=SHIFTS, **GNSS),
        ("shift",),
        (
            Cure("control", made(shift=SHIFTS, **GNSS)),
            Cure("hold the shift of one", then(hold_first_shift, control=[], shift=SHIFTS, **GNSS)),
        ),
    ),
    Case(
        "two strips share no point, control in one",
        made(strips=APART, control=[[-0.8, -0.9], [-0.8, -0.4], [0.8, -0.9], [0.8, -0.4]]),
        ("E[12]_0", "part|share"),
        (
            Cure("control", made(strips=APART, control=FOUR_EACH)),
            Cure("shares with", made(strips=TOGETHER, control=IN_ONE)),
        ),
    ),
    Case(
        "c free, one strip over flat ground",
        made(strips=STRIP, control=CORNERS[:4], terrain=FLAT, free=("c_mm",)),
        (r"\bc\b|c_mm", r"\bZ\b|heights?"),
        (
            Cure("stations", made(strips=STRIP, control=CORNERS[:4], terrain=FLAT, free=("c_mm",), **GNSS)),
            Cure("hold c", made(strips=STRIP, control=CORNERS[:4], terrain=FLAT)),
        ),
    ),
    Case(
        "k0 and c",
        made(camera=SMAC, free=("c_mm", "k0"), **GNSS),
        ("c_mm", "k0"),
        (Cure("hold k0", made(camera=SMAC, free=("c_mm",), **GNSS)),),
    ),
    Case(
        "principal point beside a boresight, one heading, no control",
        made(strips=ONE_WAY, control=[], **POINT_AND_BORESIGHT),
        ("xp_mm", "yp_mm"),
        (
            Cure("control", made(strips=ONE_WAY, **POINT_AND_BORESIGHT)),
            Cure(
                "opposite",
                made(strips=TO_AND_FRO, control=[], **POINT_AND_BORESIGHT),
            ),
        ),
    ),
    Case(
        "principal point over flat ground, stations that shift",
        made(strips=STRIP, terrain=FLAT, control=CORNERS[:4], free=THREE[1:], shift=SHIFTS, **GNSS),
        ("principal point|xp_mm",),
        (
            Cure("hold", made(strips=STRIP, terrain=FLAT, control=CORNERS[:4], shift=SHIFTS, **GNSS)),
            Cure("shift", made(strips=STRIP, terrain=FLAT, control=CORNERS[:4], free=THREE[1:], **GNSS)),
        ),
    ),
    Case(
        "all images at one place",
        made(strips=STRIP, flight=TRIPOD, start={"points_m": 5.0}),
        ("points?", "base|place|parallel"),
        (Cure("base|place|position", made(strips=STRIP)),),
    ),
    Case(
        "lever arm, one heading, no control",
        made(strips=ONE_WAY, control=[], mount=ARM, jitter=STEADY, **GNSS, **TURNED),
        ("lever_arm",),
        (
            Cure("control", made(strips=ONE_WAY, mount=ARM, jitter=STEADY, **GNSS, **TURNED)),
            Cure(
                "hold",
                made(strips=ONE_WAY, control=[], mount=TRUE_ARM, jitter=STEADY, **GNSS, **TURNED),
            ),
        ),
    ),
    Case(
        "time offset, one heading and speed, no control",
        made(strips=ONE_WAY, control=[], mount=LATE, **GNSS),
        ("time_offset",),
        (
            Cure("control", made(strips=ONE_WAY, mount=LATE, **GNSS)),
            Cure("fix", made(strips=ONE_WAY, control=[], mount={"time_offset_s": 0.02}, **GNSS)),
        ),
    ),
    Case(
        "time offset and the shift of one strip",
        made(strips=STRIP, mount=LATE, shift=SHIFTS, **GNSS),
        ("time_offset", "shift"),
        (
            Cure("hold mounts", made(strips=STRIP, shift=SHIFTS, **GNSS)),
            Cure("shift", made(strips=STRIP, mount=LATE, **GNSS)),
        ),
    ),
    Case(
        "drift of one exposure",
        then(station_of_one, shift={"drift": "free", "truth": {"shift_sigma_m": 0.0}}, **GNSS),
        ("drift", "one"),
        (
            Cure("stations", made(shift={"drift": "free", "truth": {"shift_sigma_m": 0.0}}, **GNSS)),
            Cure("hold", then(station_of_one, **GNSS)),
        ),
    ),
    Case(
        "boresight without attitudes",
        made(mount=BORESIGHT, **GNSS),
        ("boresight", "attitude"),
        (Cure("attitudes", made(mount=BORESIGHT, **GNSS, **TURNED)), Cure("hold", made(mount={}, **GNSS))),
    ),
    Case(
        "an image with two points",
        then(partial(two_points_in, 3)),
        ("E1_04", "point"),
        (Cure("points|measure", made()),),
    ),
    Case(
        "the points of an image on a line",
        then(partial(line_in, 3), terrain=FLAT, line=ROAD),
        ("E1_04", "line|point"),
        (Cure("points|measure", made(terrain=FLAT, line=ROAD)),),
    ),
    Case("one ray", then(one_ray), ("one|1 image", "point"), (Cure("second image|measure it|remove", made()),)),
    Case(
        "points of two rays that are nearly parallel",
        then(narrow, strips=SHORT, ties=90, start={"points_m": 5.0}),
        ("point", "parallel|rays"),
        (Cure("another|measure", made(strips=SHORT, ties=90)),),
    ),
    Case(
        "no redundancy",
        then(inner, strips=PAIR, control=[], ties=5),
        ("redundancy",),
        (Cure("observations|points", then(inner, strips=PAIR, control=[], ties=40)),),
    ),
    Case("doubled ids", doubled, ("twice|double|more than once|already", "images.csv"), (Cure("delete", made()),)),
)
