"""The image of a circle's centre is not the centre of the circle's image.

A circle is seen as an ellipse (bent by the lens), and what is measured is the centre of the ellipse that is nearest to
its edge (`jaxphoto.extras.photos.targets`). Both centres are computed from the adjusted orientation, the plane and
the radius of the circle. With the boundary b(t), 0 <= t < 2 pi, projected through the whole camera, Green's theorem
gives area, centroid and second moments of the image,

    A = 1/2 int (b x b') dt,   m = 1/(3 A) int b (b x b') dt,   M = 1/(4 A) int (b - m) (b - m)' ((b - m) x b') dt,

and from the ellipse with these, Q = (4 M)^-1 = L L', Gauss-Newton steps lead to the nearest one,

    int e^2 |b'| dt -> min,   e = rho (rho - 1) / |L L' d|,   rho = |L' d|,   d = b - centre.

On a smooth closed curve the trapezoidal rule converges exponentially: 32 points give every digit. Without distortion
the three centres, of area, of the nearest ellipse and of the conic, are one; with it the first two are up to some
hundredths of a pixel apart, for circles of a hundred pixels seen at a steep angle in the corner.

What of the residuals of a calibration is gross error, and how large the rest is beside the measurement's noise.

Calibration of a camera from the targets of a board found in photographs, in rounds of adjusting and looking.

1. Start: lens and principal distance from the homographies of a flat board (`start`), orientation by resection.
2. Self-calibrating adjustment; the points of the board are fixed, or weighted.
3. Photographs that do not fit and blunders among the image points go; image points get the standard deviation of their
   measurement and what board and model add to it (`outliers.added_sigma`); centres of circles are corrected for their
   eccentricity; and back to 2, until nothing changes (`Calibration.settled`), twenty times at most.

Residuals are those of the measured image, whatever the direction of the distortion.

The covariance of a calibrated interior orientation, as the stability analysis wants it.
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
from jaxphoto.procedures.calibration.start import distortion_model, free_parameters, nearest_distortion, rough_interior
from jaxphoto.procedures.calibration.target_block import (
    CAMERA,
    Board,
    Detection,
    TargetRows,
    calibration_block,
    reprojection_residuals,
    resected,
    rms_px,
)
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import covariance
from jaxphoto.unknowns import FIXED

_POINTS = 32
# From the ellipse of the moments, which is the nearest but for the lens.
_STEPS = 3


def eccentricity(
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    centre: Float[Array, "3"],
    axes: Float[Array, "3 2"],
    radius_m: Float[Array, ""],
) -> Float[Array, "2"]:
    """Centre of the ellipse nearest to a circle's image minus the image of the circle's centre, in mm as measured.

    `centre` (m) and two orthogonal unit vectors in its plane, `axes`, in the object frame. Source: the centre of the
    ellipse is in any book of projective geometry; through a distorting lens it is that of the formulas above.
    """

    def boundary(t):
        point = centre + radius_m * (axes[:, 0] * jnp.cos(t) + axes[:, 1] * jnp.sin(t))
        return project(interior, exterior, point)

    about = project(interior, exterior, centre)
    t = jnp.arange(_POINTS) * (2 * jnp.pi / _POINTS)
    b, slope = jax.vmap(lambda t: jax.jvp(boundary, (t,), (1.0,)))(t)
    # About the centre's image, so that the small difference keeps its digits, and in units of the circle's size.
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
    """Distances of points from an ellipse (column, row and the three of L) to first order."""
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
    """`eccentricity` (mm) of one circle in one image a row, all in planes parallel to `axes`; 0 where the radius is."""
    n = len(centre)
    some = np.arange(padded_length(n)) % n
    # A point has no area: any radius does, and the result is not used.
    radius = np.where(radius_m > 0, radius_m, max(float(np.max(radius_m)), 1e-12))
    numbers = jax.tree.map(lambda v: np.asarray(v, float), interior)
    arguments = (numbers, position[some], camera_from_object[some], centre[some], axes, radius[some])
    found = np.asarray(call_compiled(_eccentricities, *arguments))[:n]
    return np.where(radius_m[:, None] > 0, found, 0.0)


@eqx.filter_jit
def _eccentricities(interior, position, camera_from_object, centre, axes, radius):
    one = lambda x, m, p, r: eccentricity(interior, ExteriorOrientation(x, m), p, axes, r)  # noqa: E731
    return jax.vmap(one)(position, camera_from_object, centre, radius)


# Of the typical standard deviation: beyond, an image point is a blunder (one good point in 270,000 is).
_LIMIT = 5.0
# Of an image's largest blunder: others so large go with it.
_NEARLY = 0.5
# Of the typical image's RMS, and in pixels: beyond both, a photograph does not fit.
_IMAGE_LIMIT, _IMAGE_PX = 5.0, 2.0
# The median of the length of a vector with two normal components of sigma 1.
_MEDIAN = float(np.sqrt(2 * np.log(2)))


def blunders(
    residuals: Float[np.ndarray, "n 2"], sigma: Float[np.ndarray, "n 2"], image: Int[np.ndarray, "n"], n_images: int
) -> Bool[np.ndarray, "n"]:
    """Image points whose residual is over five times what their sigma and the median of all let expect.

    Of each image only those at least half as large as its largest: a blunder turns its image, and good points with it.
    """
    size = np.linalg.norm(residuals / sigma, axis=1)
    largest = np.zeros(n_images)
    np.maximum.at(largest, image, size)
    return (size >= _NEARLY * largest[image]) & (size > _LIMIT * max(float(np.median(size)) / _MEDIAN, 1e-12))


def misfits(
    residuals: Float[np.ndarray, "n 2"], image: Int[np.ndarray, "n"], n_images: int
) -> Bool[np.ndarray, "images"]:
    """Images in which more than half of the points are off by five times what is usual in the others, and by pixels."""
    size = np.linalg.norm(residuals, axis=1)
    typical = np.array([np.median(size[image == k]) for k in range(n_images)])
    return (typical > _IMAGE_LIMIT * np.median(typical)) & (typical > _IMAGE_PX)


def added_sigma(residuals: Float[np.ndarray, "n 2"], sigma: Float[np.ndarray, "n 2"], redundancy: int) -> float:
    """The standard deviation a that explains the residuals beside the measurement's: sum v^2 / (sigma^2 + a^2) = r.

    Zero where sigma alone explains them. In pixels, as `residuals` and `sigma`. It is what an uneven board, a shutter
    that takes one row after the other, or a lens model with too few coefficients add; without it the points that happen
    to be measured best would bend the camera to their own systematic errors.
    """
    square, variance = residuals**2, sigma**2

    def excess(added: float) -> float:
        return float(np.sum(square / (variance + added**2))) - redundancy

    largest = float(np.sqrt(np.sum(square) / max(redundancy, 1)))
    if redundancy <= 0 or largest == 0 or excess(0.0) <= 0:
        return 0.0
    return float(scipy.optimize.brentq(excess, 0.0, largest, xtol=1e-9 * largest))


LEAST_IMAGES = 3
_LEAST_POINTS = 6
_ROUNDS = 20
# Pixels by which the added standard deviation and the centres of circles may still change in a last round.
_STILL_PX = 1e-4
# What all image points weigh alike in the first round, in pixels.
_FIRST_SIGMA_PX = 1.0
# What a lens is to first order: estimated alone where all at once does not converge.
_FIRST = ("c_mm", "k1", "k2", "a1", "a2", "a14")


@pretty_repr
class Calibration(NamedTuple):
    """A calibrated camera, and what became of the photographs."""

    adjusted: Adjustment
    board: Board
    measured: TargetRows
    """The image points that were used, as measured, with the standard deviations of the measurement."""
    residuals_px: Float[np.ndarray, "rows 2"]
    """Measured minus projected (column, row), in the order of `measured` and of the block's image points."""
    eccentricity_px: Float[np.ndarray, "rows 2"]
    """(column, row) that the measured centres of circles were corrected by, in the same order."""
    added_sigma_px: float
    """What board, shutter and model add to the standard deviations of the measurement."""
    left_out: dict[str, str]
    """Photographs that were not used, each with the reason."""
    removed: tuple[tuple[str, str], ...]
    """(image, point) of image points that were blunders."""
    settled: bool
    """False where the last round still changed something: image points that were used, sigmas, centres of circles."""

    @property
    def converged(self) -> bool:
        """Whether the last adjustment converged and the rounds came to rest."""
        return bool(self.adjusted.converged) and self.settled

    @property
    def sensor(self) -> Sensor:
        """The format."""
        return self.adjusted.block.sensors[CAMERA]

    @property
    def interior(self) -> InteriorOrientation:
        """The interior orientation."""
        return self.adjusted.unknowns.interior[CAMERA]

    @property
    def rms_px(self) -> float:
        """Per image point, both axes together, in the measured image: sqrt(sum(dx^2 + dy^2) / n), as OpenCV's."""
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
    """The camera that took photographs of a board.

    `start` is what is known of it, such as c from EXIF; a flat board seen at a tilt needs none. `model` is the name of
    a distortion in block.toml, `r0_mm` the balance radius of SMAC, `free` the parameters to estimate
    (`free_parameters`). The board's points are fixed, or known with `board_sigma_m` (m) on each axis.

    Raises InputError for a model or parameters that are none and where fewer than three photographs can be used, and
    what `adjust` raises.
    """
    distortion = distortion_model(model, sensor, r0_mm)
    names = free_parameters(model, distortion, free)
    left_out = {d.image: f"{len(d.point)} targets found" for d in detections if len(d.point) < _LEAST_POINTS}
    used = [d for d in detections if d.image not in left_out]
    _check_enough(len(used), len(detections))
    rows = TargetRows.of(used, sensor)
    rough = rough_interior(board, rows, sensor, start)
    if start is not None:
        # What is not estimated stays what was given.
        for name in {"c_mm", "xp_mm", "yp_mm"}.difference(names):
            rough = set_parameter(rough, name, float(get_parameter(start, name)))
    exterior, why = resected(board, rows, rough)
    left_out |= why
    rows = rows.take(np.array([rows.images[k] not in why for k in rows.image], bool))
    _check_enough(len(rows.images), len(detections))
    interior = nearest_distortion(rough, distortion_model(model, sensor), names, sensor)
    if isinstance(distortion, Smac) and r0_mm:
        interior = rebalance(interior, r0_mm)
    interior = dataclasses.replace(interior, residuals="measured")

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
        # What the correction of circles has still to change is no blunder.
        good = ~misfit[rows.image] & ~(large & (np.linalg.norm(residuals, axis=1) > turned))
        redundancy = adjusted.redundancy - 2 * int((~good).sum())
        last, added = added, added_sigma(residuals[good], rows.sigma_mm[good] / sensor.pixel_mm, redundancy)
        settled = bool(good.all()) and turned < _STILL_PX and last is not None and abs(added - last) < _STILL_PX
        if settled or round_ == _ROUNDS - 1:
            break
        left_out |= {rows.images[k]: "it does not fit the others" for k in np.flatnonzero(misfit)}
        few = np.bincount(rows.image[good], minlength=len(rows.images)) < _LEAST_POINTS
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


def _check_enough(images: int, given: int) -> None:
    if images < LEAST_IMAGES:
        raise InputError(
            f"{images} of {given} photographs show enough of the board, and a calibration needs "
            f"{LEAST_IMAGES}: take more of them, with the board tilted and turned"
        )


def _adjusted(block: Block, max_steps: int) -> Adjustment:
    """The adjustment; where it does not converge at once, c and the first radial coefficients come first."""
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
    """In mm of the image; zero for corners and where the board has no plane."""
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
    """A posteriori covariance of the camera of a calibration, in the order and units of `parameter_names`.

    Rows and columns of what was held are zero. It takes the image points as independent of each other: what a board
    that is not flat does to many of them alike is not in it.
    """
    return covariance(adjusted).of_interior(CAMERA, parameter_names(adjusted.unknowns.interior[CAMERA]))
