"""Surveyed points on smooth surfaces of strips: the datum that strips do not determine.

A point belongs to the block, with its coordinates observed once for any number of strips: its survey error is common to
all strips.
"""

import dataclasses
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import Scanner, ScannerCalibration, StripErrors, TrajectoryKnot
from jaxphoto.lidar.correction import ScannerPath
from jaxphoto.lidar.strip_planes import StripSettings, fitting
from jaxphoto.observations import StripPoints
from jaxphoto.observations.strip_planes import return_at
from jaxphoto.procedures.control.marks import Marked, into_block
from jaxphoto.procedures.control.surveyed import SurveyedPoints
from jaxphoto.procedures.lidar.plane_search import PointPlanes, PointSearch, StripSearch
from jaxphoto.procedures.lidar.strip_model import Side, side_of
from jaxphoto.statistics import Covariance
from jaxphoto.unknowns import FIXED, Weighted

CONTROL, CHECK = "control", "check points"
"""Names of surveyed points in tables of differences."""
# Maximum distance (m) of a strip from control in the same system; larger ones indicate another height system, or feet.
_FAR_M = 10.0
# Prior sigmas (m) of a strip: in fixed directions, small compared with control; in free directions, large.
_RIGHT_M, _FREE_M = 1e-3, 100.0
# Number of reweighting iterations for the common shift of control; number of standard deviations below which gaps have
# equal weight; ratio of singular values below which a direction is undetermined.
_TURNS, _SMALL, _UNTOLD = 30, 0.1, 0.01
# Maximum difference, in standard deviations of the survey, of two surveys of one point.
_SAME = 4.0
_NO_MARKS = Marked(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))


class OnStrips(NamedTuple):
    """Surveyed points above planes of each look; all check points are accepted, because nothing depends on them."""

    control: list[PointPlanes]
    check: list[PointPlanes]


class ControlSearch:
    """Search for strip planes at surveyed points (constant coordinates).

    `number`: index of each point in the block, -1 for check points.
    """

    def __init__(self, search: StripSearch, control: SurveyedPoints, number: Int[np.ndarray, "points"]) -> None:
        self.search, self.control = search, control
        self._points = PointSearch(search, number)
        variances = control.sigma_m**2
        self._spread = variances[:, :, None] * np.eye(3)

    def look(self, settled: bool) -> OnStrips:
        """Return the planes at the points, in the strips last corrected by `StripSearch`."""
        seen = self._points.look(self.control.coordinates, self._spread, settled)
        control = [_select_planes(f, ~self.control.check[f.found.point]) for f in seen]
        # Test all strips together: a few points of one strip do not show which of them is a blunder.
        found = [(f.patches.normal[f.found.patch], f.found.gap, f.sigma) for f in control]
        normal, gap, sigma = (np.concatenate(v) for v in zip(*found, strict=True))
        fit = fitting(_remove_common_shift(normal, gap, sigma), sigma, self.search.settings.outlier)
        fits = np.split(fit, np.cumsum([len(f.fits) for f in control]))
        check = [_select_planes(f, self.control.check[f.found.point]) for f in seen]
        return OnStrips(
            [f._replace(fits=own) for f, own in zip(control, fits, strict=False)],
            [f._replace(fits=np.ones(len(f.fits), bool)) for f in check],
        )

    def rows(self, seen: OnStrips, errors: StripErrors) -> tuple[StripPoints, ...]:
        """Return the accepted control as observations: one group, or none."""
        return self._points.rows(seen.control, errors)


def with_control(block: Block, control: SurveyedPoints) -> tuple[Block, Int[np.ndarray, "points"]]:
    """Return `block` with the control observed, and the index of each point; -1 for check points, which are not added.

    Control of the block with the same name is the same point, surveyed once. Raises InputError for points without a
    height or a standard deviation, and for other points of the block with the same name.
    """
    check_complete(control)
    again = _also_in_block(block, control)
    new = np.flatnonzero(~control.check & ~again)
    ids, xyz, sigma = tuple(control.ids[k] for k in new), control.coordinates[new], control.sigma_m[new]
    every = np.ones(len(new), bool)
    whole = into_block(block, ids, xyz, sigma, xyz, _NO_MARKS, every, ~every)
    place = {name: k for k, name in enumerate(whole.points)}
    number = [-1 if out else place[name] for name, out in zip(control.ids, control.check, strict=True)]
    return whole, np.array(number, int)


def check_complete(control: SurveyedPoints) -> None:
    """Raise InputError for points without a height or a standard deviation."""
    for k, (xyz, sigma) in enumerate(zip(control.coordinates, control.sigma_m, strict=True)):
        at = f"{control.places[k]}: point {control.ids[k]}"
        if not np.isfinite(xyz).all():
            raise InputError(f"{at} has no height: add Z_m")
        if not (sigma > 0).all():
            raise InputError(f"{at} has no standard deviations: add sigma_X_m, sigma_Y_m and sigma_Z_m")


def check_seen(control: SurveyedPoints, surveyed: OnStrips, search: StripSearch) -> None:
    """Raise BlockError for surveyed points away from the strips, in plan or in height."""
    gap = np.concatenate([f.found.gap for f in (*surveyed.control, *surveyed.check)])
    settings = search.settings
    if not len(gap):
        low, high = search.cloud.extent
        offset = np.maximum(np.maximum(low - control.coordinates, control.coordinates - high), 0.0)[:, :2]
        away = float(np.median(np.linalg.norm(offset, axis=1)))
        if away > 0:
            raise BlockError(
                f"the points of {control.file} lie {away:.0f} m from the strips: give them in the cloud's coordinate "
                "system and in metres, easting first"
            )
        raise BlockError(
            f"no point of {control.file} lies on a plane of a strip ({settings.returns} returns within "
            f"{settings.cell_m:g} m, scatter at most {settings.roughness_m:g} m): give points on smooth, open "
            "surfaces, or increase --cell-m or --roughness-m"
        )
    offset = float(np.median(gap))
    if abs(offset) > _FAR_M:
        raise BlockError(
            f"the points of {control.file} are {abs(offset):.1f} m {'above' if offset > 0 else 'below'} the strips: "
            "check the height unit and vertical datum of both"
        )


def with_datum(block: Block, strip: str, surveyed: OnStrips, settings: StripSettings) -> Block:
    """Return `block` of shifts alone, with `strip` fixed in the directions that control does not determine.

    A direction is undetermined if a trajectory would determine it better: control on level ground does not determine X
    and Y.
    """
    planes = [(f.patches.normal[f.found.patch[f.fits]], f.sigma[f.fits]) for f in surveyed.control]
    normal, sigma = (np.concatenate(v) for v in zip(*planes, strict=True))
    weighed = normal / sigma[:, None]
    eigenvalues, axes = np.linalg.eigh(weighed.T @ weighed)
    determined = eigenvalues > settings.sigma_position_m**-2
    # The direction that control determines best is always free, if there is control.
    determined[-1] = len(sigma) > 0
    if determined.all():
        return block
    covariance = (axes * np.where(determined, _FREE_M, _RIGHT_M) ** 2) @ axes.T
    first = TrajectoryKnot(Weighted(np.zeros(3), covariance=covariance), FIXED)  # type: ignore[arg-type]
    more = block.priors.more
    knots = {**more[TrajectoryKnot.kind], strip: first}
    return dataclasses.replace(
        block, priors=dataclasses.replace(block.priors, more=more | {TrajectoryKnot.kind: knots})
    )


def _remove_common_shift(
    normal: Float[np.ndarray, "n 3"], gap: Float[np.ndarray, "n"], sigma: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Remove the common shift (least absolute deviations) from the gaps.

    A blunder among few points affects the shifts of strips, hence many gaps: the common shift removes this effect.
    """
    remaining = gap
    for k in range(_TURNS):
        weight = 1 / np.sqrt(sigma * (np.maximum(np.abs(remaining), _SMALL * sigma) if k else sigma))
        # The shift is zero in directions that are hardly determined.
        shift = np.linalg.lstsq(normal * weight[:, None], gap * weight, rcond=_UNTOLD)[0]
        remaining = gap - normal @ shift
    return remaining


def _select_planes(planes: PointPlanes, chosen: Bool[np.ndarray, "n"]) -> PointPlanes:
    selected = type(planes.found)(*(v[chosen] for v in planes.found))
    return planes._replace(found=selected, sigma=planes.sigma[chosen], fits=planes.fits[chosen])


def _also_in_block(block: Block, control: SurveyedPoints) -> Bool[np.ndarray, "points"]:
    """Mark control that also belongs to the block. Raises InputError if it differs there or is not control."""
    place, again = {name: k for k, name in enumerate(block.points)}, np.zeros(len(control.ids), bool)
    surveyed = [(rows.who, rows.axis, np.asarray(rows.value)) for rows in (block.control, block.fixed)]
    who, axis, value = (np.concatenate(v) for v in zip(*surveyed, strict=True))
    for k, name in enumerate(control.ids):
        if control.check[k] or name not in place:
            continue
        of_point = who == place[name]
        difference = np.abs(value[of_point] - control.coordinates[k, axis[of_point]])
        if not of_point.any() or (difference > _SAME * control.sigma_m[k, axis[of_point]]).any():
            how = f"{difference.max():.3f} m away" if of_point.any() else "without being control there"
            raise InputError(
                f"{control.places[k]}: {name} is also a point of the block, {how}: give it the same coordinates in "
                "the control of both, or another name"
            )
        again[k] = True
    return again


# Gap between each surveyed point and each strip after the adjustment, with its expected scatter.
#
# The gap g = n . (X - F') of a surveyed point X above its foot point F' on the plane of a strip has the variance s^2 of
# plane and survey. F' depends on the unknowns x with covariance C: a = d(n . F')/dx. The unknowns have absorbed part of
# the errors of adjusted control:
#
#     var(g) = s^2 - a C a'    for adjusted control,        s^2 + a C a'    for check points, and rejected control
#
# The test statistic w is g divided by its standard deviation (Baarda 1968), standard normal without blunders.

# Ratio sigma of the adjusted gap / sigma of its noise below which the gap is uncontrolled (redundancy near zero).
_UNTESTED = 1e-3


class SurveyedGap(NamedTuple):
    """Surveyed point above the plane of a strip."""

    point: str
    role: Literal["control", "check"]
    strip: str
    dX_m: float
    """Surveyed point minus its foot point on the corrected plane of the strip."""
    dY_m: float
    dZ_m: float
    gap_m: float
    """Length of (dX, dY, dZ), positive if the point lies above the plane."""
    noise_m: float
    """Standard deviation of plane and survey."""
    sigma_m: float
    """Standard deviation of `gap_m`, a priori."""
    w: float
    """gap / sigma; NaN if uncontrolled."""
    used: bool
    """True if the point is in the adjustment."""


def surveyed_gaps(
    control: SurveyedPoints,
    surveyed: OnStrips,
    errors: StripErrors,
    path: ScannerPath | None,
    adjusted: Adjustment,
    cov: Covariance,
) -> tuple[SurveyedGap, ...]:
    """Return the gaps of surveyed points for each strip with a plane near them; `errors`: adjusted strip errors."""
    gaps: list[SurveyedGap] = []
    roles: tuple[tuple[Literal["control", "check"], list[PointPlanes]], ...]
    roles = (("control", surveyed.control), ("check", surveyed.check))
    for role, looks in roles:
        for f in (f for f in looks if len(f.fits)):
            moves, used = _variance_of_foot(f, errors, path, adjusted, cov), f.fits & (role == "control")
            variance = f.sigma**2 + np.where(used, -moves, moves)
            sigma = np.sqrt(np.maximum(variance, 0.0))
            w = np.where(sigma > _UNTESTED * f.sigma, f.found.gap / np.maximum(sigma, np.finfo(float).tiny), np.nan)
            offset = f.found.gap[:, None] * f.patches.normal[f.found.patch]
            rows = zip(f.found.point, offset.tolist(), f.found.gap, f.sigma, sigma, w, used, strict=True)
            for p, (dx, dy, dz), *numbers, within in rows:
                gap, noise, sigma_of_gap, test = map(float, numbers)
                name, strip = control.ids[p], f.look.name
                gaps.append(SurveyedGap(name, role, strip, dx, dy, dz, gap, noise, sigma_of_gap, test, bool(within)))
    return tuple(gaps)


def _variance_of_foot(
    f: PointPlanes, errors: StripErrors, path: ScannerPath | None, adjusted: Adjustment, cov: Covariance
) -> Float[np.ndarray, "n"]:
    """Return the a priori variance a C a' of the foot point."""
    side = side_of(f.patches, f.found.patch, f.found.foot, f.look.strip, errors, path)
    errors_at = np.concatenate([errors.position, errors.attitude], axis=1)[side.knots]
    errors_at = np.einsum("nk,nkc->nc", side.weights, errors_at)
    normal = f.patches.normal[f.found.patch]
    by_knots, *by_scanner = call_compiled(_slopes, side, normal, errors_at, errors.boresight, errors.calibration)
    place = {label: k for k, label in enumerate(adjusted.structure.labels)}
    # Fixed unknowns have index -1: collect them in an extra column, which is removed.
    a = np.zeros((len(normal), len(place) + 1))
    knot = TrajectoryKnot(np.zeros(3), np.zeros(3))  # type: ignore[arg-type]
    owners, rows = list(adjusted.unknowns.more[TrajectoryKnot.kind]), np.arange(len(normal))
    at = np.array([[place.get(label, -1) for label in knot.labels(owner)] for owner in owners])
    for k in range(side.knots.shape[1]):
        np.add.at(a, (rows[:, None], at[side.knots[:, k]]), side.weights[:, k, None] * np.asarray(by_knots))
    labels = *Scanner(errors.boresight, {}).labels(""), *errors.calibration.labels("")  # type: ignore[arg-type]
    for label, slopes in zip(labels, np.concatenate(by_scanner, axis=1).T, strict=True):
        a[:, place.get(label, -1)] = slopes
    a = a[:, :-1]
    return np.einsum("ni,ij,nj->n", a, np.asarray(cov.matrix)[-a.shape[1] :, -a.shape[1] :], a)


@eqx.filter_jit
def _slopes(
    side: Side,
    normal: Float[Array, "n 3"],
    offset: Float[Array, "n 6"],
    boresight: Float[Array, "3"],
    calibration: ScannerCalibration,
) -> tuple[Float[Array, "n 6"], Float[Array, "n 3"], Float[Array, "n calibrated"]]:
    """Differentiate the height of the foot point along n by trajectory error, boresight and scanner calibration."""
    numbers, back = ravel_pytree(calibration)

    def height(offset, boresight, numbers, normal, point, position, angles, velocity, rate):
        errors = TrajectoryKnot(offset[:3], offset[3:]), Scanner(boresight, {}), back(numbers)
        return jnp.sum(normal * return_at(point, position, angles, velocity, rate, *errors))

    pose = side.point, side.scanner, side.roll_pitch_yaw, side.velocity, side.rate
    slopes = jax.vmap(jax.grad(height, argnums=(0, 1, 2)), (0, None, None, *[0] * 6))
    return slopes(offset, boresight, numbers, normal, *pose)
