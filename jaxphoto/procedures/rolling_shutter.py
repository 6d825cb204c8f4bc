"""Rolling shutter of a block with exposure times: velocities from neighbouring photographs.

Velocities are slopes of straight lines through the positions of a photograph and its neighbours in the same straight
run; errors of positions and times give their standard deviations. Rotation rates are unknowns with expectation zero.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.block import Block
from jaxphoto.camera import ImageMotion, RollingShutter
from jaxphoto.errors import InputError
from jaxphoto.unknowns import FREE, Prior, Unknowns, Weighted

Moment = tuple[float, float]
"""Exposure time (s, any origin) and its resolution (s)."""
RATE_DEG_PER_S = 0.5
"""Standard deviation of rotation rates of a camera in a gimbal (assumed)."""
# Maximum number of neighbours on either side in a line, which turns by less and has no gap.
_NEIGHBOURS, _STRAIGHT_DEG = 2, 20.0
GAP = 3.0
"""Ratio to the usual interval between photographs above which an interval is a gap."""
NEIGHBOUR_M = 0.05
"""Relative standard deviation of adjusted positions of neighbours (m, assumed)."""
# Relative change of a drone's speed between photographs, and minimum standard deviation of a velocity.
_UNSTEADY, _LEAST_M_PER_S = 0.03, 0.1
# Minimum fraction of photographs with a velocity.
_ENOUGH = 0.5


def usual_interval(time: Float[np.ndarray, "images"]) -> float:
    """Median interval (s) between ordered times, infinite without any.

    Zeros are excluded: exposures within the resolution of the clock have the same time.
    """
    later = np.diff(time)
    return float(np.median(later[later > 0])) if (later > 0).any() else np.inf


class Velocities(NamedTuple):
    """Velocities of all photographs in the object frame."""

    velocity: Float[np.ndarray, "images 3"]
    sigma: Float[np.ndarray, "images 3"]
    known: Bool[np.ndarray, "images"]
    """False without neighbours; then the velocity is zero and its standard deviation the usual speed."""


def velocities(
    position: Float[np.ndarray, "images 3"],
    time: Float[np.ndarray, "images"],
    step: Float[np.ndarray, "images"],
    sigma_m: float,
) -> Velocities:
    """Velocities (m/s) from positions (m, with `sigma_m`) and times (s, with resolution `step`; NaN: unknown)."""
    n = len(time)
    velocity, sigma, has_velocity = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, bool)
    order = [int(k) for k in np.argsort(time, kind="stable") if np.isfinite(time[k])]
    usual = usual_interval(time[order])
    for rank, k in enumerate(order):
        before, after = (_run(order, rank, side, position, time, GAP * usual) for side in (-1, 1))
        if before and after and not _straight(position[k] - position[before[0]], position[after[0]] - position[k]):
            # End of a strip: it belongs to the side whose next photograph is nearer in time.
            nearer = time[k] - time[before[0]] <= time[after[0]] - time[k]
            before, after = (before, []) if nearer else ([], after)
        run = [k, *before, *after]
        t = time[run] - time[run].mean()
        spread = float(t @ t)
        if spread <= 0:
            continue
        velocity[k] = t @ position[run] / spread
        speed = float(np.linalg.norm(velocity[k]))
        # The uniform error of a time within its resolution is a position error.
        noise = np.hypot(sigma_m, velocity[k] * float(step[run].mean()) / np.sqrt(12))
        sigma[k] = np.sqrt(noise**2 / spread + (_UNSTEADY * speed) ** 2 + _LEAST_M_PER_S**2)
        has_velocity[k] = True
    usual_speed = float(np.sqrt(np.mean(np.sum(velocity[has_velocity] ** 2, axis=1)))) if has_velocity.any() else 0.0
    sigma[~has_velocity] = max(usual_speed, _LEAST_M_PER_S)
    return Velocities(velocity, sigma, has_velocity)


def _run(order: list[int], rank: int, side: int, position: np.ndarray, time: np.ndarray, gap: float) -> list[int]:
    """Neighbours on one side within the straight run, the nearest first."""
    run, last, ahead = [], order[rank], None
    for k in order[rank + 1 : rank + 1 + _NEIGHBOURS] if side > 0 else order[:rank][::-1][:_NEIGHBOURS]:
        way = position[k] - position[last]
        if abs(time[k] - time[last]) > gap or not way[:2].any() or (ahead is not None and not _straight(ahead, way)):
            break
        run.append(k)
        last, ahead = k, way
    return run


def _straight(one: np.ndarray, other: np.ndarray) -> bool:
    """Return True if two steps have the same direction in plan."""
    a, b = one[:2], other[:2]
    return bool(a @ b > np.cos(np.radians(_STRAIGHT_DEG)) * np.hypot(*a) * np.hypot(*b))


def with_rolling_shutter(
    block: Block,
    taken: Mapping[str, Moment],
    sigma_m: float,
    readout: Prior | Weighted = FREE,
    known: Unknowns | None = None,
) -> Block:
    """Add a rolling shutter to every camera, with a readout time that starts at zero.

    `known` are the positions (with `sigma_m` relative to neighbours) and orientations that define the motions and the
    start; None: those of the block. `taken` is by image. Raises InputError if too few photographs have a velocity.
    """
    exterior = (block.start.unknowns if known is None else known).exterior
    moments = np.array([taken.get(name, (np.nan, 1.0)) for name in block.images]).reshape(-1, 2)
    motion = velocities(np.asarray(exterior.position), moments[:, 0], moments[:, 1], sigma_m)
    if motion.known.mean() < _ENOUGH:
        raise InputError(
            f"only {motion.known.sum()} of {len(block.images)} photographs have neighbours in time that determine "
            "their velocity: a rolling shutter cannot be estimated. Use photographs with exposure times, or omit it"
        )
    turn = np.asarray(exterior.camera_from_object)
    velocity = np.einsum("nij,nj->ni", turn, motion.velocity)
    covariance = np.einsum("nij,nj,nkj->nik", turn, motion.sigma**2, turn)
    no_rotation, rate = np.zeros(3), Weighted(np.zeros(3), np.full(3, np.radians(RATE_DEG_PER_S)))
    start: dict[str, Any] = {}
    priors: dict[str, Any] = {}
    for name, v, own in zip(block.images, velocity, covariance, strict=True):
        start[name] = ImageMotion(v, no_rotation)  # type: ignore[arg-type]
        priors[name] = ImageMotion(Weighted(v, np.sqrt(np.diag(own))), rate)  # type: ignore[arg-type]
    shutters, motions = RollingShutter.kind, ImageMotion.kind
    before: dict[str, Any] = {} if known is None else known.more.get(shutters, {})
    begin: dict[str, Any] = {c: before.get(c, RollingShutter(np.zeros(()))) for c in block.sensors}  # type: ignore[arg-type]
    unknowns = block.start.unknowns if known is None else dataclasses.replace(known, more=block.start.unknowns.more)
    unknowns = dataclasses.replace(unknowns, more=unknowns.more | {shutters: begin, motions: start})
    of_cameras: dict[str, Any] = dict.fromkeys(block.sensors, RollingShutter(readout))  # type: ignore[arg-type]
    known_before = dataclasses.replace(block.priors, more=block.priors.more | {shutters: of_cameras, motions: priors})
    n, m = len(block.images), len(block.points)
    begin_start = (
        block.start
        if known is None
        else dataclasses.replace(block.start, image_known=np.ones(n, bool), point_known=np.ones(m, bool))
    )
    return dataclasses.replace(block, start=dataclasses.replace(begin_start, unknowns=unknowns), priors=known_before)
