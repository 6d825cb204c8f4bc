"""[terrain], [points], [[targets]], [sigmas], [noise], [jitter] and [start] of a recipe."""

import dataclasses

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.recipe import sizes
from jaxphoto.io.recipe.keys import flag, not_negative, places, sigmas, tables, whole
from jaxphoto.simulation import (
    ROLES,
    ROLLING,
    Approximation,
    Choice,
    ConvergentPlan,
    FlightPlan,
    Jitter,
    PointPlan,
    RandomWaves,
    Sigmas,
    TargetPlan,
    Terrain,
    Wave,
)
from jaxphoto.simulation.recipe import Role

_ZERO = (0.0, 0.0, 0.0)
_RELATIVE = ("relative_position_m", "relative_attitude_deg")
# Approximate positions at close range are off by this part of the shortest distance, unless the recipe says otherwise.
_NEAR = 0.02
_KINDS = {
    "flat": ("height_m", "roughness_m"),
    "plane": ("height_m", "roughness_m", "slope_east_percent", "slope_north_percent"),
    "waves": ("height_m", "roughness_m", "waves"),
    "random": ("height_m", "roughness_m", "count", "rms_m", "length_m"),
    "rolling": (),
}
_ON_EVERY = ("buildings", "trees", "seed")


def read_terrain(section: Section) -> Terrain:
    """The ground; flat at Z = 0 where nothing is said."""
    kind = section.text("kind", "flat")
    if kind not in _KINDS:
        raise section.error("kind", f"no terrain is called {quoted(kind)}; use {', '.join(_KINDS)}")
    section.known("kind", *_KINDS[kind], *_ON_EVERY)
    seed = whole(section, "seed", 0) if "seed" in section else None
    if kind == "rolling":
        return dataclasses.replace(ROLLING, seed=seed)
    height, roughness = section.number("height_m", 0.0), not_negative(section, "roughness_m", 0.0)
    ground = Terrain(height_m=height, roughness_m=roughness, seed=seed)
    if kind == "plane":
        slope = [section.number(f"slope_{side}_percent", 0.0) / 100 for side in ("east", "north")]
        return dataclasses.replace(ground, slope=(slope[0], slope[1]))
    if kind == "random":
        waves = RandomWaves(
            section.count("count", sizes.WAVES), section.positive("rms_m"), section.positive("length_m")
        )
        return dataclasses.replace(ground, random=waves)
    return dataclasses.replace(ground, waves=tuple(map(_wave, tables(section, "waves"))))


def read_points(section: Section, *, in_swaths: bool) -> PointPlan:
    """Tie points and what of them is measured; only those `in_swaths` have keys that say how far swaths reach."""
    section.known(
        "ties", "min_images", "mean_rays", "margin_mm", "on_roofs", *(("across", "ends") if in_swaths else ())
    )
    minimum = section.count("min_images") if "min_images" in section else PointPlan.min_images
    if minimum < 2:
        raise section.error("min_images", "a point in one image has no position; give 2 or more")
    rays = section.positive("mean_rays") if "mean_rays" in section else None
    if rays is not None and rays < minimum:
        raise section.error("mean_rays", f"{rays:g} is less than min_images = {minimum}; raise it or lower min_images")
    on_roofs = not_negative(section, "on_roofs", PointPlan.on_roofs)
    if on_roofs > 1:
        raise section.error("on_roofs", f"{on_roofs:g} is no part of the tie points; give a number from 0 to 1")
    return PointPlan(
        ties=whole(section, "ties", 0, sizes.POINTS),
        min_images=minimum,
        mean_rays=rays,
        across=section.positive("across") if "across" in section else PointPlan.across,
        ends=not_negative(section, "ends", PointPlan.ends),
        margin_mm=not_negative(section, "margin_mm", PointPlan.margin_mm),
        on_roofs=on_roofs,
    )


def read_targets(section: Section) -> TargetPlan:
    """One group of targets."""
    section.known("role", "prefix", "count", "at_m", "at", "grid", "choice")
    prefix = section.name("prefix") if "prefix" in section else TargetPlan.prefix
    if not prefix or prefix[-1].isdigit() or prefix[0] == "#":
        raise section.error("prefix", f'{quoted(prefix)} does not tell targets apart; use letters, like "T"')
    choice = None
    if "choice" in section:
        table = section.section("choice")
        table.known("role", "outermost", "centre", "first")
        outermost, first = whole(table, "outermost", 0), whole(table, "first", 0)
        choice = Choice(_role(table), outermost, flag(table, "centre"), first)
    return TargetPlan(
        role=_role(section),
        prefix=prefix,
        count=whole(section, "count", 0, sizes.POINTS),
        at_m=places(section, "at_m", (2, 3)),
        at=places(section, "at", (2,)) + _grid(section),  # type: ignore[arg-type]
        choice=choice,
    )


def read_sigmas(top: Section, targets: tuple[TargetPlan, ...]) -> tuple[Sigmas, Sigmas]:
    """The stated sigmas, and the true ones, which are the same where [noise] does not say otherwise."""
    keys = (
        "image_mm", "target_mm", "control_m", "station_m", "attitude_deg", "lidar_m", "rig_place_m", "rig_turn_deg",
        *_RELATIVE,
    )  # fmt: skip
    said, true = top.section("sigmas"), top.section("noise")
    said.known(*keys)
    true.known(*keys)
    image = said.positive("image_mm")
    stated = Sigmas(
        image,
        said.positive("target_mm") if "target_mm" in said else image,
        *(sigmas(said, key, positive=True) for key in keys[2:]),
    )
    for key in keys[2:]:
        if key in true and getattr(stated, key) is None:
            raise true.error(key, f"this is not observed; add {key} under [sigmas] too, or remove it")
    for key in _RELATIVE:
        if key in said and "flight" not in top:
            raise said.error(key, "it is between exposures of a strip, and there is no [flight]; remove it")
    roles = {role for group in targets for role in (group.role, *([group.choice.role] if group.choice else []))}
    if stated.control_m is None and roles & {"control", "vertical"}:
        raise said.error("control_m", "the key is missing, but there are control points; add it")
    image = not_negative(true, "image_mm", stated.image_mm)
    noise = Sigmas(
        image,
        # Targets are measured as well as ties, unless one of the tables tells them apart.
        not_negative(true, "target_mm", stated.target_mm if "target_mm" in said else image),
        *(sigmas(true, key, getattr(stated, key)) for key in keys[2:]),
    )
    return stated, noise


def read_jitter(section: Section) -> Jitter:
    """How a flight leaves its plan."""
    section.known("position_m", "angle_deg", "crab_deg", "rate_deg_per_s")
    numbers = [not_negative(section, key, 0.0) for key in ("angle_deg", "crab_deg", "rate_deg_per_s")]
    return Jitter(sigmas(section, "position_m") or _ZERO, *numbers)


def read_start(section: Section, plan: FlightPlan | ConvergentPlan) -> Approximation:
    """How far approximate values are off."""
    section.known("position_m", "angle_deg", "points_m")
    position = Approximation.position_m
    if isinstance(plan, ConvergentPlan):
        position = _NEAR * min(station.distance_m for station in plan.stations)
    return Approximation(
        not_negative(section, "position_m", position),
        not_negative(section, "angle_deg", Approximation.angle_deg),
        not_negative(section, "points_m") if "points_m" in section else None,
    )


def check_points(top: Section, points: PointPlan, targets: tuple[TargetPlan, ...], images: int) -> None:
    """Raise InputError where there is nothing to measure, or too much in so many `images`."""
    n = points.ties + sum(t.count + len(t.at) + len(t.at_m) for t in targets)
    if n < 3:
        raise InputError(
            f"{top.file}, [points] ties: there are {n} points in all; an orientation needs 3, so ask for more"
        )
    sizes.check_pairs(top.file, images, n)


def _grid(section: Section) -> tuple[tuple[float, float], ...]:
    """The places of `grid = [n, m]`: as many from edge to edge along either side, row by row."""
    if "grid" not in section:
        return ()
    sides = section.values["grid"]
    if not isinstance(sides, list) or len(sides) != 2 or any(type(n) is not int or n < 2 for n in sides):
        raise section.error("grid", f"{quoted(sides)} is no grid; give two whole numbers from 2 on, like [7, 5]")
    if sides[0] * sides[1] > sizes.POINTS:
        raise section.error("grid", f"{quoted(sides)} are too many places, the most are {sizes.POINTS}; ask for fewer")
    x, y = (np.linspace(-1, 1, n).tolist() for n in sides)
    return tuple((a, b) for b in y for a in x)


def _role(section: Section) -> Role:
    role = section.text("role")
    if role not in ROLES:
        raise section.error("role", f"the role {quoted(role)} is unknown; write {', '.join(ROLES)}")
    return role


def _wave(section: Section) -> Wave:
    section.known("amplitude_m", "length_m", "heading_deg", "phase_deg")
    heading, phase = section.number("heading_deg", Wave.heading_deg), section.number("phase_deg", Wave.phase_deg)
    return Wave(section.positive("amplitude_m"), section.positive("length_m"), heading, phase)
