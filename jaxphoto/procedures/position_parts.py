"""Parts of a flight whose recorded positions are off by a step, each but the largest with a shift of its own."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.block import Block
from jaxphoto.georeferencing import StripBias
from jaxphoto.procedures.position_steps import steps_of
from jaxphoto.unknowns import FIXED, FREE


class PositionParts(NamedTuple):
    """Which part each of the photographs that have a position is in."""

    part: Int[np.ndarray, "n"]
    shift_m: Float[np.ndarray, "parts 3"]
    """Zero of the one that has most photographs, which counts."""
    first: tuple[str, ...]
    """The photographs that parts begin with."""
    sentences: tuple[str, ...]

    @property
    def off_m(self) -> Float[np.ndarray, "n 3"]:
        """What each position is off by."""
        return self.shift_m[self.part]


def position_parts(
    names: Sequence[str],
    order: Sequence[str],
    offsets_m: Float[np.ndarray, "n 3"],
    at_m: Float[np.ndarray, "n 3"],
    least_m: Float[np.ndarray, "3"],
) -> PositionParts:
    """The parts of photographs `names`, which were taken in the `order` of more names; as `steps_of` takes the rest."""
    rank = {name: k for k, name in enumerate(order)}
    turn = np.array(sorted(range(len(names)), key=lambda k: rank.get(names[k], k)), int)
    steps = steps_of(offsets_m[turn], at_m[turn], least_m)
    part = np.zeros(len(names), int)
    part[turn] = np.searchsorted([s.first for s in steps], np.arange(len(names)), side="right")
    shift = np.concatenate([np.zeros((1, 3)), np.cumsum([s.by_m for s in steps], axis=0).reshape(-1, 3)])
    most = int(np.argmax(np.bincount(part)))
    first = tuple(names[turn[k]] for k in (0, *(s.first for s in steps)))
    said = []
    for k, step in enumerate(steps, 1):
        by, sigma = (", ".join(f"{v:.2f}" for v in of) for of in (step.by_m, step.sigma_m))
        said.append(
            f"the recorded positions step by {by} m (east, north, up; standard deviations {sigma}) between "
            f"{names[turn[step.first - 1]]} and {first[k]}, as where a fix was lost or a base changed: those of the "
            f"{np.sum(part == most)} photographs from {first[most]} on count, the others have a shift of their own in "
            "the adjustment; leave out the worse ones if it is known which"
        )
    return PositionParts(part, shift - shift[most], first, tuple(said))


def with_part_shifts(block: Block, parts: PositionParts, image: Int[np.ndarray, "n"]) -> Block:
    """`block` whose parts, as strips, have shifts of their own, but that which counts; `image` are those of `parts`."""
    if not parts.sentences:
        return block
    own = {f"from_{parts.first[k]}": v for k, v in enumerate(parts.shift_m) if v.any()}
    strip = [""] * len(block.images)
    for i, k in zip(image.tolist(), parts.part.tolist(), strict=True):
        strip[i] = f"from_{parts.first[k]}" if parts.shift_m[k].any() else ""
    still = np.zeros(3)
    unknowns = dataclasses.replace(
        block.start.unknowns,
        strips={name: StripBias(v, still) for name, v in own.items()},  # type: ignore[arg-type]
    )
    priors = {name: StripBias(FREE, FIXED) for name in own}  # type: ignore[arg-type]
    return dataclasses.replace(
        block,
        image_strip=tuple(strip),
        start=dataclasses.replace(block.start, unknowns=unknowns),
        priors=dataclasses.replace(block.priors, strips=priors),
    )
