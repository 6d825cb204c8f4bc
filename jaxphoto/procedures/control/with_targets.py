"""Control whose targets are found in the photographs: predicted, looked for, adjusted with, and once more from there.

The first round looks as far as what is known of the block leaves open, the next ones only as far as the block with the
targets that were found does, which decides between targets that look alike. What was found far from where the others
have the block is looked for anew from there, and gives way to what is found: it was another thing.
"""

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.errors import InputError, counted
from jaxphoto.procedures.adjust import adjust_for_tables
from jaxphoto.procedures.control.control_block import ControlledBlock, control_block
from jaxphoto.procedures.control.judged import CRITICAL
from jaxphoto.procedures.control.marked import Marked, marked
from jaxphoto.procedures.control.onto_control import MINIMAL_SIZES
from jaxphoto.procedures.control.placed import in_frame
from jaxphoto.procedures.control.search import Looker, found_marks
from jaxphoto.procedures.control.surveyed import SIGMA_M, GivenControl, Marks

_ROUNDS = 3
# Of what the other surveyed points are off (median): what was found so far away may be another thing.
_FAR = 10.0


def control_block_with_targets(
    block: Block,
    control: GivenControl,
    looker: Looker,
    *,
    system: str | None = None,
    code: int | None = None,
    vertical: int | None = None,
    elsewhere: Collection[str] = (),
    adjust: Callable[[Block], Adjustment] = adjust_for_tables,
    report: Callable[[str], object] = lambda text: None,
) -> ControlledBlock:
    """`control_block` with the marks of `control` and those that `looker` finds.

    Raises InputError as it does, and for a block in a frame of its own without marks of three control points: nobody
    knows where to look there.
    """
    points, ids = control.points, control.points.ids
    sigma = np.where(np.isnan(points.sigma_m), SIGMA_M, points.sigma_m)
    by_hand, _ = marked(block, points, control.marks, elsewhere)
    now: ControlledBlock | None = None
    how: dict[str, Any] = {"system": system, "code": code, "vertical": vertical, "elsewhere": elsewhere}
    how |= {"adjust": adjust, "report": report}
    if len(by_hand.image):
        now = control_block(block, control, **how)
    elif block.frame.kind != "epsg":
        raise InputError(
            f"{points.file}: the block has no place, so nobody knows where its photographs show the points; mark three "
            "control points by hand, each in two photographs or more"
        )
    adjusted = now.adjusted if now else adjust(block)
    looked: dict[str, set[str]] = {name: set() for name in ids}
    seen: dict[str, set[str]] = {name: set() for name in ids}
    why_not: dict[str, str] = {}
    anew: dict[int, float] = {}
    every = control.marks
    for _ in range(_ROUNDS):
        report("looking for targets")
        frame = in_frame(adjusted.block, points, system, code, vertical)
        # By marks, by targets of an earlier round, or by control that the block came with.
        placed = len(adjusted.block.control) > 0
        # Each but once: what is found again is no other.
        far = {p: off for p, off in _far(now, by_hand).items() if p not in anew} if now else {}
        rows = (by_hand, now.marks.take(~np.isin(now.marks.point, list(far)))) if now else (by_hand,)
        known = {pair for of in rows for pair in zip(of.image.tolist(), of.point.tolist(), strict=True)}
        found = found_marks(adjusted, ids, frame.xyz, sigma, known, looker, placed)
        for name, images in found.looked.items():
            looked[name] |= set(images)
        gone = {p: off for p, off in far.items() if ids[p] in found.marks.point}
        anew |= gone
        seen |= {ids[p]: set() for p in gone}
        for name, image in zip(found.marks.point, found.marks.image, strict=True):
            seen[name].add(image)
        why_not |= found.why_not
        if not len(found.marks.image):
            break
        # Where one of an earlier round was left out, another may be found in its place; what is far goes as a whole.
        again = set(zip(found.marks.image, found.marks.point, strict=True))
        names = {ids[p] for p in gone}
        kept = [(i, p) not in again and p not in names for i, p in zip(every.image, every.point, strict=True)]
        every = Marks.joined(every.take(np.array(kept, bool)), found.marks)
        now = control_block(block, control._replace(marks=every), **how)
        adjusted = now.adjusted
    texts = _told(ids, seen, looked, why_not)
    if now is None:
        raise InputError(f"{points.file}: no target was found; {'; '.join(texts)}")
    still = _far(now, by_hand)
    texts += [
        f"the target of {ids[p]} was found anew, {off:.2g} m from what was first taken for it"
        for p, off in anew.items()
        if p not in still
    ]
    texts += [
        f"what was found for check point {ids[p]} lies {off:.2g} m from its place: see whether it is its target, or "
        "mark it by hand"
        for p, off in still.items()
        if points.check[p]
    ]
    return now._replace(sentences=(*texts, *now.sentences))


def _far(now: ControlledBlock, by_hand: Marked) -> dict[int, float]:
    """Of points that were found far from their place, not by hand, and that nothing is adjusted with: how far (m).

    They stay unless another target is found: a block may be bent there, which check points are to tell.
    """
    state, off = np.array(now.state, object), np.linalg.norm(np.nan_to_num(now.off_m), axis=1)
    if (state == "control").sum() < MINIMAL_SIZES:
        return {}
    usual = np.median(off[np.isin(state, ["control", "check"])])
    far = np.isin(state, ["check", "left out"]) & (np.nan_to_num(now.w).max(axis=1) > CRITICAL) & (off > _FAR * usual)
    return {p: float(off[p]) for p in np.flatnonzero(far).tolist() if p not in by_hand.point}


def _told(
    ids: tuple[str, ...], seen: dict[str, set[str]], looked: dict[str, set[str]], why_not: dict[str, str]
) -> list[str]:
    """One sentence on what was found in all rounds, and one for each point that was found in none."""
    found = [f"{name} in {len(seen[name])} of {len(looked[name])}" for name in ids if seen[name]]
    count = f"{counted(len(found), 'target')} found in the photographs that should show them"
    return [f"{count}: {', '.join(found)}"] * bool(found) + [why_not[p] for p in ids if p in why_not and not seen[p]]
