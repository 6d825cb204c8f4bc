"""The targets of a board in many photographs."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from jaxphoto.errors import InputError
from jaxphoto.extras.photos.grey_values import read_grey
from jaxphoto.extras.photos.targets.pattern import Pattern
from jaxphoto.io.photographs import Photograph
from jaxphoto.procedures.calibration import Detection

# Photographs without the board that are asked for another one.
_LOOKED_AT = 5


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
    for photograph in photographs:
        progress(photograph.name)
        picture = read_grey(photograph.path)
        found = pattern.find(picture)
        if found is None:
            left_out[photograph.name] = "the board was not found"
            continue
        good, places = found.places.found, found.places
        # OpenCV counts from the centre of the upper-left pixel, which is (0.5, 0.5) here.
        column_row = places.column_row[good] + 0.5
        detections.append(Detection(photograph.name, found.point[good], column_row, places.sigma_px[good]))
    if not detections:
        hint = pattern.hint([read_grey(photograph.path) for photograph in photographs[:_LOOKED_AT]])
        raise InputError(
            f"the board ({pattern.board.name}) was not found in any of the {len(photographs)} photographs; "
            + (hint or "check its description, that all of it is seen in good light, and that it is in focus")
        )
    return Targets(detections, left_out)
