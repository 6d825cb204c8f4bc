"""Calibration of a camera from the targets of a board found in photographs, in rounds of adjusting and looking.

1. Start: lens and principal distance from the homographies of a flat board (`start`), orientation by resection.
2. Self-calibrating adjustment; the points of the board are fixed, or weighted.
3. Photographs that do not fit and blunders among the image points go; image points get the standard deviation of their
   measurement and what board and model add to it (`outliers.added_sigma`); centres of circles are corrected for their
   eccentricity; and back to 2, until nothing changes (`Calibration.settled`), twenty times at most.

Residuals are those of the measured image, whatever the direction of the distortion.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import MAX_STEPS, Adjustment
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, Sensor, Smac, get_parameter, rebalance, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.calibration.board import Board, Detection
from jaxphoto.procedures.calibration.calibration_block import CAMERA, TargetRows, calibration_block
from jaxphoto.procedures.calibration.eccentricity import eccentricities
from jaxphoto.procedures.calibration.outliers import added_sigma, blunders, misfits
from jaxphoto.procedures.calibration.parameters import distortion_model, free_parameters
from jaxphoto.procedures.calibration.reprojection import reprojection_residuals, rms_px
from jaxphoto.procedures.calibration.resections import resected
from jaxphoto.procedures.calibration.start import nearest_distortion, rough_interior
from jaxphoto.short_repr import pretty_repr
from jaxphoto.unknowns import FIXED

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
        before, correction = correction, _eccentricities(board, rows, interior, exterior)
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


def _eccentricities(board, rows, interior, exterior) -> Float[np.ndarray, "rows 2"]:
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
