"""What was left out of a block as blunders: a table, and the sentences that the verdict begins with."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.block import Block
from jaxphoto.errors import counted, few
from jaxphoto.observations import AbstractObservations, Correlated
from jaxphoto.procedures import Snooped
from jaxphoto.procedures.mistakes import coordinate_mistakes, is_mirrored
from jaxphoto.procedures.snooping import SEVERAL, images_out, mostly_out
from jaxphoto.report.findings import Finding, Level
from jaxphoto.report.residual_table import in_file_unit
from jaxphoto.statistics import Suspect

_SHOWN = 5
# Errors agree that scatter by no more than so many of their standard deviations.
_AS_ONE = 3.0


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


def snooped_findings(snooped: Snooped, block: Block) -> list[Finding]:
    """What was put right and left out of `block`, in words; first what is rather an error that rows have in common."""
    found = [f"put right: {exchange.words}" for exchange in snooped.exchanged]
    found += _alike(snooped, block)
    for s in snooped.left_out[:_SHOWN]:
        factor, unit = in_file_unit(s.unit)
        found.append(
            f"left out: {s.words}, off by {factor * s.error:+.3g} +- {factor * s.sigma:.2g} {unit} (w {s.w:.1f})"
        )
    if (more := len(snooped.left_out) - _SHOWN) > 0:
        found.append(f"left out: {counted(more, 'more observation')}, see left_out.csv")
    if snooped.points:
        few = ", ".join(snooped.points[:_SHOWN]) + (" ..." if len(snooped.points) > _SHOWN else "")
        found.append(
            f"left out as a whole: point {few}; what is observed of such a point contradicts itself, or too little is "
            "left to place it"
        )
    return [
        *(Finding(Level.ALARM, text) for text in _too_many(snooped, block)),
        *(Finding(Level.WARNING, text) for text in found),
    ]


def _alike(snooped: Snooped, block: Block) -> Iterator[str]:
    """Most numbers of a strip along an axis, or of all, off by the same amount: no blunders."""
    for name, rows, left, axes in _of_further_groups(snooped, block):
        strips = np.broadcast_to(rows.names_of("image", block.image_strip), axes.shape)
        told: set[str] = set()
        of_strips = sorted({(str(axes[s.number, s.row]), str(strips[s.number, s.row])) for s in left})
        for axis, strip in [*((axis, None) for axis in dict.fromkeys(a for a, _ in of_strips)), *of_strips]:
            part = (axes == axis) & ((strips == strip) if strip is not None else True)
            own = [s for s in left if part[s.number, s.row]]
            error, sigma = (np.array([getattr(s, field) for s in own]) for field in ("error", "sigma"))
            mean = float(np.average(error, weights=sigma**-2.0))
            scatter = float(np.sqrt(np.mean(((error - mean) / sigma) ** 2)))
            if axis not in told and len(own) >= SEVERAL and len(own) > part.sum() / 2 and scatter < _AS_ONE:
                # What all have in common, each strip has.
                told |= {axis} if strip is None else set()
                factor, unit = in_file_unit(own[0].unit)
                of = f"{name.replace('_', ' ')}{f' in strip {strip}' if strip else ''} along {axis}"
                yield (
                    f"left out: {len(own)} of the {part.sum()} {of}, which are off alike, by {factor * mean:+.3g} "
                    f"{unit}: no blunders, but an error that they have in common; let it be estimated (such as a "
                    "shift), or mend it where they come from"
                )


def _of_further_groups(
    snooped: Snooped, block: Block
) -> Iterator[tuple[str, AbstractObservations, list[Suspect], np.ndarray]]:
    """Groups besides image points of which several rows are left out, these, and the axis of each number."""
    for name, rows in block.named_observations.items():
        left = [s for s in snooped.left_out if s.group == name]
        if name != IMAGE_POINTS and not isinstance(rows, Correlated) and len(left) >= SEVERAL:
            yield name, rows, left, rows.axis_of_numbers


def _too_many(snooped: Snooped, block: Block) -> Iterator[str]:
    """Images and groups, along an axis, of which too much is left out to be single errors."""
    most = images_out(snooped, block)
    turned = [k for k in most if is_mirrored(snooped, block, k)]
    for which, look in (
        (turned, "they fit where it is mirrored: x and y are exchanged, or one of them has the other sign"),
        (
            [k for k in most if k not in turned],
            "look at its names of points, the axes of its coordinates, its camera and its station, or leave it out",
        ),
    ):
        if images := [f"{block.images[k]} ({most[k][0]} of {most[k][1]})" for k in which]:
            yield f"most image points of image {few(images)} are left out: no single errors; {look}"
    mistakes = coordinate_mistakes(snooped, block)
    for name, counts in mostly_out(snooped, block).items():
        many = ", ".join(f"{n} of {of} in {axis}" for axis, (n, of) in counts.items())
        look = (
            f"they fit where {mistakes[name]}: mend them where they come from"
            if name in mistakes
            else "look at their units, axes, names and signs, and at what is held fixed"
        )
        yield f"of {name.replace('_', ' ')} {many} are left out: no single errors, but the rest against these; {look}"


def _ids(block: Block):
    return (("image", block.images), ("point", block.points))


def _name(rows, what: str, names: tuple[str, ...], row: int) -> str:
    found = rows.names_of(what, names)
    return str(found[..., row] if found.ndim == 1 else found[0, row])
