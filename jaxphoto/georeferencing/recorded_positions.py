"""Validation of recorded positions of photographs: implausible ones are reported, correctable ones corrected.

The photographs of a flight lie within kilometres. A receiver without a position writes (0, 0). Exchanged latitude and
longitude lie elsewhere on earth and return when exchanged again. Heights above take-off mixed with heights above a
datum are recognised by photographs that record both.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import few
from jaxphoto.georeferencing.geoid_heights import above_ellipsoid
from jaxphoto.georeferencing.gps import HEIGHTS, Gps, Heights

Positions = dict[str, Gps | None]

_EARTH_M = 6_371_000.0
# No contiguous flight is larger.
_FAR_M = 50_000.0
# Some hundred metres about (0, 0), where nobody flies.
_NOWHERE_DEG = 1e-3
# Tolerance of a height equal to the one above take-off; difference of two zero heights within a flight; metres.
_SAME_M, _APART_M = 0.5, 5.0


def plausible_positions(positions: Mapping[str, Gps | None]) -> tuple[Positions, list[str]]:
    """Return plausible positions, with latitude and longitude in order, and one message per kind of correction."""
    found: Positions = dict(positions)
    said = []
    absent = [name for name, gps in found.items() if gps is None]
    nowhere = [n for n, g in found.items() if g and max(abs(g.latitude_deg), abs(g.longitude_deg)) < _NOWHERE_DEG]
    found |= dict.fromkeys(nowhere, None)
    turned = [n for n, g in found.items() if g and abs(g.latitude_deg) > 90]
    found |= {n: _changed(g) for n in turned if (g := found[n])}
    known = {n: g for n, g in found.items() if g}
    if known:
        at = {n: _on_sphere(g) for n, g in known.items()}
        middle = np.median(np.array(list(at.values())), axis=0)
        far = [n for n, p in at.items() if np.linalg.norm(p - middle) > _FAR_M]
        back = [n for n in far if (g := _changed(known[n])) and np.linalg.norm(_on_sphere(g) - middle) <= _FAR_M]
        found |= {n: _changed(known[n]) for n in back}
        # Outliers are relative to a majority.
        lost = [n for n in far if n not in back] if len(far) < len(known) / 2 else []
        found |= dict.fromkeys(lost, None)
        turned += back
        if lost:
            said.append(
                f"the positions of {_named(lost)} are more than {_FAR_M / 1000:g} km from the others and are not used"
            )
    if turned:
        said.append(f"latitude and longitude of {_named(turned)} have changed places; they are changed back")
    if nowhere:
        said.append(f"the positions of {_named(nowhere)} are (0, 0), which receivers write without one: not used")
    if absent:
        n, have = len(positions), "have" if len(absent) > 1 else "has"
        some = f"{len(absent)} of {n} photographs {have} no position ({few(absent)})"
        said.append(some if len(absent) < n else f"all {n} photographs have no position")
    return found, said


def one_height(
    positions: Mapping[str, Gps | None],
    above_takeoff_m: Mapping[str, float | None],
    wanted: Heights | int | None = None,
) -> tuple[Positions, list[str]]:
    """Return the positions with heights above one reference, and a message about it.

    `wanted` "take-off" uses the heights above take-off that drones record; an EPSG code of heights adds its geoid where
    the files do not state the reference. Without it, heights of two kinds are combined by those above take-off, if
    photographs have both. Raises what `above_ellipsoid` does.
    """
    found: Positions = dict(positions)
    known = {n: g for n, g in found.items() if g and g.altitude_m is not None}
    zero = {
        n: h - above
        for n, g in known.items()
        if (h := g.altitude_m) is not None and (above := above_takeoff_m.get(n)) is not None
    }
    if wanted == "take-off" and any(above_takeoff_m.get(n) is not None for n in found):
        found = {n: g and g._replace(altitude_m=above_takeoff_m.get(n), heights=wanted) for n, g in found.items()}
        lost = [n for n, g in found.items() if g and g.altitude_m is None]
        return found, [_sentence(found), *([f"{_named(lost)} have no height above take-off"] if lost else [])]
    said = []
    relative = [n for n, v in zero.items() if abs(v) < _SAME_M]
    others = [v for n, v in zero.items() if n not in relative]
    if relative and others and abs(np.median(others)) > _APART_M:
        own = float(np.median(others))
        found |= {
            n: g._replace(altitude_m=g.altitude_m + own) for n in relative if (g := known[n]).altitude_m is not None
        }
        said.append(
            f"the heights of {_named(relative)} are above take-off, those of the others {own:+.1f} m from there, which "
            "is added"
        )
        zero |= dict.fromkeys(relative, own)
    if isinstance(wanted, int):
        found, more = above_ellipsoid(found, wanted)
        said += more
    elif wanted is not None:
        if wanted == "take-off" and known:
            said.append("no photograph notes a height above take-off: those of the files are taken as such (--heights)")
        found = {n: g and g._replace(heights=wanted) for n, g in found.items()}
    else:
        found, more = _joined(found, zero)
        said += more
    return found, [_sentence(found), *said] if known else said


def _joined(positions: Positions, zero: Mapping[str, float]) -> tuple[Positions, list[str]]:
    """Convert heights of the rarer kind to the usual one, if the difference of their zero heights is determined."""
    kinds: dict[Heights, list[str]] = {}
    for n, g in positions.items():
        if g and g.altitude_m is not None:
            kinds.setdefault(g.heights, []).append(n)
    if len(kinds) < 2:
        return positions, []
    usual = max(kinds, key=lambda kind: len(kinds[kind]))
    said, found = [], dict(positions)
    for kind, names in kinds.items():
        if kind == usual:
            continue
        here, there = ([zero[n] for n in kinds[k] if n in zero] for k in (kind, usual))
        if here and there and abs(apart := float(np.median(there) - np.median(here))) <= _APART_M:
            apart = 0.0
        elif not (here and there):
            found |= {n: g._replace(altitude_m=None) for n in names if (g := found[n])}
            said.append(
                f"the heights of {_named(names)} are {HEIGHTS[kind]}, those of most {HEIGHTS[usual]}, and nothing "
                "tells how far these are apart: the former are not used (--heights says above what they are)"
            )
            continue
        else:
            said.append(
                f"the heights of {_named(names)} are {HEIGHTS[kind]}, those of most {HEIGHTS[usual]}; {apart:+.1f} m "
                "brings them together (by the heights above take-off)"
            )
        found |= {n: _raised(g, apart)._replace(heights=usual) for n in names if (g := found[n])}
    return found, said


def _sentence(positions: Positions) -> str:
    kinds: list[Heights] = [g.heights for g in positions.values() if g and g.altitude_m is not None]
    kind: Heights = kinds[0] if kinds else "unknown"
    if kind == "ellipsoid":
        return "heights are above the ellipsoid"
    if kind == "unknown":
        return (
            "heights are as the files have them, which do not say above what (--heights says it): the block is as high "
            "as they say"
        )
    return f"heights are {HEIGHTS[kind]}; nothing is added to bring them to the ellipsoid, and the block is as high"


def _raised(gps: Gps, by_m: float) -> Gps:
    return gps._replace(altitude_m=None if gps.altitude_m is None else gps.altitude_m + by_m)


def _changed(gps: Gps) -> Gps | None:
    """Exchange latitude and longitude; None if the result is invalid."""
    if abs(gps.longitude_deg) > 90:
        return None
    return gps._replace(latitude_deg=gps.longitude_deg, longitude_deg=gps.latitude_deg)


def _on_sphere(gps: Gps) -> Float[np.ndarray, "3"]:
    longitude, latitude = np.deg2rad([gps.longitude_deg, gps.latitude_deg])
    level = np.cos(latitude)
    return _EARTH_M * np.array([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)])


def _named(names: list[str]) -> str:
    return f"{len(names)} photographs ({few(names)})" if len(names) > 1 else names[0]
