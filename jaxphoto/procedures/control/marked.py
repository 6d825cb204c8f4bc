"""Marks of surveyed points in the images of a block: which image, which point, where; and which cannot be used."""

import ntpath
import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.block import Block
from jaxphoto.errors import counted, few
from jaxphoto.procedures.control.surveyed import MARK_SIGMA_PX, Marks, SurveyedPoints

_ENDING = re.compile(r"\.[A-Za-z]{2,4}$")


class Marked(NamedTuple):
    """Rows of marks that can be used, sorted by point and image."""

    image: Int[np.ndarray, "rows"]
    """Index into the block's images."""
    point: Int[np.ndarray, "rows"]
    """Index into the surveyed points."""
    xy_mm: Float[np.ndarray, "rows 2"]
    sigma_mm: Float[np.ndarray, "rows"]

    def take(self, chosen: np.ndarray) -> "Marked":
        """Those that a mask or indices choose."""
        return Marked(*(v[chosen] for v in self))


def marked(
    block: Block, points: SurveyedPoints, marks: Marks, elsewhere: Collection[str] = ()
) -> tuple[Marked, list[str]]:
    """The marks of `points` in the images of `block`, and a sentence for those that cannot be used.

    An image is found by the name of its file, whatever folder, ending and case. `elsewhere` are images that are known,
    but in no block or another: no word is lost on marks in these.
    """
    image = images_of(marks.image, block.images)
    other = images_of(marks.image, tuple(elsewhere)) >= 0
    place = {name: k for k, name in enumerate(points.ids)}
    point = np.array([place.get(name, -1) for name in marks.point], int)
    said: list[str] = []
    _say(said, marks, (image < 0) & ~other, marks.image, "of no photograph that is used")
    _say(said, marks, (point < 0), marks.point, f"of points without coordinates in {points.file}")
    size = np.array([(s.width_px, s.height_px) for s in (block.sensors[c] for c in block.image_camera)], float)
    outside = ((marks.column_row < 0) | (marks.column_row > size[image])).any(axis=1) & (image >= 0) & (point >= 0)
    _say(said, marks, outside, marks.image, "outside of the picture")
    kept = np.flatnonzero((image >= 0) & (point >= 0) & ~outside)
    kept = kept[np.lexsort((image[kept], point[kept]))]
    # The same photograph under two names.
    twice = np.r_[False, (np.diff(image[kept]) == 0) & (np.diff(point[kept]) == 0)] if len(kept) else np.zeros(0, bool)
    _say(said, marks, np.isin(np.arange(len(image)), kept[twice]), marks.point, "there twice for one photograph")
    kept = kept[~twice]
    sigma = np.where(np.isnan(marks.sigma_px), MARK_SIGMA_PX, marks.sigma_px)[kept]
    xy = np.zeros((len(kept), 2))
    pixel = np.zeros(len(kept))
    for k, row in enumerate(kept.tolist()):
        sensor = block.sensors[block.image_camera[image[row]]]
        xy[k], pixel[k] = sensor.mm_from_px(marks.column_row[row][None])[0], sensor.pixel_mm
    return Marked(image[kept], point[kept], xy, sigma * pixel), said


def images_of(names: Sequence[str], images: Sequence[str]) -> Int[np.ndarray, "names"]:
    """The image that each name means; -1 for none, or for more than one."""
    exact = {name: k for k, name in enumerate(images)}
    loose: dict[str, int] = {}
    for k, name in enumerate(images):
        loose[name.lower()] = k if name.lower() not in loose else -1
    found = []
    for name in names:
        file = ntpath.basename(name)
        stem = _ENDING.sub("", file)
        hits = [exact[word] for word in (name, file, stem) if word in exact]
        found.append(hits[0] if hits else loose.get(stem.lower(), loose.get(file.lower(), -1)))
    return np.array(found, int)


def _say(said: list[str], marks: Marks, wrong: np.ndarray, names: Sequence[str], what: str) -> None:
    """A sentence on the marks that are `wrong`, with the first of them."""
    which = np.flatnonzero(wrong)
    if len(which):
        listed = few(list(dict.fromkeys(names[int(k)] for k in which)))
        said.append(f"left out: {counted(len(which), 'mark')} {what}: {listed} ({marks.places[which[0]]})")
