"""Where a block holds the numbers that a bias changes, and whose error each of them gets.

A trajectory that is off by b at all times moves laser returns and exposures. The same comes of knots c' = c - b in
place of the knots c, since their weights sum up to 1: what is known beforehand of the first knot of a strip becomes -b,
and

    c[k + 1] - f c[k] = 0    becomes    c'[k + 1] - f c'[k] = -(1 - f) b

(`observations.knot_steps`). Of positions that is exact, of attitudes to first order in what they are off by.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.block import Block
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import TrajectoryKnot, strip_of_knot
from jaxphoto.observations import (
    ATTITUDE_AXES,
    AXES,
    Attitudes,
    AttitudeSteps,
    PositionSteps,
    StationRows,
    TrajectoryAttitudes,
    TrajectoryStations,
)
from jaxphoto.unknowns import FIXED, Weighted

Steps = type[PositionSteps] | type[AttitudeSteps]
OBSERVED = {
    "station": (StationRows, TrajectoryStations),
    "attitude": (Attitudes, TrajectoryAttitudes),
}
"""Kinds of bias of GNSS and IMU, and the rows that have them."""
TRAJECTORY: dict[str, tuple[str, Steps]] = {
    "trajectory": ("position", PositionSteps),
    "trajectory-attitude": ("attitude", AttitudeSteps),
}
"""Kinds of bias of a scanner's trajectory: the field of its knots, and the steps from knot to knot."""
LABELS = {
    "station": tuple(f"{a}_m" for a in AXES),
    "attitude": tuple(f"{a}_rad" for a in ATTITUDE_AXES),
    "control": tuple(f"{a}_m" for a in AXES),
    "image-points": ("x_mm", "y_mm"),
    **{kind: TrajectoryKnot.names[field] for kind, (field, _) in TRAJECTORY.items()},
}
"""What the errors of one owner are called."""


class BiasedNumbers(NamedTuple):
    """An array of a block: of each number whose error it gets, and of which axis."""

    path: tuple[Any, ...]
    """From the block."""
    owner: list[str]
    axis: Int[np.ndarray, "numbers"]
    factor: Float[np.ndarray, "sets 3 3"] | None = None
    """What the errors of three numbers at a time are multiplied by."""


def observed_numbers(block: Block, kind: str, per: str) -> list[BiasedNumbers]:
    """Those of stations, attitudes, control or image points."""
    kinds = OBSERVED.get(kind, ())
    if not kinds:
        name = kind.replace("-", "_")
        return [_numbers_of(block, getattr(block, name), (name,), kind, per)]
    held: list[tuple[tuple[Any, ...], Any]] = [((name,), getattr(block, name)) for name in ("stations", "attitudes")]
    held += [(("more", k), rows) for k, rows in enumerate(block.more)]
    return [_numbers_of(block, rows, path, kind, per) for path, rows in held if isinstance(rows, kinds) and len(rows)]


def _numbers_of(block: Block, rows: Any, path: tuple[Any, ...], kind: str, per: str) -> BiasedNumbers:
    labels = LABELS[kind]
    if hasattr(rows, "who"):
        who, axis = rows.who, rows.axis
    else:
        who, axis = np.repeat(rows.image, len(labels)), np.tile(np.arange(len(labels)), len(rows))
    path = (*path, rows.observed)
    if per == "observation":
        point = np.repeat(rows.point, len(labels))
        owner = [f"{block.images[i]}.{block.points[p]}" for i, p in zip(who, point, strict=True)]
        return BiasedNumbers(path, owner, axis)
    names = {"image": block.images, "camera": block.image_camera, "strip": block.image_strip, "point": block.points}
    return BiasedNumbers(path, ["block" if per == "block" else names[per][k] for k in who], axis)


def trajectory_numbers(block: Block, kind: str, per: str) -> list[BiasedNumbers]:
    """Those by which the trajectory of each strip of a laser scanner is off.

    Raises InputError for a block without a trajectory, and for knots known by one value for three axes.
    """
    field, steps = TRAJECTORY[kind]
    if not any(isinstance(rows, steps) and len(rows) for rows in block.more):
        raise InputError(
            f"the block {block.title!r} has no trajectory of a laser scanner that a bias of kind {kind} could be added "
            "to: take that of a strip adjustment (docs/joint.md), or --bias station"
        )
    return [*_knots(block, field, per), *_steps(block, steps, per)]


def _knots(block: Block, field: str, per: str) -> Iterator[BiasedNumbers]:
    """Of knots that are held or known beforehand."""
    kind = TrajectoryKnot.kind
    for owner, knot in block.priors.more[kind].items():
        prior = getattr(knot, field)
        weighted = isinstance(prior, Weighted)
        if weighted and np.shape(prior.value) != (3,):
            raise InputError(f"{field} of {owner} is known beforehand by one value for three axes: give it three")
        if weighted or prior == FIXED:
            own = ("more", kind, owner, field)
            path = ("priors", *own, "value") if weighted else ("start", "unknowns", *own)
            yield BiasedNumbers(path, [_whose(owner, per)] * 3, np.arange(3), -np.eye(3)[None])


def _steps(block: Block, steps: Steps, per: str) -> Iterator[BiasedNumbers]:
    knots = list(block.start.unknowns.more[TrajectoryKnot.kind])
    for k, rows in enumerate(block.more):
        if isinstance(rows, steps):
            lost = 1 - np.asarray(rows.kept)
            owner = [_whose(knots[start], per) for start in rows.start]
            axis, factor = np.tile(np.arange(3), len(rows)), -lost[:, None, None] * np.eye(3)
            yield BiasedNumbers(("more", k, rows.observed), [name for name in owner for _ in range(3)], axis, factor)


def _whose(knot: str, per: str) -> str:
    return "block" if per == "block" else strip_of_knot(knot)
