"""Surveyed points on smooth surfaces of strips: the datum that strips cannot provide themselves.

A point belongs to the block, with its coordinates observed once for any number of strips: its survey error is common to
all of them.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.block import Block
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import StripErrors, TrajectoryKnot
from jaxphoto.lidar.corresponding_planes import fitting
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.observations import StripPoints
from jaxphoto.procedures.control.marks import Marked, into_block
from jaxphoto.procedures.control.surveyed import SurveyedPoints
from jaxphoto.procedures.lidar.strip_search import StripSearch
from jaxphoto.procedures.lidar.tie_point_search import PointPlanes, PointSearch
from jaxphoto.unknowns import FIXED, Weighted

CONTROL, CHECK = "control", "check points"
"""Names of surveyed points in tables of differences."""
# Maximum distance (m) of a strip from control in its system; usually exceeded by heights of another system, or feet.
_FAR_M = 10.0
# Distances are given in kilometres from here on (m).
_KILOMETRES = 10_000.0
# Prior sigmas of a strip, fixed in some directions and free in the others (m): small and large compared with control.
_RIGHT_M, _FREE_M = 1e-3, 100.0
# Of the common shift of most control: iterations of reweighting, standard deviations below which gaps have equal
# weight, and fraction of the best-determined direction that is undetermined.
_TURNS, _SMALL, _UNTOLD = 30, 0.1, 0.01
# In standard deviations of the survey: two surveys within this limit belong to one point.
_SAME = 4.0
_NO_MARKS = Marked(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))


class OnStrips(NamedTuple):
    """Surveyed points above planes of each look; check points all fit, because nothing follows from them."""

    control: list[PointPlanes]
    check: list[PointPlanes]


class ControlSearch:
    """Searches about surveyed places, which stay; `number` is the index of each point in the block, -1 for check
    points.
    """

    def __init__(self, search: StripSearch, control: SurveyedPoints, number: Int[np.ndarray, "points"]) -> None:
        self.search, self.control = search, control
        self._points = PointSearch(search, number)
        variances = control.sigma_m**2
        self._spread = variances[:, :, None] * np.eye(3)

    def look(self, settled: bool) -> OnStrips:
        """Return the planes about the points, in the strips as last corrected by the other search."""
        seen = self._points.look(self.control.coordinates, self._spread, settled)
        control = [_of(f, ~self.control.check[f.found.point]) for f in seen]
        # All strips together: a few points of one strip do not show which of them is a blunder.
        found = [(f.patches.normal[f.found.patch], f.found.gap, f.sigma) for f in control]
        normal, gap, sigma = (np.concatenate(v) for v in zip(*found, strict=True))
        fit = fitting(_without_shift(normal, gap, sigma), sigma, self.search.settings.outlier)
        fits = np.split(fit, np.cumsum([len(f.fits) for f in control]))
        check = [_of(f, self.control.check[f.found.point]) for f in seen]
        return OnStrips(
            [f._replace(fits=own) for f, own in zip(control, fits, strict=False)],
            [f._replace(fits=np.ones(len(f.fits), bool)) for f in check],
        )

    def rows(self, seen: OnStrips, errors: StripErrors) -> tuple[StripPoints, ...]:
        """Return the fitting control as observations: one group, if there are any."""
        return self._points.rows(seen.control, errors)


def with_control(block: Block, control: SurveyedPoints) -> tuple[Block, Int[np.ndarray, "points"]]:
    """Return `block` with the control observed, and the index of each; -1 for check points, which it does not need.

    Control of the block with the same name is the same point, surveyed once. Raises InputError for points without a
    height or a standard deviation, and for other points of the block with the same name.
    """
    check_complete(control)
    again = _again(block, control)
    own = np.flatnonzero(~control.check & ~again)
    ids, xyz, sigma = tuple(control.ids[k] for k in own), control.coordinates[own], control.sigma_m[own]
    every = np.ones(len(own), bool)
    whole = into_block(block, ids, xyz, sigma, xyz, _NO_MARKS, every, ~every)
    place = {name: k for k, name in enumerate(whole.points)}
    number = [-1 if out else place[name] for name, out in zip(control.ids, control.check, strict=True)]
    return whole, np.array(number, int)


def check_complete(control: SurveyedPoints) -> None:
    """Raise InputError for points without a height or a standard deviation."""
    for k, (xyz, sigma) in enumerate(zip(control.coordinates, control.sigma_m, strict=True)):
        at = f"{control.places[k]}: point {control.ids[k]}"
        if not np.isfinite(xyz).all():
            raise InputError(f"{at} has no height, without which nothing says how far it is from a plane: add Z_m")
        if not (sigma > 0).all():
            raise InputError(
                f"{at} has no standard deviations, which say how near to a plane it must be: add sigma_X_m, sigma_Y_m "
                "and sigma_Z_m"
            )


def check_seen(control: SurveyedPoints, seen: OnStrips, search: StripSearch) -> None:
    """Raise BlockError for surveyed points away from the strips, in plan or in height."""
    gap = np.concatenate([f.found.gap for f in (*seen.control, *seen.check)])
    settings = search.settings
    if not len(gap):
        low, high = search.cloud.extent
        off = np.maximum(np.maximum(low - control.coordinates, control.coordinates - high), 0.0)[:, :2]
        away = float(np.median(np.linalg.norm(off, axis=1)))
        if away > 0:
            raise BlockError(
                f"the points of {control.file} lie {_far(away)} from the strips: give them in the cloud's coordinate "
                "system and in metres, easting first"
            )
        raise BlockError(
            f"no point of {control.file} lies on a plane of a strip, which is {settings.returns} returns about it, in "
            f"{settings.cell_m:g} m, that scatter by {settings.roughness_m:g} m at most: give points on smooth, open "
            "surfaces, or take larger cells (--cell-m) or rougher planes (--roughness-m)"
        )
    off = float(np.median(gap))
    if abs(off) > _FAR_M:
        raise BlockError(
            f"the points of {control.file} lie {abs(off):.1f} m {'above' if off > 0 else 'below'} the strips: its "
            "heights may count in feet or belong to another vertical system than those of the cloud; bring both into "
            "one"
        )


def with_datum(block: Block, strip: str, seen: OnStrips, settings: StripSettings) -> Block:
    """Return `block` of shifts alone, with `strip` fixed in the directions that control does not determine.

    These are determined worse than by a trajectory: control on level ground says nothing about X and Y.
    """
    found = [(f.patches.normal[f.found.patch[f.fits]], f.sigma[f.fits]) for f in seen.control]
    normal, sigma = (np.concatenate(v) for v in zip(*found, strict=True))
    weighed = normal / sigma[:, None]
    known, axes = np.linalg.eigh(weighed.T @ weighed)
    told = known > settings.sigma_position_m**-2
    # At least the direction that control determines best, if there is any.
    told[-1] = len(sigma) > 0
    if told.all():
        return block
    covariance = (axes * np.where(told, _FREE_M, _RIGHT_M) ** 2) @ axes.T
    first = TrajectoryKnot(Weighted(np.zeros(3), covariance=covariance), FIXED)  # type: ignore[arg-type]
    more = block.priors.more
    knots = {**more[TrajectoryKnot.kind], strip: first}
    return dataclasses.replace(
        block, priors=dataclasses.replace(block.priors, more=more | {TrajectoryKnot.kind: knots})
    )


def _far(metres: float) -> str:
    return f"{metres:.0f} m" if metres < _KILOMETRES else f"{metres / 1000:.0f} km"


def _without_shift(
    normal: Float[np.ndarray, "n 3"], gap: Float[np.ndarray, "n"], sigma: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Return gaps without their most common shift (of least absolute deviations).

    It includes the effect of a blunder among few points on the strips.
    """
    off = gap
    for k in range(_TURNS):
        weight = 1 / np.sqrt(sigma * (np.maximum(np.abs(off), _SMALL * sigma) if k else sigma))
        # Directions that are hardly determined stay unchanged.
        shift = np.linalg.lstsq(normal * weight[:, None], gap * weight, rcond=_UNTOLD)[0]
        off = gap - normal @ shift
    return off


def _of(seen: PointPlanes, chosen: Bool[np.ndarray, "n"]) -> PointPlanes:
    found = type(seen.found)(*(v[chosen] for v in seen.found))
    return seen._replace(found=found, sigma=seen.sigma[chosen], fits=seen.fits[chosen])


def _again(block: Block, control: SurveyedPoints) -> Bool[np.ndarray, "points"]:
    """Return which control also belongs to the block. Raises InputError for names of other points there."""
    place, again = {name: k for k, name in enumerate(block.points)}, np.zeros(len(control.ids), bool)
    surveyed = [(rows.who, rows.axis, np.asarray(rows.value)) for rows in (block.control, block.fixed)]
    who, axis, value = (np.concatenate(v) for v in zip(*surveyed, strict=True))
    for k, name in enumerate(control.ids):
        if control.check[k] or name not in place:
            continue
        own = who == place[name]
        off = np.abs(value[own] - control.coordinates[k, axis[own]])
        if not own.any() or (off > _SAME * control.sigma_m[k, axis[own]]).any():
            how = f"{off.max():.3f} m away" if own.any() else "without being control there"
            raise InputError(
                f"{control.places[k]}: {name} is a point of the block, too, {how}: give it the same coordinates in "
                "the control of both, or another name"
            )
        again[k] = True
    return again
