"""A rolling shutter for a block whose photographs have times: how each moves, its neighbours tell.

Velocities are slopes of straight lines through the positions of a photograph and of its neighbours in the same run, as
far as the track goes straight on; what positions and times are off by makes their standard deviations. Rates of turn
nobody tells: they are unknowns about zero.
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
"""When a photograph was taken (s, of any origin), and the step in which that is counted (s)."""
RATE_DEG_PER_S = 0.5
"""Standard deviation of the rates of turn of a camera in a gimbal: a judgement."""
# Photographs on either side that a line goes through, while the track turns by less, and no gap is between them.
_NEIGHBOURS, _STRAIGHT_DEG = 2, 20.0
GAP = 3.0
"""Of the usual interval between photographs: a longer one is a gap."""
NEIGHBOUR_M = 0.05
"""What adjusted positions are off by against their neighbours (m): a judgement."""
# Drones speed up and slow down between photographs by so much of their speed, and are never still.
_UNSTEADY, _LEAST_M_PER_S = 0.03, 0.1
# Share of the photographs whose neighbours have to tell how they move.
_ENOUGH = 0.5


def usual_interval(time: Float[np.ndarray, "images"]) -> float:
    """The median interval (s) between times in their order, infinite where there is none.

    Of those that are no zero: photographs that follow one another within a step of the clock have the same time.
    """
    later = np.diff(time)
    return float(np.median(later[later > 0])) if (later > 0).any() else np.inf


class Velocities(NamedTuple):
    """Of every photograph, in the object frame, as its neighbours tell it."""

    velocity: Float[np.ndarray, "images 3"]
    sigma: Float[np.ndarray, "images 3"]
    known: Bool[np.ndarray, "images"]
    """Whether they do; where not, the velocity is zero and its standard deviation the speed of the others."""


def velocities(
    position: Float[np.ndarray, "images 3"],
    time: Float[np.ndarray, "images"],
    step: Float[np.ndarray, "images"],
    sigma_m: float,
) -> Velocities:
    """Velocities (m/s) from positions (m, each with `sigma_m`) and times (s, counted in steps of `step`; NaN: none)."""
    n = len(time)
    velocity, sigma, known = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, bool)
    order = [int(k) for k in np.argsort(time, kind="stable") if np.isfinite(time[k])]
    usual = usual_interval(time[order])
    for rank, k in enumerate(order):
        before, after = (_run(order, rank, side, position, time, GAP * usual) for side in (-1, 1))
        if before and after and not _straight(position[k] - position[before[0]], position[after[0]] - position[k]):
            # The end of a strip: it belongs to the one whose next photograph is nearer in time.
            nearer = time[k] - time[before[0]] <= time[after[0]] - time[k]
            before, after = (before, []) if nearer else ([], after)
        run = [k, *before, *after]
        t = time[run] - time[run].mean()
        spread = float(t @ t)
        if spread <= 0:
            continue
        velocity[k] = t @ position[run] / spread
        speed = float(np.linalg.norm(velocity[k]))
        # What a time is off by, uniform within its step, is as much of the way.
        noise = np.hypot(sigma_m, velocity[k] * float(step[run].mean()) / np.sqrt(12))
        sigma[k] = np.sqrt(noise**2 / spread + (_UNSTEADY * speed) ** 2 + _LEAST_M_PER_S**2)
        known[k] = True
    usual_speed = float(np.sqrt(np.mean(np.sum(velocity[known] ** 2, axis=1)))) if known.any() else 0.0
    sigma[~known] = max(usual_speed, _LEAST_M_PER_S)
    return Velocities(velocity, sigma, known)


def _run(order: list[int], rank: int, side: int, position: np.ndarray, time: np.ndarray, gap: float) -> list[int]:
    """Photographs on one side of another, as far as the track goes straight on, the nearest first."""
    run, last, ahead = [], order[rank], None
    for k in order[rank + 1 : rank + 1 + _NEIGHBOURS] if side > 0 else order[:rank][::-1][:_NEIGHBOURS]:
        way = position[k] - position[last]
        if abs(time[k] - time[last]) > gap or not way[:2].any() or (ahead is not None and not _straight(ahead, way)):
            break
        run.append(k)
        last, ahead = k, way
    return run


def _straight(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether a track goes on in plan as it came."""
    a, b = one[:2], other[:2]
    return bool(a @ b > np.cos(np.radians(_STRAIGHT_DEG)) * np.hypot(*a) * np.hypot(*b))


def with_rolling_shutter(
    block: Block,
    taken: Mapping[str, Moment],
    sigma_m: float,
    readout: Prior | Weighted = FREE,
    known: Unknowns | None = None,
) -> Block:
    """The block in which every camera reads its rows one after another, in a time that starts at zero.

    `known` has the positions (each good to `sigma_m` against its neighbours) and orientations that motions follow from
    and the adjustment then starts with; None: those of the block. `taken` is by image. Raises InputError where
    neighbours tell too few motions.
    """
    exterior = (block.start.unknowns if known is None else known).exterior
    moments = np.array([taken.get(name, (np.nan, 1.0)) for name in block.images]).reshape(-1, 2)
    found = velocities(np.asarray(exterior.position), moments[:, 0], moments[:, 1], sigma_m)
    if found.known.mean() < _ENOUGH:
        raise InputError(
            f"only {found.known.sum()} of {len(block.images)} photographs have neighbours in time that tell how they "
            "move, so a rolling shutter cannot be estimated; give photographs with times, or leave it out"
        )
    turn = np.asarray(exterior.camera_from_object)
    velocity = np.einsum("nij,nj->ni", turn, found.velocity)
    covariance = np.einsum("nij,nj,nkj->nik", turn, found.sigma**2, turn)
    still, rate = np.zeros(3), Weighted(np.zeros(3), np.full(3, np.radians(RATE_DEG_PER_S)))
    start: dict[str, Any] = {}
    priors: dict[str, Any] = {}
    for name, v, own in zip(block.images, velocity, covariance, strict=True):
        start[name] = ImageMotion(v, still)  # type: ignore[arg-type]
        priors[name] = ImageMotion(Weighted(v, np.sqrt(np.diag(own))), rate)  # type: ignore[arg-type]
    shutters, motions = RollingShutter.kind, ImageMotion.kind
    before: dict[str, Any] = {} if known is None else known.more.get(shutters, {})
    begin: dict[str, Any] = {c: before.get(c, RollingShutter(np.zeros(()))) for c in block.sensors}  # type: ignore[arg-type]
    unknowns = block.start.unknowns if known is None else dataclasses.replace(known, more=block.start.unknowns.more)
    unknowns = dataclasses.replace(unknowns, more=unknowns.more | {shutters: begin, motions: start})
    of_cameras: dict[str, Any] = dict.fromkeys(block.sensors, RollingShutter(readout))  # type: ignore[arg-type]
    known_before = dataclasses.replace(block.priors, more=block.priors.more | {shutters: of_cameras, motions: priors})
    n, m = len(block.images), len(block.points)
    given = (
        block.start
        if known is None
        else dataclasses.replace(block.start, image_known=np.ones(n, bool), point_known=np.ones(m, bool))
    )
    return dataclasses.replace(block, start=dataclasses.replace(given, unknowns=unknowns), priors=known_before)
