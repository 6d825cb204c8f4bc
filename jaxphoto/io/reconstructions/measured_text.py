"""Texts of image points, photograph by photograph: those of BINGO, PATB and Pix4D.

    IMAGE [CAMERA | c flags]            the head of a photograph
    point x y ...                       its points
    -99                                 its end; BINGO's of Pix4D has an empty line instead

Sources: Pix4D support, articles 203590305 ("What is the bingo file generated during Initial Processing?") and
202977149; PCI Geomatics, OrthoEngine, "Exporting a project to PATB".
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.control_files.bingo import recognises as is_geoin
from jaxphoto.io.reconstructions.numbers import beginning, row_numbers
from jaxphoto.io.text_tables import is_number
from jaxphoto.io.whole_text import LARGE, read_text

ENDS = "-99"
# Characters of a file in which the end of its first photograph stands.
_HEAD = 1_000_000


class MeasuredText(NamedTuple):
    """What a file says; coordinates in its unit."""

    heads: list[str]
    """The head line of each photograph."""
    photograph: Int[np.ndarray, "n"]
    """Of each point, the head below which it stands."""
    points: list[str]
    xy: Float[np.ndarray, "n 2"]


def is_measured(path: Path) -> bool:
    """Whether a file begins as one of these: a head, a row of point, x, y, and somewhere an end."""
    begin = beginning(path, _HEAD)
    lines = [line.split() for line in begin]
    if len(lines) < 3 or is_geoin(begin) or not _is_row(lines[1]) or _is_head(lines[1]):
        return False
    return not _is_row(lines[0]) or [ENDS] in lines


def read_measured(path: Path) -> MeasuredText:
    """The image points of a file. Raises InputError for a row that is neither a head nor point, x and y."""
    heads: list[str] = []
    photograph, points, rows = [], [], []
    within = False
    for k, line in enumerate(read_text(path, LARGE).split("\n"), 1):
        words = line.split()
        if not words or words == [ENDS]:
            within = False
        elif not within or _is_head(words):
            heads.append(line.strip())
            within = True
        elif len(words) < 3:
            raise InputError(f"{path.name}, row {k}: {quoted(line)} is not point, x, y; export the file anew")
        else:
            photograph.append(len(heads) - 1)
            points.append(words[0])
            rows.append(row_numbers(path, k, words[1:3], 2))
    return MeasuredText(heads, np.array(photograph, int), points, np.array(rows).reshape(-1, 2))


def _is_row(words: list[str]) -> bool:
    return len(words) >= 3 and is_number(words[1]) and is_number(words[2])


def _is_head(words: list[str]) -> bool:
    """Whether it is a head although no end stands before it: an image and what no coordinate can be."""
    return len(words) == 2 and not is_number(words[1])
