"""Surveyed points as points of a block: their image points, their coordinates in their roles, and the bias of GNSS."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Block
from jaxphoto.block_parts import Datum, Start
from jaxphoto.georeferencing import FlightBias
from jaxphoto.observations import ControlCoordinates, ImagePoints
from jaxphoto.parameters import AbstractParameters
from jaxphoto.procedures.control.marked import Marked
from jaxphoto.unknowns import FIXED, FREE


def into_block(
    block: Block,
    ids: tuple[str, ...],
    xyz: Float[np.ndarray, "points 3"],
    sigma: Float[np.ndarray, "points 3"],
    start: Float[np.ndarray, "points 3"],
    rows: Marked,
    control: Bool[np.ndarray, "points"],
    check: Bool[np.ndarray, "points"],
) -> Block:
    """`block` with the points `ids` at its end, which may have none of these names yet; `rows` are their marks.

    `xyz` (m, NaN for what is not known) are observed with `sigma` of those that are `control`, and check coordinates of
    those that are `check`, with 0 for a sigma that nobody gave; of the others they tell nothing. `start` is where all
    begin, in the frame of the block.
    """
    n = len(block.points)
    new = ImagePoints(
        rows.image, rows.point + n, as_jax_array(rows.xy_mm), as_jax_array(np.repeat(rows.sigma_mm[:, None], 2, 1))
    )
    unknowns = block.start.unknowns
    unknowns = dataclasses.replace(unknowns, points=np.concatenate([np.asarray(unknowns.points, float), start]))
    known = np.concatenate([np.asarray(block.start.point_known), np.ones(len(ids), bool)])
    return dataclasses.replace(
        block,
        points=(*block.points, *ids),
        image_points=ImagePoints.joined(block.image_points, new),
        control=ControlCoordinates.joined(block.control, _coordinates(xyz, sigma, control, n)),
        check=ControlCoordinates.joined(block.check, _coordinates(xyz, sigma, check, n)),
        datum=Datum(),
        start=Start(unknowns, block.start.image_known, known),
    )


def _coordinates(xyz, sigma, chosen, first: int) -> ControlCoordinates:
    point, axis = np.nonzero(np.isfinite(xyz) & chosen[:, None])
    return ControlCoordinates(first + point, axis, as_jax_array(xyz[point, axis]), as_jax_array(sigma[point, axis]))


def without_names(block: Block, ids: tuple[str, ...]) -> Block:
    """`block` whose points have none of the names `ids`.

    Surveyed points of these names are replaced, so they go with their image points. Others are tie points, whose names
    mean nothing: they get another one.
    """
    surveyed = {int(p) for rows in (block.control, block.fixed, block.check) for p in np.asarray(rows.who)}
    taken = set(ids)
    gone = np.array([name in taken and k in surveyed for k, name in enumerate(block.points)], bool)
    new = np.where(gone, -1, np.cumsum(~gone) - 1)
    kept = [name for name, out in zip(block.points, gone, strict=True) if not out]
    names = set(kept) | taken
    for k, name in enumerate(kept):
        if name in taken:
            while (name := f"tie_{name}") in names:
                pass
            names.add(name)
            kept[k] = name
    renumbered = lambda rows: rows.renumbered(point=new)  # noqa: E731
    start = block.start
    unknowns = dataclasses.replace(start.unknowns, points=np.asarray(start.unknowns.points, float)[~gone])
    changed = {
        name: renumbered(getattr(block, name))
        for name in ("image_points", "control", "fixed", "check", "surfaces", "distances")
    }
    return dataclasses.replace(
        block,
        points=tuple(kept),
        **changed,
        more=tuple(renumbered(m) if hasattr(m, "renumbered") else m for m in block.more),
        start=Start(unknowns, start.image_known, np.asarray(start.point_known)[~gone]),
    )


def with_gnss_bias(block: Block) -> Block:
    """`block` whose stations have a common shift, which control tells: another zero of heights, another datum."""
    unknowns, zero = block.start.unknowns, np.zeros(3)
    # Beside a part of the flight that has none, the shifts of others count from it.
    if "flight_bias" in unknowns.more or (unknowns.strips and unknowns.strips.keys() >= set(block.image_strip)):
        return block
    bias: dict[str, AbstractParameters] = {"": FlightBias(zero, zero)}  # type: ignore[arg-type]
    known: dict[str, AbstractParameters] = {"": FlightBias(FREE, FIXED)}  # type: ignore[arg-type]
    more, priors = unknowns.more | {"flight_bias": bias}, block.priors.more | {"flight_bias": known}
    return dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=dataclasses.replace(unknowns, more=more)),
        priors=dataclasses.replace(block.priors, more=priors),
    )
