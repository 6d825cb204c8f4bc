"""Unknowns of a strip adjustment: trajectory knots of every strip, boresight and calibration of the scanner."""

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Block, empty_block
from jaxphoto.georeferencing import (
    Scanner,
    ScannerCalibration,
    StripErrors,
    StripSpline,
    Trajectory,
    TrajectoryKnot,
    knot_name,
)
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.parameters import AbstractParameters, dynamic_fields
from jaxphoto.procedures.lidar.iterate_to_convergence import at_result
from jaxphoto.unknowns import FIXED, FREE, Unknowns, Weighted

_ZERO = np.zeros(3)
NO_CALIBRATION = ScannerCalibration(_ZERO, *[np.zeros(())] * 3, np.zeros(2), np.zeros(()))  # type: ignore[arg-type, call-arg]
"""Scanner without errors."""


class KnotSigmas(NamedTuple):
    """Standard deviations of the trajectory errors at each knot of all strips."""

    position: Float[np.ndarray, "knots 3"]
    """Along X, Y and Z (m)."""
    attitude: Float[np.ndarray, "knots 3"]
    """About right, forward and up (rad)."""


def knot_sigmas(splines: Sequence[StripSpline], trajectory: Trajectory | None, settings: StripSettings) -> KnotSigmas:
    """Return those stated by the trajectory, or those of the settings where it states none (zero)."""
    times = np.concatenate([spline.times for spline in splines])
    position = np.full((len(times), 3), settings.sigma_position_m)
    attitude = np.tile(settings.sigma_attitude, (len(times), 1))
    if trajectory is None:
        return KnotSigmas(position, attitude)
    # Of roll, pitch and yaw, which are rotations about forward, right and up.
    stated = np.asarray(trajectory.sigma_position), np.asarray(trajectory.sigma_attitude)[:, [1, 0, 2]]
    for own, sigmas in zip((position, attitude), stated, strict=True):
        for axis, column in enumerate(sigmas.T):
            if (column > 0).all():
                own[:, axis] = np.interp(times, np.asarray(trajectory.time), column)
    return KnotSigmas(position, attitude)


class ScannerPriors(NamedTuple):
    """Priors of the scanner: FREE, FIXED or Weighted, each."""

    boresight: Any = FREE
    calibration: ScannerCalibration = ScannerCalibration(*[FIXED] * len(dynamic_fields(ScannerCalibration)))  # type: ignore[arg-type]

    @property
    def right(self) -> bool:
        """Return True if nothing of the scanner is estimated."""
        calibration = (getattr(self.calibration, name) for name in dynamic_fields(ScannerCalibration))
        return all(prior == FIXED for prior in (self.boresight, *calibration))


def strip_block(
    names: Sequence[str],
    splines: Sequence[StripSpline],
    held: Collection[str],
    sigmas: KnotSigmas,
    priors: ScannerPriors | None,
    photographs: Block | None = None,
) -> Block:
    """Create a block of these unknowns, all zero, added to `photographs` if given.

    The first knot of each strip has the trajectory's sigma as prior.

    Without `priors` strips have only a shift, which is free. The trajectory of strips in `held` is fixed.
    """
    knots: dict[str, AbstractParameters] = {}
    known: dict[str, AbstractParameters] = {}
    later = TrajectoryKnot(FREE, FREE)  # type: ignore[arg-type]
    shift, right = TrajectoryKnot(FREE, FIXED), TrajectoryKnot(FIXED, FIXED)  # type: ignore[arg-type]
    for name, spline in zip(names, splines, strict=True):
        first = TrajectoryKnot(*(Weighted(_ZERO, of[spline.first]) for of in sigmas))  # type: ignore[arg-type]
        for k, time in enumerate(spline.times):
            owner = name if priors is None else knot_name(name, time)
            knots[owner] = TrajectoryKnot(_ZERO, _ZERO)  # type: ignore[arg-type]
            known[owner] = right if name in held else shift if priors is None else later if k else first
    block = empty_block("strips of a laser scanner") if photographs is None else photographs
    start, prior = block.start.unknowns, block.priors
    start = dataclasses.replace(start, more=start.more | {TrajectoryKnot.kind: knots})
    prior = dataclasses.replace(prior, more=prior.more | {TrajectoryKnot.kind: known})
    if priors is not None:
        of_scanner, own = ScannerCalibration.kind, priors.calibration
        right_scanner = Scanner(_ZERO, {})  # type: ignore[arg-type]
        none = dataclasses.replace(NO_CALIBRATION, pattern=own.pattern)
        start = dataclasses.replace(start, scanner=right_scanner, more=start.more | {of_scanner: {"": none}})
        prior = dataclasses.replace(
            prior, scanner=Scanner(priors.boresight, {}), more=prior.more | {of_scanner: {"": own}}
        )
    return dataclasses.replace(at_result(block, start), priors=prior)


def errors_of(unknowns: Unknowns, splines: tuple[StripSpline, ...]) -> StripErrors:
    """Return the strip errors for the unknowns of `strip_block`."""
    knots = unknowns.more[TrajectoryKnot.kind].values()
    position, attitude = (np.array([getattr(k, name) for k in knots], float) for name in ("position", "attitude"))
    calibration: Any = unknowns.more.get(ScannerCalibration.kind, {"": NO_CALIBRATION})[""]
    boresight = _ZERO if unknowns.scanner is None else np.asarray(unknowns.scanner.boresight)
    return StripErrors(splines, position, attitude, boresight, calibration)
