"""Attitudes in radians under columns in degrees, told by the direction of flight."""

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import InputError
from jaxphoto.georeferencing.yaw_units import counts_in_radians
from jaxphoto.io.block_folder.images import Images
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import StationRows


def check_attitude_units(table: Table, stations: StationRows, images: Images) -> None:
    """`check_yaw` of the attitudes as attitudes.csv gives them, against the flight from image to image of a strip."""
    yaw = np.full(len(images.ids), np.nan)
    yaw[images.find(table)] = table.numbers("yaw_deg")
    position = np.where(images.known[:, None], np.asarray(images.exterior.position), np.nan)
    position[stations.who, stations.axis] = stations.value
    first, second = _consecutive(images)
    check_yaw(yaw[first], position[second] - position[first], table.file)


def check_yaw(yaw: Float[np.ndarray, "n"], flown: Float[np.ndarray, "n 3"], file: str) -> None:
    """Raise InputError where `yaw` follows the way `flown` when read as radians, and does not when read as degrees."""
    course = np.arctan2(flown[:, 0], flown[:, 1])
    known = ~np.isnan(course) & ~np.isnan(yaw)
    course, yaw = course[known], yaw[known]
    if not counts_in_radians(yaw, course):
        return
    raise InputError(
        f"{file}: the yaw angles lie between {yaw.min():.2f} and {yaw.max():.2f} and follow the direction of flight as "
        "radians, not as degrees; convert roll, pitch and yaw to degrees"
    )


def _consecutive(images: Images) -> tuple[np.ndarray, np.ndarray]:
    """Images that follow each other in a strip, by time where it is known, else as the file lists them."""
    strips = np.unique(np.array(images.strips, object).astype(str), return_inverse=True)[1]
    order = np.lexsort((np.arange(len(strips)), images.times, strips))
    same = strips[order[1:]] == strips[order[:-1]]
    return order[:-1][same], order[1:][same]
