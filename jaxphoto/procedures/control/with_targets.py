"""Control whose targets are found in the photographs: predicted, looked for, adjusted with, and once more from there.

The first round looks as far as what is known of the block leaves open, the next ones only as far as the block with the
targets that were found does, which decides between targets that look alike.
"""

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.errors import InputError
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
    said: dict[str, list[str]] = {name: [] for name in ids}
    every = control.marks
    for _ in range(_ROUNDS):
        report("looking for targets")
        frame = in_frame(adjusted.block, points, system, code, vertical)
        placed = now is not None and "control" in now.state
        own = now.marks if now else None
        found = found_marks(adjusted, ids, frame.xyz, sigma, own, looker, placed)
        seen = set(found.marks.point)
        for name, text in found.said.items():
            # A point that has been found need not be found in every photograph.
            if name in seen or not any("was found" in old for old in said[name]):
                said[name] = [*(old for old in said[name] if "was found" in old), text]
        if not len(found.marks.image):
            break
        every = Marks.joined(every, found.marks)
        now = control_block(block, control._replace(marks=every), **how)
        adjusted = now.adjusted
    texts = tuple(text for of in said.values() for text in of)
    if now is None:
        raise InputError(f"{points.file}: no target was found; {'; '.join(texts)}")
    return now._replace(sentences=(*texts, *now.sentences))
