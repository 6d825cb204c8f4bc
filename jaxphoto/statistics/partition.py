"""Partitions of the observations: who shares a variance component with whom.

A partition is declared by splits of the groups of observations, or by a selection of observations for each label:

    variance_components(adjusted, ("xy-z", "camera"))
    variance_components(adjusted, {"height": Selection("control_points", axes="Z"), "GNSS": Selection("stations")})

What is known beforehand of unknowns (`Weighted`, `KnownParameters`) is no sample of anything: it keeps its weight.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int, Shaped

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.block import Block
from jaxphoto.errors import InputError
from jaxphoto.observations import AXES, AbstractObservations, Correlated
from jaxphoto.short_repr import shown
from jaxphoto.statistics.discrepancy import observation_groups


@shown
class Selection(NamedTuple):
    """Observations of one group; all of them, or only those along some axes, of some cameras, images or points."""

    group: str
    axes: Collection[str] = ()
    cameras: Collection[str] = ()
    images: Collection[str] = ()
    points: Collection[str] = ()


Partition = Sequence[str] | Mapping[str, Selection | Sequence[Selection]]
"""Splits, words of `SPLITS`, none for one part a group; or what belongs to each label."""


@shown
class Parts(NamedTuple):
    """A partition of the observations of one adjustment."""

    labels: tuple[str, ...]
    of: dict[str, Int[np.ndarray, "..."]]
    """The part of every observation by the names of their groups, shaped like the residuals; the number of parts where
    it is in none."""

    @property
    def counts(self) -> Int[np.ndarray, "parts"]:
        """Observations of each part."""
        parts = np.concatenate([np.ravel(v) for v in self.of.values()])
        return np.bincount(parts, minlength=len(self.labels) + 1)[: len(self.labels)]


Names = Shaped[np.ndarray, "..."]
_Split = Callable[[AbstractObservations, Block], Names | None]


def _by_axis(rows: AbstractObservations, block: Block) -> Names | None:
    return None if isinstance(rows, Correlated) else rows.axis_names()


def _plan_and_height(rows: AbstractObservations, block: Block) -> Names | None:
    axis = _by_axis(rows, block)
    if axis is None or not set(axis.ravel()) <= set(AXES):
        return None
    return np.where(axis == "Z", "Z", "X-Y").astype(object)


def _by_camera(rows: AbstractObservations, block: Block) -> Names | None:
    return rows.names_of("image", block.image_camera) if rows.group == IMAGE_POINTS else None


def _by_image(rows: AbstractObservations, block: Block) -> Names | None:
    return rows.names_of("image", block.images) if rows.group == IMAGE_POINTS else None


SPLITS: dict[str, _Split] = {"xy-z": _plan_and_height, "axis": _by_axis, "camera": _by_camera, "image": _by_image}
"""What parts a group: X and Y from Z; each axis from the others; image points by camera; image points by image."""


def observed_rows(adjusted: Adjustment) -> dict[str, AbstractObservations]:
    """The rows that may have variance components, by the names of their groups: all but what is known beforehand."""
    known = observation_groups(adjusted)
    return {name: known[name] for name in adjusted.block.named_observations}


def parts_of(adjusted: Adjustment, partition: Partition) -> Parts:
    """The parts of an adjustment's observations, in the order of the partition.

    Raises InputError for a split, a group or a name that there is not, for a label without observations, for
    observations with two labels, and where rows that a covariance joins would be parted.
    """
    rows = observed_rows(adjusted)
    if isinstance(partition, Mapping):
        names, labels = _selected(adjusted, rows, partition), tuple(partition)
    else:
        names = _split(adjusted, rows, partition)
        labels = tuple(dict.fromkeys(label for of in names.values() for label in of.ravel().tolist()))
    place = {"": len(labels)} | {label: k for k, label in enumerate(labels)}
    numbered = {name: np.vectorize(place.__getitem__, otypes=[int])(of) for name, of in names.items()}
    given = adjusted.residuals.named
    return Parts(labels, {name: numbered.get(name, np.full(np.shape(v), len(labels))) for name, v in given.items()})


def _split(adjusted: Adjustment, rows: Mapping[str, AbstractObservations], words: Sequence[str]) -> dict[str, Names]:
    words = (words,) if isinstance(words, str) else words
    if unknown := [word for word in words if word not in SPLITS]:
        raise InputError(f"there is no split {unknown[0]!r} of observations: there are {', '.join(SPLITS)}")
    found = {}
    for name, own in rows.items():
        label = np.full(np.shape(adjusted.residuals[name]), name, object)
        for word in words:
            further = SPLITS[word](own, adjusted.block)
            if further is not None and len(set(further.ravel())) > 1:
                label = label + " " + further
        found[name] = label
    return found


def _selected(
    adjusted: Adjustment, rows: Mapping[str, AbstractObservations], partition: Mapping[str, Any]
) -> dict[str, Names]:
    found = {name: np.full(np.shape(adjusted.residuals[name]), "", object) for name in rows}
    for label, chosen in partition.items():
        for selection in [chosen] if isinstance(chosen, Selection) else chosen:
            if selection.group not in rows:
                raise InputError(
                    f"{label}: the block observes no {selection.group!r} that could have a variance component; "
                    f"there are {', '.join(rows)}"
                )
            mask = _mask(label, selection, rows[selection.group], adjusted.block, found[selection.group].shape)
            if twice := set(found[selection.group][mask]) - {""}:
                raise InputError(f"{label} and {min(twice)} share observations: leave them in one of the two")
            found[selection.group][mask] = label
        if not label or not any((of == label).any() for of in found.values()):
            raise InputError(f"a part {label!r} of the partition has no name or no observations: leave it out")
    for name, own in rows.items():
        if isinstance(own, Correlated) and found[name].ndim > 1 and (found[name] != found[name][:1]).any():
            raise InputError(f"{name}: rows that a covariance joins share a variance component; select whole sets")
    return found


def _mask(
    label: str, selection: Selection, rows: AbstractObservations, block: Block, shape: tuple[int, ...]
) -> np.ndarray:
    """Which numbers of a group a selection means. Raises InputError for names that none of them has."""
    known = {
        "axes": rows.axis_names(),
        "cameras": rows.names_of("image", block.image_camera),
        "images": rows.names_of("image", block.images),
        "points": rows.names_of("point", block.points),
    }
    mask = np.ones(shape, bool)
    for what, names in known.items():
        wanted = getattr(selection, what)
        wanted = (wanted,) if isinstance(wanted, str) else tuple(wanted)
        if missing := set(wanted) - set(names.ravel().tolist()):
            raise InputError(f"{label}: no row of {selection.group} is of the {what} {', '.join(sorted(missing))}")
        if wanted:
            mask &= np.broadcast_to(np.isin(names, wanted), shape)
    return mask
