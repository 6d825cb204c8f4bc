"""Interior orientations that a block hardly sees, in words: what it means, and what would cure it.

Whether it does is decided by what came out: a correlation with the exterior orientation above `WEAK_CORRELATION`, and a
standard deviation that moves the corner of the image by more than `FELT` standard deviations of an image point. Over
flat ground, in near-vertical images, a longer principal distance and a higher flight make the same images, and so do a
moved principal point and a moved, tilted camera. Only stations, relief, two flying heights or oblique images tell them
apart (docs/models.md, principal points; docs/statistics.md).
"""

from typing import NamedTuple

import numpy as np

from jaxphoto.adjustment import Adjustment, yardsticks
from jaxphoto.errors import camera_words
from jaxphoto.report.findings import symbol
from jaxphoto.report.tables import Tables
from jaxphoto.statistics import Correlations
from jaxphoto.unknowns import FIXED

WEAK_CORRELATION = 0.9
FLAT = 0.2
"""Range of the heights over the flying height, up to which the ground is called nearly flat."""
NEAR_VERTICAL_DEG = 15.0
FELT = 10.0
"""Standard deviations of an image point by which an interior parameter may move the corner of the image.

Half of `adjustment.POOR`: up to here GNSS calls a dilution of precision moderate. Sound blocks over flat ground stay
below 8, those that cannot tell begin at 15 (benchmarks/defects.py).
"""
# Rows of the correlations: positions stand first, then rotations of whichever kind.
_PLAN, _HEIGHT, _TILTS = slice(0, 2), slice(2, 3), slice(3, 5)
_C, _POINT = ("c_mm",), ("xp_mm", "yp_mm")


class Weakness(NamedTuple):
    """One weakness of one camera, and the (exterior, interior) pairs whose high correlation it explains."""

    sentence: str
    explains: frozenset[tuple[str, str]]
    labels: frozenset[str]
    """Paths of its parameters."""


class _Geometry(NamedTuple):
    """Of one camera's images: relief over flying height, and the largest tilt in degrees."""

    relief: float
    tilt_deg: float

    @property
    def weak(self) -> bool:
        """Nearly flat, and nearly vertical."""
        return self.relief < FLAT and self.tilt_deg < NEAR_VERTICAL_DEG

    def __str__(self) -> str:
        return f"nearly flat ground (relief {100 * self.relief:.0f} % of the flying height) in near-vertical images"


def weaknesses(tables: Tables, camera: str, c: Correlations) -> list[Weakness]:
    """What flat ground and near-vertical images leave open of the interior orientation of `camera`."""
    adjusted = tables.adjusted
    images = np.flatnonzero(np.array(adjusted.block.image_camera) == camera)
    geometry = _geometry(adjusted, images)
    if geometry is None or not geometry.weak:
        return []
    sigma = {s.parameter: s.sigma for s in tables.significance if s.camera == camera}
    corner = at_corner(tables, camera)
    found = []
    rho, c_mm = _strongest(c, _HEIGHT, _C), float(adjusted.unknowns.interior[camera].c)
    if rho > WEAK_CORRELATION and corner["c_mm"] > FELT:
        why, cure = _stations(adjusted, images, (2,))
        share = 100 * sigma["c_mm"] / c_mm
        sentence = (
            f"c of {camera_words(camera)} is hardly determined: sigma {sigma['c_mm']:.3g} mm ({share:.2g} % of c), "
            f"|rho| with Z up to {rho:.4f}; over {geometry} a longer c and a higher flight give the same image "
            f"coordinates, and {why}: {cure}, relief or a second flying height, or oblique images, or hold c fixed"
        )
        found.append(_weakness(camera, sentence, c, _C))
    turned, moved = _strongest(c, _TILTS, _POINT), _strongest(c, _PLAN, _POINT)
    shift = max((corner[name] for name in _POINT if name in corner), default=0.0)
    if max(turned, moved) > WEAK_CORRELATION and shift > FELT:
        why, cure = _stations(adjusted, images, (0, 1))
        sigmas = ", ".join(f"sigma of {symbol(name)} {sigma[name]:.3g} mm" for name in _POINT if name in sigma)
        sentence = (
            f"the principal point of {camera_words(camera)} is hardly determined: {sigmas}, |rho| with "
            f"{' and '.join(c.eop_names[_TILTS])} up to {turned:.4f}, with X and Y up to {moved:.4f}; over {geometry} "
            f"a tilt and a shift of every image make good for it, and {why}: {cure} with strips flown in both "
            "directions, relief or oblique images, or hold it fixed"
        )
        found.append(_weakness(camera, sentence, c, _POINT))
    return found


def at_corner(tables: Tables, camera: str) -> dict[str, float]:
    """By how many standard deviations of its image points each estimated parameter moves the corner of the image.

    c along the radius, the principal point as it is; coefficients in yardsticks (`adjustment.yardsticks`).
    """
    adjusted = tables.adjusted
    sensor, rows = adjusted.block.sensors[camera], adjusted.block.image_points
    mine = np.isin(adjusted.structure.image, np.flatnonzero(np.array(adjusted.block.image_camera) == camera))
    measured = float(np.median(np.asarray(rows.sigma)[mine])) if mine.any() else 1.0
    tangent = np.hypot(sensor.width_mm, sensor.height_mm) / 2 / float(adjusted.unknowns.interior[camera].c)
    units = dict(zip(adjusted.structure.labels, yardsticks(adjusted).shared.tolist(), strict=True))
    units |= {f"interior[{camera}].c_mm": measured / tangent}
    units |= {f"interior[{camera}].{name}": measured for name in _POINT}
    own = [s for s in tables.significance if s.camera == camera]
    return {s.parameter: s.sigma / units[f"interior[{camera}].{s.parameter}"] for s in own}


def _weakness(camera: str, sentence: str, c: Correlations, parameters: tuple[str, ...]) -> Weakness:
    # Of all of the exterior orientation: what goes with them besides goes with what is told.
    pairs = frozenset((e, p) for e in c.eop_names for p in c.parameters if p in parameters)
    return Weakness(sentence, pairs, frozenset(f"interior[{camera}].{name}" for name in parameters))


def _geometry(adjusted: Adjustment, images: np.ndarray) -> _Geometry | None:
    """None where no image looks down from above."""
    rows = adjusted.structure
    seen = np.unique(rows.point[np.isin(rows.image, images)])
    heights = np.asarray(adjusted.unknowns.points)[seen, 2]
    flying = np.asarray(adjusted.unknowns.exterior.position)[images, 2].mean() - heights.mean() if len(seen) else 0.0
    if not flying > 0:
        return None
    axis = np.asarray(adjusted.unknowns.exterior.camera_from_object)[images][:, 2, 2]
    return _Geometry(float(np.ptp(heights) / flying), float(np.degrees(np.arccos(np.clip(axis, -1.0, 1.0))).max()))


def _stations(adjusted: Adjustment, images: np.ndarray, axes: tuple[int, ...]) -> tuple[str, str]:
    """Why stations of `images` on `axes` do not tell the interior orientation, and what of them would."""
    block, priors = adjusted.block, adjusted.priors
    rows = np.isin(block.stations.who, images) & np.isin(block.stations.axis, axes)
    held = np.unique(block.stations.who[rows]).tolist()
    if not held:
        return "no station tells them apart", "add camera stations (GNSS)"
    loose = {name for name, bias in priors.strips.items() if bias.shift != FIXED}
    swung = {name for name, mount in priors.mounts.items() if mount.lever_arm != FIXED}
    if all(block.image_strip[i] in loose or block.image_mount[i] in swung for i in held):
        return (
            "stations tell them apart only as well as their shifts and lever arms are known",
            "hold these fixed, or add camera stations (GNSS) that do not shift,",
        )
    sigma = float(np.median(np.asarray(block.stations.sigma)[rows]))
    return (
        f"stations of sigma {sigma:.2g} m hardly tell them apart",
        "add better camera stations (GNSS)",
    )


def _strongest(c: Correlations, rows: slice, parameters: tuple[str, ...]) -> float:
    columns = [k for k, name in enumerate(c.parameters) if name in parameters]
    return float(c.max_abs[rows][:, columns].max(initial=0.0)) if len(c.images) else 0.0
