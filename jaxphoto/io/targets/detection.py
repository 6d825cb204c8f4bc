"""The targets of a board in many photographs."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxphoto.errors import InputError
from jaxphoto.io.photographs import Photograph
from jaxphoto.io.targets.pattern import Pattern
from jaxphoto.procedures.calibration import Detection


class Targets(NamedTuple):
    """What photographs show of a board."""

    detections: list[Detection]
    left_out: dict[str, str]
    """Photographs in which the board was not found, by the name of the image, each with what was seen instead."""


def find_targets(
    photographs: Sequence[Photograph], pattern: Pattern, progress: Callable[[str], None] = lambda image: None
) -> Targets:
    """Look for the board in every photograph, in the order given; `progress` is told the image that is looked at.

    Raises InputError for a file that OpenCV cannot read, and where no photograph shows the board.
    """
    detections: list[Detection] = []
    left_out: dict[str, str] = {}
    hint = None
    for photograph in photographs:
        progress(photograph.name)
        picture = read_grey(photograph.path)
        found = pattern.find(picture)
        if found is None:
            left_out[photograph.name] = "the board was not found"
            hint = hint or (pattern.hint(picture) if not detections else None)
            continue
        good, places = found.places.found, found.places
        # OpenCV counts from the centre of the upper-left pixel, which is (0.5, 0.5) here.
        column_row = places.column_row[good] + 0.5
        detections.append(Detection(photograph.name, found.point[good], column_row, places.sigma_px[good]))
    if not detections:
        raise InputError(
            f"the board ({pattern.board.name}) was not found in any of the {len(photographs)} photographs; "
            + (hint or "check its description, that all of it is seen in good light, and that it is in focus")
        )
    return Targets(detections, left_out)


def read_grey(path: Path) -> np.ndarray:
    """The grey values (rows, columns) of a photograph as they lie in the file, 0 to 255.

    Raises InputError for what is no picture.
    """
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None:
        raise InputError(f"{path}: this is no picture that OpenCV can read; give a TIFF, PNG or JPEG")
    return picture
