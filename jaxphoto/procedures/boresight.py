"""Boresight misalignment of a camera in four steps, each with a judgement.

1. Neither stations nor attitudes: are image measurements and control valid? 2. Stations, with shift and drift of every
strip, and no attitudes: is the GNSS trajectory valid? 3. Stations and attitudes, free boresight: the misalignment. 4.
The same without control, which becomes check points: does control distort the misalignment?

A shift or drift that is significant but not major in step 2 is kept: free in step 3, fixed at that value in step 4,
where without control nothing else determines the position of the block. Source: paper 003, section 2.3;
docs/boresight.md.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import numpy as np

from jaxphoto.adjustment import MAX_STEPS
from jaxphoto.block import Block, Start
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import Mount, StripBias
from jaxphoto.initial import approximate
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.boresight_judgement import Biases, Step, judge
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import FIXED, FREE, Unknowns
from jaxphoto.variants import indirect, without_attitudes, without_control

STEPS = (1, 2, 3, 4)


@outside_transformations
def boresight(
    block: Block,
    *,
    go_on: bool = False,
    max_steps: int = MAX_STEPS,
    report: Callable[[str], object] = lambda text: None,
) -> tuple[Step, ...]:
    """Determine the boresight misalignment of `block` in four steps; returns the steps made.

    Stops after a step whose judgement is that continuing is pointless, unless `go_on`, and after one that does not
    converge; `report` receives progress. Interior orientation is estimated according to the block's priors. Raises
    BlockError if the block lacks what one of the steps needs, and what `jaxphoto.adjust` raises.
    """
    for number in STEPS:
        _check(block, number)
    known = Start(approximate(block), np.ones(len(block.images), bool), np.ones(len(block.points), bool))
    block = dataclasses.replace(block, start=known)
    steps: list[Step] = []
    for number in STEPS:
        report(f"adjusting {len(block.images)} images: step {number} of {len(STEPS)}")
        last = steps[-1] if steps else None
        posed = step_block(block, number, last.biases, last.adjusted.unknowns) if last else step_block(block, number)
        step = judge(number, adjust(posed, max_steps=max_steps), last)
        steps.append(step)
        if not (step.go_on or (go_on and bool(step.adjusted.converged))):
            break
    return tuple(steps)


def step_block(block: Block, number: int, biases: Biases = (), before: Unknowns | None = None) -> Block:
    """Return `block` as adjusted in step `number` (1 to 4).

    `biases` are the shifts and drifts kept from step 2 (`Step.biases`); `before` the unknowns of the previous step,
    used as start values and, in step 4, as the fixed values of those shifts and drifts. If None, the block's own start
    values are used. Raises BlockError if the block lacks what the step needs.
    """
    _check(block, number)
    free = strip_biases(block) if number == 2 else biases if number == 3 else ()
    names = [name for name in dict.fromkeys(block.image_strip) if name]
    given, kept = block.start.unknowns, before if before is not None else block.start.unknowns
    zero = StripBias(np.zeros(3), np.zeros(3))  # type: ignore[arg-type]
    strips = {name: given.strips.get(name, zero) for name in names}
    for name, what in biases:
        strips[name] = dataclasses.replace(strips[name], **{what: getattr(kept.strips.get(name, zero), what)})
    prior = lambda name, what: FREE if (name, what) in free else FIXED  # noqa: E731
    strip_priors = {name: StripBias(prior(name, "shift"), prior(name, "drift")) for name in names}  # type: ignore[arg-type]
    posed = indirect(block) if number == 1 else without_attitudes(block) if number == 2 else block
    posed = without_control(posed) if number == 4 else posed
    if before is not None:
        known = Start(before, np.ones(len(block.images), bool), np.ones(len(block.points), bool))
        posed = dataclasses.replace(posed, start=known)
    mounts = {name: _mount_prior(prior, number) for name, prior in block.priors.mounts.items()}
    start = dataclasses.replace(posed.start.unknowns, strips=strips)
    priors = dataclasses.replace(posed.priors, mounts=mounts, strips=strip_priors)
    return eqx.tree_at(lambda b: (b.start.unknowns, b.priors), posed, (start, priors))


def strip_biases(block: Block) -> Biases:
    """Return the shifts and drifts that stations determine: of strips with one station, and with two at different
    times.
    """
    whole = np.bincount(block.stations.who, minlength=len(block.images)) == 3
    found: list[tuple[str, str]] = []
    for name in dict.fromkeys(block.image_strip):
        images = np.flatnonzero(whole & (np.array(block.image_strip) == name))
        if name and len(images):
            found.append((name, "shift"))
            if len(np.unique(np.asarray(block.image_time)[images])) > 1:
                found.append((name, "drift"))
    return tuple(found)


def _mount_prior(prior: Mount, number: int) -> Mount:
    """Return the prior of a mount: without attitudes a lever arm and the shifts are hardly separable, so from step 3
    on.
    """
    if number < 3:
        return dataclasses.replace(prior, lever_arm=FIXED, boresight=FIXED, time_offset=FIXED)  # type: ignore[arg-type]
    return dataclasses.replace(prior, boresight=FREE)  # type: ignore[arg-type]


def _check(block: Block, number: int) -> None:
    """Raise BlockError, with the cure, if `block` lacks what step `number` needs."""
    if number not in STEPS:
        raise ValueError(f"the steps of the boresight are 1, 2, 3 and 4, got {number!r}")
    what = f"step {number} of the boresight needs"
    if number < 4 and not len(block.control.who) + len(block.fixed.who):
        raise BlockError(f"{what} control points and the block has none: add control_points.csv")
    if number == 1:
        return
    if not len(block.stations.who):
        raise BlockError(f"{what} camera stations and the block has none: add stations.csv")
    strips = set(block.image_strip) - {""}
    if not strips:
        raise BlockError(f"{what} strips and the images name none: add the column strip to images.csv")
    if len(strips) == 1:
        raise BlockError(
            f"{what} two strips or more and all images are of strip {strips.pop()}, in which a misalignment looks like "
            "a shift: add a strip flown in the opposite direction, better also one across"
        )
    if number == 2:
        return
    if not len(block.attitudes.image):
        raise BlockError(f"{what} attitudes and the block has none: add attitudes.csv")
    with_attitude = np.asarray(block.attitudes.image).tolist()
    turned = {block.image_mount[i] for i in with_attitude}
    if bare := sorted({block.image_camera[i] for i in with_attitude if not block.image_mount[i]}):
        raise BlockError(
            f"{what} a mount and camera {bare[0]} has none: add [mounts.{bare[0]}] with its lever_arm_m and image_x to "
            "block.toml"
        )
    if blind := [name for name in block.priors.mounts if name not in turned]:
        raise BlockError(f"{what} attitudes and no image of mount {blind[0]} has one: add them to attitudes.csv")
    if number == 4:
        seen = np.bincount(block.image_points.point, minlength=len(block.points))
        held = np.unique(np.concatenate([block.control.who, block.fixed.who]).astype(int))
        if len(lone := held[seen[held] < 2]):
            raise BlockError(
                f"step 4 of the boresight takes the control away, but control point {block.points[lone[0]]} is seen by "
                f"fewer than two images ({len(lone)} such points): measure it in two or more, or remove it"
            )
