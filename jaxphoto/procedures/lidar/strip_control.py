"""Surveyed points on smooth surfaces of strips: the datum that strips cannot provide themselves.

A point belongs to the block, with its coordinates observed once for any number of strips: its survey error is common to
all of them.
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
        control = [_select_planes(f, ~self.control.check[f.found.point]) for f in seen]
        # All strips together: a few points of one strip do not show which of them is a blunder.
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
        """Return the fitting control as observations: one group, if there are any."""
        return self._points.rows(seen.control, errors)


def with_control(block: Block, control: SurveyedPoints) -> tuple[Block, Int[np.ndarray, "points"]]:
    """Return `block` with the control observed, and the index of each; -1 for check points, which it does not need.

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
            raise InputError(f"{at} has no height, without which nothing says how far it is from a plane: add Z_m")
        if not (sigma > 0).all():
            raise InputError(
                f"{at} has no standard deviations, which say how near to a plane it must be: add sigma_X_m, sigma_Y_m "
                "and sigma_Z_m"
            )


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
                f"the points of {control.file} lie {_far(away)} from the strips: give them in the cloud's coordinate "
                "system and in metres, easting first"
            )
        raise BlockError(
            f"no point of {control.file} lies on a plane of a strip, which is {settings.returns} returns about it, in "
            f"{settings.cell_m:g} m, that scatter by {settings.roughness_m:g} m at most: give points on smooth, open "
            "surfaces, or take larger cells (--cell-m) or rougher planes (--roughness-m)"
        )
    offset = float(np.median(gap))
    if abs(offset) > _FAR_M:
        raise BlockError(
            f"the points of {control.file} lie {abs(offset):.1f} m {'above' if offset > 0 else 'below'} the strips: "
            "its heights may count in feet or belong to another vertical system than those of the cloud; bring both "
            "into one"
        )


def with_datum(block: Block, strip: str, surveyed: OnStrips, settings: StripSettings) -> Block:
    """Return `block` of shifts alone, with `strip` fixed in the directions that control does not determine.

    These are determined worse than by a trajectory: control on level ground says nothing about X and Y.
    """
    planes = [(f.patches.normal[f.found.patch[f.fits]], f.sigma[f.fits]) for f in surveyed.control]
    normal, sigma = (np.concatenate(v) for v in zip(*planes, strict=True))
    weighed = normal / sigma[:, None]
    eigenvalues, axes = np.linalg.eigh(weighed.T @ weighed)
    determined = eigenvalues > settings.sigma_position_m**-2
    # At least the direction that control determines best, if there is any.
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


def _far(metres: float) -> str:
    return f"{metres:.0f} m" if metres < _KILOMETRES else f"{metres / 1000:.0f} km"


def _remove_common_shift(
    normal: Float[np.ndarray, "n 3"], gap: Float[np.ndarray, "n"], sigma: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Return gaps without their most common shift (of least absolute deviations).

    It includes the effect of a blunder among few points on the strips.
    """
    remaining = gap
    for k in range(_TURNS):
        weight = 1 / np.sqrt(sigma * (np.maximum(np.abs(remaining), _SMALL * sigma) if k else sigma))
        # Directions that are hardly determined stay unchanged.
        shift = np.linalg.lstsq(normal * weight[:, None], gap * weight, rcond=_UNTOLD)[0]
        remaining = gap - normal @ shift
    return remaining


def _select_planes(planes: PointPlanes, chosen: Bool[np.ndarray, "n"]) -> PointPlanes:
    selected = type(planes.found)(*(v[chosen] for v in planes.found))
    return planes._replace(found=selected, sigma=planes.sigma[chosen], fits=planes.fits[chosen])


def _also_in_block(block: Block, control: SurveyedPoints) -> Bool[np.ndarray, "points"]:
    """Return which control also belongs to the block. Raises InputError for names of other points there."""
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
                f"{control.places[k]}: {name} is a point of the block, too, {how}: give it the same coordinates in "
                "the control of both, or another name"
            )
        again[k] = True
    return again


# Gap between each surveyed point and each strip after the adjustment, with its expected scatter.
#
# A gap g = n . (X - F') of a surveyed place X above the foot F' on the plane of a strip has the variance s^2 of plane
# and survey, and F' depends on the unknowns x, of covariance C, by a = d(n . F')/dx. Adjusted observations have
# absorbed part of their errors, others have not:
#
#     var(g) = s^2 - a C a'    for adjusted control,        s^2 + a C a'    for check points, and rejected control
#
# and g over its standard deviation is the test value w (Baarda 1968), standard normal without errors.

# Fractions of its noise below which an adjusted gap is uninformative: nothing else checks it.
_UNTESTED = 1e-3


class SurveyedGap(NamedTuple):
    """Surveyed point above the plane of a strip."""

    point: str
    role: Literal["control", "check"]
    strip: str
    dX_m: float
    """Surveyed minus the nearest place on the plane of the strip, corrected."""
    dY_m: float
    dZ_m: float
    gap_m: float
    """Their length, positive if the point lies above."""
    noise_m: float
    """Of plane and survey."""
    sigma_m: float
    """Of `gap_m`, a priori."""
    w: float
    """gap / sigma; NaN if nothing checks it."""
    used: bool
    """True if it is in the adjustment."""


def surveyed_gaps(
    control: SurveyedPoints,
    surveyed: OnStrips,
    errors: StripErrors,
    path: ScannerPath | None,
    adjusted: Adjustment,
    cov: Covariance,
) -> tuple[SurveyedGap, ...]:
    """Return the gaps of surveyed points for each strip with a plane about them; `errors` are the adjusted ones."""
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
    """Return a C a', a priori."""
    side = side_of(f.patches, f.found.patch, f.found.foot, f.look.strip, errors, path)
    errors_at = np.concatenate([errors.position, errors.attitude], axis=1)[side.knots]
    errors_at = np.einsum("nk,nkc->nc", side.weights, errors_at)
    normal = f.patches.normal[f.found.patch]
    by_knots, *by_scanner = call_compiled(_slopes, side, normal, errors_at, errors.boresight, errors.calibration)
    place = {label: k for k, label in enumerate(adjusted.structure.labels)}
    # Fixed unknowns have no place, and contribute nothing.
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
    """Differentiate the height of the foot along the normal by the trajectory's error, the boresight and the rest."""
    numbers, back = ravel_pytree(calibration)

    def height(offset, boresight, numbers, normal, point, position, angles, velocity, rate):
        errors = TrajectoryKnot(offset[:3], offset[3:]), Scanner(boresight, {}), back(numbers)
        return jnp.sum(normal * return_at(point, position, angles, velocity, rate, *errors))

    pose = side.point, side.scanner, side.roll_pitch_yaw, side.velocity, side.rate
    slopes = jax.vmap(jax.grad(height, argnums=(0, 1, 2)), (0, None, None, *[0] * 6))
    return slopes(offset, boresight, numbers, normal, *pose)
