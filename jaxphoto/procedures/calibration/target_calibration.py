"""Camera calibration from the targets of a board in photographs.

1. Compute initial values: distortion and principal distance from homographies of a flat board (`start`), resection.

2. Adjust with self-calibration; the points of the board are fixed, or weighted.

3. Reject photographs that do not fit and blunders among the image points. Image points get the standard deviation of
measurement, board and model (`added_sigma`). Centres of circles are corrected for their eccentricity. Steps 2 and 3
repeat to convergence (`Calibration.settled`), at most twenty times.

Residuals are in the measured image, whatever the direction of the distortion.

Eccentricity: the image of a circle is an ellipse (bent by the lens). The measurement is the centre of the ellipse
nearest to its edge, which is not the image of the circle's centre. Both follow from the adjusted orientation, the plane
and the radius of the circle. With the boundary b(t), 0 <= t < 2 pi, projected through the camera, Green's theorem gives
area, centroid and second moments of the image,

    A = 1/2 int (b x b') dt,   m = 1/(3 A) int b (b x b') dt,   M = 1/(4 A) int (b - m) (b - m)' ((b - m) x b') dt.

From their ellipse, Q = (4 M)^-1 = L L', Gauss-Newton steps lead to the nearest one,

    int e^2 |b'| dt -> min,   e = rho (rho - 1) / |L L' d|,   rho = |L' d|,   d = b - centre.

The trapezoidal rule converges exponentially on a smooth closed curve: 32 points reach machine precision. Without
distortion the centres of area, of the nearest ellipse and of the conic coincide. With distortion the first two differ
by up to a few hundredths of a pixel, for circles of a hundred pixels at a steep angle in the corner.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment import MAX_STEPS, Adjustment
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, Sensor, Smac, get_parameter, parameter_names, rebalance, set_parameter
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.initial.rays import padded_length
from jaxphoto.linear_algebra import cholesky, inverse, solve
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.calibration.start import (
    CAMERA,
    Board,
    Detection,
    TargetRows,
    calibration_block,
    distortion_model,
    free_parameters,
    nearest_distortion,
    reprojection_residuals,
    resected,
    rms_px,
    rough_interior,
)
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import covariance
from jaxphoto.unknowns import FIXED

_POINTS = 32
# Number of Gauss-Newton steps from the ellipse of the moments, which differs by the distortion only.
_STEPS = 3


def eccentricity(
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    centre: Float[Array, "3"],
    axes: Float[Array, "3 2"],
    radius_m: Float[Array, ""],
) -> Float[Array, "2"]:
    """Return the centre of the ellipse nearest to a circle's image minus the image of its centre (mm, measured image).

    `centre` (m) and `axes`, two orthogonal unit vectors in the plane of the circle, are in the object frame.
    """

    def boundary(t):
        point = centre + radius_m * (axes[:, 0] * jnp.cos(t) + axes[:, 1] * jnp.sin(t))
        return project(interior, exterior, point)

    about = project(interior, exterior, centre)
    t = jnp.arange(_POINTS) * (2 * jnp.pi / _POINTS)
    b, slope = jax.vmap(lambda t: jax.jvp(boundary, (t,), (1.0,)))(t)
    # Subtract the image of the centre, to preserve digits of the small difference, and divide by the circle's size.
    b = b - about
    cross = b[:, 0] * slope[:, 1] - b[:, 1] * slope[:, 0]
    size = jnp.sqrt(jnp.abs(jnp.sum(cross)))
    b, slope, cross = b / size, slope / size, cross / size**2
    centroid = 2 / 3 * jnp.sum(b * cross[:, None], axis=0) / jnp.sum(cross)
    d = b - centroid
    about_centroid = d[:, 0] * slope[:, 1] - d[:, 1] * slope[:, 0]
    moments = jnp.einsum("ti,tj,t->ij", d, d, about_centroid) / (2 * jnp.sum(cross))
    lower = cholesky(inverse(4 * moments))
    ellipse = jnp.stack([*centroid, lower[0, 0], lower[1, 0], lower[1, 1]])
    weight = jnp.linalg.norm(slope, axis=1)[:, None]
    for _ in range(_STEPS):
        columns = jax.jacfwd(_distances)(ellipse, b)
        ellipse -= solve(columns.T @ (weight * columns), columns.T @ (weight[:, 0] * _distances(ellipse, b)))
    return size * ellipse[:2]


def _distances(ellipse: Float[Array, "5"], b: Float[Array, "points 2"]) -> Float[Array, "points"]:
    """Return distances of points from an ellipse (column, row and three elements of L) to first order."""
    x, y = b[:, 0] - ellipse[0], b[:, 1] - ellipse[1]
    u, v = ellipse[2] * x + ellipse[3] * y, ellipse[4] * y
    # XLA without optimisation differentiates jnp.hypot wrongly (jax 0.10.2).
    rho = jnp.sqrt(u**2 + v**2)
    return rho * (rho - 1) / jnp.sqrt((ellipse[2] * u) ** 2 + (ellipse[3] * u + ellipse[4] * v) ** 2)


def eccentricities(
    interior: InteriorOrientation,
    position: Float[np.ndarray, "rows 3"],
    camera_from_object: Float[np.ndarray, "rows 3 3"],
    centre: Float[np.ndarray, "rows 3"],
    axes: Float[np.ndarray, "3 2"],
    radius_m: Float[np.ndarray, "rows"],
) -> Float[np.ndarray, "rows 2"]:
    """Return `eccentricity` (mm) of one circle in one image per row, all in planes parallel to `axes`; 0 for a radius
    of 0.
    """
    n = len(centre)
    some = np.arange(padded_length(n)) % n
    # Replace a radius of 0, which has no area; its result is discarded.
    radius = np.where(radius_m > 0, radius_m, max(float(np.max(radius_m)), 1e-12))
    numbers = jax.tree.map(lambda v: np.asarray(v, float), interior)
    arguments = (numbers, position[some], camera_from_object[some], centre[some], axes, radius[some])
    offsets = np.asarray(call_compiled(_eccentricities, *arguments))[:n]
    return np.where(radius_m[:, None] > 0, offsets, 0.0)


@eqx.filter_jit
def _eccentricities(interior, position, camera_from_object, centre, axes, radius):
    one = lambda x, m, p, r: eccentricity(interior, ExteriorOrientation(x, m), p, axes, r)  # noqa: E731
    return jax.vmap(one)(position, camera_from_object, centre, radius)


# Maximum normalised residual: one valid image point of 270,000 exceeds it.
_LIMIT = 5.0
# Minimum ratio of a blunder to the largest one of its image for both to be rejected together.
_NEARLY = 0.5
# Maximum median residual of a photograph: ratio to the typical one, and in pixels.
_IMAGE_LIMIT, _IMAGE_PX = 5.0, 2.0
# Median length of a vector with two standard normal components.
_MEDIAN = float(np.sqrt(2 * np.log(2)))


def blunders(
    residuals: Float[np.ndarray, "n 2"], sigma: Float[np.ndarray, "n 2"], image: Int[np.ndarray, "n"], n_images: int
) -> Bool[np.ndarray, "n"]:
    """Mark image points with residuals of more than five sigma, scaled by the median of all.

    Per image, only residuals of at least half the largest are marked: a blunder distorts the orientation and the
    residuals of valid points.
    """
    size = np.linalg.norm(residuals / sigma, axis=1)
    largest = np.zeros(n_images)
    np.maximum.at(largest, image, size)
    return (size >= _NEARLY * largest[image]) & (size > _LIMIT * max(float(np.median(size)) / _MEDIAN, 1e-12))


def misfits(
    residuals: Float[np.ndarray, "n 2"], image: Int[np.ndarray, "n"], n_images: int
) -> Bool[np.ndarray, "images"]:
    """Mark images whose median residual exceeds two pixels and five times the typical one."""
    size = np.linalg.norm(residuals, axis=1)
    typical = np.array([np.median(size[image == k]) for k in range(n_images)])
    return (typical > _IMAGE_LIMIT * np.median(typical)) & (typical > _IMAGE_PX)


def added_sigma(residuals: Float[np.ndarray, "n 2"], sigma: Float[np.ndarray, "n 2"], redundancy: int) -> float:
    """Estimate the sigma a (px) that explains the residuals together with `sigma`: sum v^2 / (sigma^2 + a^2) = r.

    Return zero if `sigma` alone explains them. It models an uneven board, a rolling shutter, or a distortion model with
    too few coefficients; without it the most accurate points would have too much weight.
    """
    square, variance = residuals**2, sigma**2

    def excess(added: float) -> float:
        return float(np.sum(square / (variance + added**2))) - redundancy

    largest = float(np.sqrt(np.sum(square) / max(redundancy, 1)))
    if redundancy <= 0 or largest == 0 or excess(0.0) <= 0:
        return 0.0
    return float(scipy.optimize.brentq(excess, 0.0, largest, xtol=1e-9 * largest))


MIN_IMAGES = 3
_MIN_POINTS = 6
_ROUNDS = 20
# Maximum change (px) of the added standard deviation and of the centres of circles at convergence.
_STILL_PX = 1e-4
# Standard deviation (px) of all image points in the first iteration.
_FIRST_SIGMA_PX = 1.0
# First-order parameters of a lens, estimated first if the adjustment of all parameters does not converge.
_FIRST = ("c_mm", "k1", "k2", "a1", "a2", "a14")


@pretty_repr
class Calibration(NamedTuple):
    """Calibrated camera and rejected observations."""

    adjusted: Adjustment
    board: Board
    measured: TargetRows
    """Accepted image points, as measured, with the standard deviations of the measurement."""
    residuals_px: Float[np.ndarray, "rows 2"]
    """Measured minus projected (column, row), in the order of `measured` and of the block's image points."""
    eccentricity_px: Float[np.ndarray, "rows 2"]
    """Correction (column, row) of the measured centres of circles, in the same order."""
    added_sigma_px: float
    """Standard deviation of board, shutter and model, in addition to the measurement error."""
    left_out: dict[str, str]
    """Rejected photographs, with the reason."""
    removed: tuple[tuple[str, str], ...]
    """(image, point) of rejected image points."""
    settled: bool
    """False if the last iteration still changed image points, sigmas or centres of circles."""

    @property
    def converged(self) -> bool:
        """True if the last adjustment converged and the iteration settled."""
        return bool(self.adjusted.converged) and self.settled

    @property
    def sensor(self) -> Sensor:
        """Image format."""
        return self.adjusted.block.sensors[CAMERA]

    @property
    def interior(self) -> InteriorOrientation:
        """Interior orientation."""
        return self.adjusted.unknowns.interior[CAMERA]

    @property
    def rms_px(self) -> float:
        """RMS of the residuals, both axes together, in the measured image: sqrt(sum(dx^2 + dy^2) / n), as in OpenCV."""
        return rms_px(self.residuals_px)


def calibrate(
    board: Board,
    detections: Sequence[Detection],
    sensor: Sensor,
    start: InteriorOrientation | None = None,
    *,
    model: str = "smac",
    r0_mm: float = 0.0,
    free: Sequence[str] | None = None,
    board_sigma_m: float | None = None,
    max_steps: int = MAX_STEPS,
) -> Calibration:
    """Calibrate the camera that took photographs of a board.

    `start` is the initial camera, such as c from EXIF; a tilted flat board needs none. `model` is the name of a
    distortion in block.toml, `r0_mm` the balance radius of SMAC, `free` the parameters to estimate (`free_parameters`).
    The points of the board are fixed, or have the standard deviation `board_sigma_m` (m) on each axis.

    Raises InputError for an unknown model or parameter and for fewer than three usable photographs, and the errors of
    `adjust`.
    """
    distortion = distortion_model(model, sensor, r0_mm)
    names = free_parameters(model, distortion, free)
    left_out = {d.image: f"{len(d.point)} targets found" for d in detections if len(d.point) < _MIN_POINTS}
    used = [d for d in detections if d.image not in left_out]
    _check_enough(len(used), len(detections))
    rows = TargetRows.of(used, sensor)
    rough = rough_interior(board, rows, sensor, start)
    if start is not None:
        # Parameters that are not estimated stay at their given values.
        for name in {"c_mm", "xp_mm", "yp_mm"}.difference(names):
            rough = set_parameter(rough, name, float(get_parameter(start, name)))
    exterior, why = resected(board, rows, rough)
    left_out |= why
    rows = rows.take(np.array([rows.images[k] not in why for k in rows.image], bool))
    _check_enough(len(rows.images), len(detections))
    interior = nearest_distortion(rough, distortion_model(model, sensor), names, sensor)
    if isinstance(distortion, Smac) and r0_mm:
        interior = rebalance(interior, r0_mm)

    added: float | None = None
    correction, removed = np.zeros_like(rows.xy_mm), []
    for round_ in range(_ROUNDS):
        sigma = np.hypot(rows.sigma_mm, (_FIRST_SIGMA_PX if added is None else added) * sensor.pixel_mm)
        weighed = rows._replace(xy_mm=rows.xy_mm - correction, sigma_mm=sigma)
        block = calibration_block(board, weighed, sensor, interior, exterior, names, board_sigma_m)
        adjusted = _adjusted(block, max_steps)
        interior, exterior = adjusted.unknowns.interior[CAMERA], _still(adjusted.unknowns.exterior)
        residuals = reprojection_residuals(adjusted)
        before, correction = correction, _image_eccentricities(board, rows, interior, exterior)
        turned = float(np.max(np.linalg.norm(correction - before, axis=1), initial=0.0)) / sensor.pixel_mm
        misfit = misfits(residuals, rows.image, len(rows.images))
        large = blunders(residuals, sigma / sensor.pixel_mm, rows.image, len(rows.images))
        # A residual smaller than the last change of the eccentricity is not a blunder.
        good = ~misfit[rows.image] & ~(large & (np.linalg.norm(residuals, axis=1) > turned))
        redundancy = adjusted.redundancy - 2 * int((~good).sum())
        last, added = added, added_sigma(residuals[good], rows.sigma_mm[good] / sensor.pixel_mm, redundancy)
        settled = bool(good.all()) and turned < _STILL_PX and last is not None and abs(added - last) < _STILL_PX
        if settled or round_ == _ROUNDS - 1:
            break
        left_out |= {rows.images[k]: "it does not fit the others" for k in np.flatnonzero(misfit)}
        few = np.bincount(rows.image[good], minlength=len(rows.images)) < _MIN_POINTS
        left_out |= {rows.images[k]: "too few targets without blunders" for k in np.flatnonzero(few & ~misfit)}
        out = ~good & ~misfit[rows.image] & ~few[rows.image]
        removed += [(rows.images[i], board.points[p]) for i, p in zip(rows.image[out], rows.point[out], strict=True)]
        good &= ~few[rows.image]
        stay = np.unique(rows.image[good])
        exterior = jax.tree.map(lambda v: v[stay], exterior)  # noqa: B023
        rows, correction = rows.take(good), correction[good]
        _check_enough(len(rows.images), len(detections))
    return Calibration(
        adjusted=adjusted,
        board=board,
        measured=rows,
        residuals_px=residuals,
        eccentricity_px=before / (sensor.pixel_mm, -sensor.pixel_mm),
        added_sigma_px=last or 0.0,
        left_out=left_out,
        removed=tuple(removed),
        settled=settled,
    )


def _check_enough(images: int, total: int) -> None:
    if images < MIN_IMAGES:
        raise InputError(
            f"{images} of {total} photographs show enough of the board, but a calibration needs {MIN_IMAGES}: take "
            "more photographs, with the board tilted and rotated"
        )


def _adjusted(block: Block, max_steps: int) -> Adjustment:
    """Adjust; if that does not converge, first estimate c and the first radial coefficients only."""
    adjusted = adjust(block, max_steps=max_steps)
    if bool(adjusted.converged):
        return adjusted
    interior = block.priors.interior[CAMERA]
    names = {"xp_mm", "yp_mm", *interior.distortion.coefficients} - set(_FIRST)
    for name in names:
        interior = set_parameter(interior, name, FIXED)
    first = adjust(block, priors=eqx.tree_at(lambda p: p.interior[CAMERA], block.priors, interior), max_steps=max_steps)
    start = dataclasses.replace(block.start, unknowns=first.unknowns)
    return adjust(dataclasses.replace(block, start=start), max_steps=max_steps)


def _still(exterior: ExteriorOrientation) -> ExteriorOrientation:
    return jax.tree.map(np.asarray, exterior)


def _image_eccentricities(board, rows, interior, exterior) -> Float[np.ndarray, "rows 2"]:
    """Return eccentricities (mm in the image); zero for corners and for a board that is not flat."""
    if not board.diameter_m.any() or board.plane is None:
        return np.zeros_like(rows.xy_mm)
    return eccentricities(
        interior,
        exterior.position[rows.image],
        exterior.camera_from_object[rows.image],
        board.xyz_m[rows.point],
        board.plane[1][:, :2],
        board.diameter_m[rows.point] / 2,
    )


def interior_covariance(adjusted: Adjustment) -> Float[np.ndarray, "parameters parameters"]:
    """Return the a posteriori covariance of the camera of a calibration, in the order and units of `parameter_names`.

    Rows and columns of fixed parameters are zero. Image points are assumed to be independent.
    """
    return covariance(adjusted).of_interior(CAMERA, parameter_names(adjusted.unknowns.interior[CAMERA]))
