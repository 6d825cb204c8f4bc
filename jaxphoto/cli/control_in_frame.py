"""Surveyed points of a file in the frame in which a cloud is adjusted."""

import warnings
from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError
from jaxphoto.io.clouds.placement import Placement
from jaxphoto.io.control_files import read_control
from jaxphoto.procedures.control import SurveyedPoints
from jaxphoto.procedures.control.surveyed import system_of
from jaxphoto.procedures.lidar.strip_control import check_complete


def control_in_frame(path: Path, placement: Placement) -> SurveyedPoints:
    """The points of a file, which are in the system of the cloud that `placement` places, in metres.

    Raises InputError for a file that names another system, for points without heights or standard deviations, and where
    the system of the cloud does not reach. A UserWarning says that marks in photographs are not used.
    """
    points, marks = read_control(path)
    if len(marks.image):
        warnings.warn(
            f"{points.file}: its {len(marks.image)} marks in photographs are not used: give them to the block",
            UserWarning,
            stacklevel=2,
        )
    plane, heights = placement.system.plane, placement.system.heights
    if points.system:
        given = system_of(points.system, points.file)
        other = given.crs is not None and plane is not None and not plane.equals(given.crs, ignore_axis_order=True)
        above = given.vertical is not None and isinstance(heights, int) and heights != given.vertical
        if other or above or (given.crs is None) != (plane is None):
            raise InputError(
                f"{points.file} is in {given.name}, and {placement.name} in {placement.system.name}: give the control "
                "in the system of the cloud"
            )
    check_complete(points)
    xyz = points.coordinates
    if points.own_axes and plane is not None and plane.axis_info[0].direction == "north":
        xyz = xyz[:, [1, 0, 2]]
    placed = placement.frame_from_metres(xyz)
    for k in np.flatnonzero(~np.isfinite(placed).all(axis=1)):
        raise InputError(
            f"{points.places[k]}: point {points.ids[k]} lies where {placement.system.name} does not reach; correct its "
            "coordinates, easting first, or give the control in the system of the cloud"
        )
    return points._replace(coordinates=placed)
