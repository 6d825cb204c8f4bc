"""Control whose targets are found in the photographs: predicted, looked for, adjusted with, and once more from there.

The first round looks as far as what is known of the block leaves open, the next ones only as far as the block with the
targets that were found does, which decides between targets that look alike.
"""

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.errors import InputError, counted
from jaxphoto.procedures.adjust import adjust_for_tables
from jaxphoto.procedures.control.control_block import ControlledBlock, control_block
from jaxphoto.procedures.control.marked import marked
from jaxphoto.procedures.control.placed import in_frame
from jaxphoto.procedures.control.search import Looker, found_marks
from jaxphoto.procedures.control.surveyed import SIGMA_M, GivenControl, Marks

_ROUNDS = 3


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
    every = control.marks
    for _ in range(_ROUNDS):
        report("looking for targets")
        frame = in_frame(adjusted.block, points, system, code, vertical)
        # By marks, by targets of an earlier round, or by control that the block came with.
        placed = len(adjusted.block.control) > 0
        rows = (by_hand, now.marks) if now else (by_hand,)
        known = {pair for of in rows for pair in zip(of.image.tolist(), of.point.tolist(), strict=True)}
        found = found_marks(adjusted, ids, frame.xyz, sigma, known, looker, placed)
        for name, images in found.looked.items():
            looked[name] |= set(images)
        for name, image in zip(found.marks.point, found.marks.image, strict=True):
            seen[name].add(image)
        why_not |= found.why_not
        if not len(found.marks.image):
            break
        # Where one of an earlier round was left out, another may be found in its place.
        again = set(zip(found.marks.image, found.marks.point, strict=True))
        kept = [pair not in again for pair in zip(every.image, every.point, strict=True)]
        every = Marks.joined(every.take(np.array(kept, bool)), found.marks)
        now = control_block(block, control._replace(marks=every), **how)
        adjusted = now.adjusted
    texts = _told(ids, seen, looked, why_not)
    if now is None:
        raise InputError(f"{points.file}: no target was found; {'; '.join(texts)}")
    return now._replace(sentences=(*texts, *now.sentences))


def _told(
    ids: tuple[str, ...], seen: dict[str, set[str]], looked: dict[str, set[str]], why_not: dict[str, str]
) -> list[str]:
    """One sentence on what was found in all rounds, and one for each point that was found in none."""
    found = [f"{name} in {len(seen[name])} of {len(looked[name])}" for name in ids if seen[name]]
    count = f"{counted(len(found), 'target')} found in the photographs that should show them"
    return [f"{count}: {', '.join(found)}"] * bool(found) + [why_not[p] for p in ids if p in why_not and not seen[p]]
