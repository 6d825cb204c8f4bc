"""Whether a cloud and a block lie over each other, and what to say where they do not."""

import numpy as np
from jaxtyping import Float, Real

from jaxphoto.errors import InputError
from jaxphoto.io.clouds.coordinate_system import UNITS
from jaxphoto.io.clouds.placement import Placement

_SAID = {"m": "metres", "ft": "international feet", "us_ft": "US survey feet"}


def check_overlap(placement: Placement, extent: Float[np.ndarray, "2 3"], within: Real[np.ndarray, "2 2"]) -> None:
    """Raise InputError where a cloud of `extent` (as its file counts) lies nowhere `within` X, Y (m) of the block.

    The sentence gives both extents. Where they would overlap if the cloud counted in another unit, it says so.
    """
    placement.checked(extent)
    placed = placement.extent(extent)
    if _meet(placed, within):
        return
    system, name = placement.system, placement.name
    others = []
    for unit in UNITS if not system.geographic else ():
        other = system.in_unit(unit)
        if other.units[0] != system.units[0]:
            counted = placement.extent(system.own(other.metres(extent)))
            others += [unit] if _meet(counted, within) else []
    sentence = f"{name} ({_said(placed)}) does not overlap the block ({_said(within)})"
    if others:
        units = " or ".join(_SAID[unit] for unit in others)
        options = " or ".join(f"--cloud-unit {unit}" for unit in others)
        raise InputError(f"{sentence}, but it would if it counts in {units}: if so, say it ({options})")
    raise InputError(f"{sentence}; name the cloud of this area, or its system (--cloud-epsg)")


def _meet(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two extents share a place in X and Y."""
    return bool(np.isfinite(a).all() and (a[0, :2] <= b[1, :2]).all() and (b[0, :2] <= a[1, :2]).all())


def _said(extent: np.ndarray) -> str:
    (west, south), (east, north) = extent[:, :2]
    return f"X {west:.1f} to {east:.1f}, Y {south:.1f} to {north:.1f} m"
