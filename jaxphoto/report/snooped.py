"""What was left out of a block as blunders: a table, and the sentences that the verdict begins with."""

import pandas as pd

from jaxphoto.block import Block
from jaxphoto.procedures import Snooped
from jaxphoto.report.findings import Finding, Level
from jaxphoto.report.tables import in_file_unit

_SHOWN = 5


def left_out_table(snooped: Snooped, block: Block) -> pd.DataFrame:
    """group, image, point, observation, error, sigma, unit, w of all that was left out of `block`, the worst first.

    `error` is observed minus predicted by the others, with its standard deviation. Rows of points that went as a whole,
    because too little was left of them, follow without numbers.
    """
    groups = block.named_observations
    found: list[tuple] = []
    for s in snooped.left_out:
        rows = groups[s.group]
        image, point = (_name(rows, what, names, s.row) for what, names in _ids(block))
        factor, unit = in_file_unit(s.unit)
        found.append((s.group, image, point, s.words, factor * s.error, factor * s.sigma, unit, s.w))
    found += [("", "", point, f"point {point}", None, None, "", None) for point in snooped.points]
    columns = ["group", "image", "point", "observation", "error", "sigma", "unit", "w"]
    return pd.DataFrame(found, columns=columns)


def snooped_findings(snooped: Snooped) -> list[Finding]:
    """What was left out and put right, in words."""
    found = []
    for s in snooped.left_out[:_SHOWN]:
        factor, unit = in_file_unit(s.unit)
        found.append(
            f"left out: {s.words}, off by {factor * s.error:+.3g} +- {factor * s.sigma:.2g} {unit} (w {s.w:.1f})"
        )
    if (more := len(snooped.left_out) - _SHOWN) > 0:
        found.append(f"left out: {more} more observations, see left_out.csv")
    if snooped.points:
        few = ", ".join(snooped.points[:_SHOWN]) + (" ..." if len(snooped.points) > _SHOWN else "")
        found.append(
            f"left out as a whole: point {few}; what is observed of such a point contradicts itself, or too little is "
            "left to place it"
        )
    found += [f"put right: {exchange.words}" for exchange in snooped.exchanged]
    return [Finding(Level.WARNING, text) for text in found]


def _ids(block: Block):
    return (("image", block.images), ("point", block.points))


def _name(rows, what: str, names: tuple[str, ...], row: int) -> str:
    found = rows.names_of(what, names)
    return str(found[..., row] if found.ndim == 1 else found[0, row])
