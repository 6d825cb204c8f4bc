"""[lidar] of a recipe -> `ScanPlan`."""

from typing import Any

import numpy as np

from jaxphoto.errors import quoted
from jaxphoto.georeferencing import PATTERN_OF
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.recipe import sizes
from jaxphoto.io.recipe.keys import flag, sigmas, tables
from jaxphoto.simulation import ConvergentPlan, FlightPlan, Footprint, ScanPlan, Sigmas, Strip, Terrain

_ZERO = (0.0, 0.0, 0.0)
# Beyond this a rolling aircraft might look at the horizon.
_WIDEST_DEG = 60.0
# From node to node of a flight of its own, about.
_NODES_S = 5.0


def read_lidar(top: Section, plan: FlightPlan | ConvergentPlan, terrain: Terrain, stated: Sigmas) -> ScanPlan | None:
    """The plan of the scanner, None without [lidar]. Raises InputError for what cannot be scanned."""
    if "lidar" not in top:
        if stated.lidar_m is not None:
            raise top.section("sigmas").error("lidar_m", "there is no table [lidar]; add it, or remove this key")
        return None
    section, truth = top.section("lidar"), top.section("lidar").section("truth")
    section.known("density_per_m2", "scan_angle_deg", "pattern", "strips", "same_trajectory", "truth")
    if isinstance(plan, ConvergentPlan):
        raise top.error("lidar", "a convergent set is not flown, so it has no lidar strips; remove the table")
    if terrain.roughness_m:
        raise top.section("terrain").error(
            "roughness_m",
            f"points {terrain.roughness_m:g} m above or below the ground lie on no surface that a lidar could measure; "
            'use 0, and in place of "rolling" give its waves',
        )
    if stated.lidar_m is None:
        raise top.section("sigmas").error(
            "lidar_m", "the key is missing, but there is a lidar; add its sigmas, like [0.5, 0.5, 0.15]"
        )
    angle = section.positive("scan_angle_deg") if "scan_angle_deg" in section else ScanPlan.scan_angle_deg
    if angle > _WIDEST_DEG:
        raise section.error("scan_angle_deg", f"{angle:g} to either side is too wide; give {_WIDEST_DEG:g} or less")
    strips, same = _strips(section, plan), flag(section, "same_trajectory")
    if same and strips:
        raise section.error(
            "same_trajectory", "the scanner has a flight of its own, [[lidar.strips]]; remove these, or this key"
        )
    single = ("range_offset_m", "range_scale_ppm", "angle_scale_ppm", "time_offset_s")
    vectors = {"boresight_deg": 3, "lever_arm_m": 3, "eccentricity_deg": 2}
    drawn = ("shift_sigma_m", "drift_sigma_m", "drift_sigma_deg")
    by_strip = ("shift_m", "drift_m_per_s", "attitude_deg", "attitude_drift_deg_per_s")
    truth.known(*vectors, *single, *drawn, *by_strip, "correlation_s", "knots_s")
    given: dict[str, Any] = {name: tuple(truth.vector(name, size).tolist()) for name, size in vectors.items()}
    given |= {name: truth.number(name, 0.0) for name in single}
    given |= {name: sigmas(truth, name) or _ZERO for name in drawn}
    given |= {name: truth.positive(name) for name in ("correlation_s", "knots_s") if name in truth}
    for name in by_strip:
        of = truth.section(name)
        of.known("default", *(strip.name for strip in strips or plan.strips))
        given[name] = {strip: tuple(of.vector(strip).tolist()) for strip in of}
    given["pattern"] = section.text("pattern", "line")
    if given["pattern"] not in PATTERN_OF:
        known = ", ".join(PATTERN_OF)
        raise section.error("pattern", f"{quoted(given['pattern'])} is no pattern of a scanner; use {known}")
    return ScanPlan(
        density_per_m2=section.positive("density_per_m2"),
        scan_angle_deg=angle,
        strips=strips,
        same_trajectory=same,
        **given,
    )


def _strips(section: Section, plan: FlightPlan) -> tuple[Strip, ...]:
    """Strips of the scanner's own flight, none where it flies with the camera."""
    strips: list[Strip] = []
    for table in tables(section, "strips"):
        table.known("name", "heading_deg", "length_m", "height_m", "along_m", "across_m")
        name, length = table.name("name"), table.positive("length_m")
        if name in ("", "default", *(strip.name for strip in strips)):
            raise table.error("name", f"a strip cannot be called {quoted(name)}; give each its own name")
        nodes = 1 + max(1.0, np.ceil(length / (_NODES_S * plan.speed_m_per_s)))
        if nodes > sizes.IMAGES:
            hours = length / plan.speed_m_per_s / 3600
            raise table.error("length_m", f"a strip of {length:g} m takes {hours:.3g} hours; give a shorter one")
        strips.append(
            Strip(
                name=name,
                camera="",
                heading_deg=table.number("heading_deg"),
                images=int(nodes),
                base_m=float(length / (nodes - 1)),
                height_m=table.positive("height_m"),
                footprint=Footprint(0.0, 0.0),
                along_m=table.number("along_m", 0.0),
                across_m=table.number("across_m", 0.0),
            )
        )
    return tuple(strips)
