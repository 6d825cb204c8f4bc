"""Photographs in the map system of their block: positions on the map, angles against the lines of its grid.

A map is not Cartesian. The position of every photograph is exact there, and so is its rotation against grid east, grid
north and up at its own place (the convergence of the meridians and the tilt of the vertical against that of the block's
origin are taken off); but collinearity with the object points in map coordinates holds only as far as the map is true
to scale and the earth flat. By how much it misses is told.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import still
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing.map_frame import map_name
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs


class MapPhotographs(NamedTuple):
    """Orientations and points in the coordinates of the block's files."""

    exterior: ExteriorOrientation
    xyz: Float[np.ndarray, "points 3"]
    system: str
    """EPSG:code, with the code of the heights where these are not above the ellipsoid; empty for a local frame."""
    geographic: bool
    """Coordinates are longitude and latitude in degrees, with the height in metres."""


class Misfit(NamedTuple):
    """Lengths of displacements of image points in pixels."""

    rms_px: float
    max_px: float


def in_map(photographs: AdjustedPhotographs) -> MapPhotographs:
    """The photographs in the system of the block's files; a local frame is that of its files already."""
    frame = photographs.frame
    if frame.kind != "epsg" or frame.code is None:
        return MapPhotographs(photographs.exterior, photographs.xyz, "", False)
    system, position = frame.map, np.asarray(photographs.exterior.position)
    rotations = np.asarray(photographs.exterior.camera_from_object) @ system.local_from_grid(position)
    name = map_name(frame.code, frame.vertical)
    exterior = ExteriorOrientation(still(system.map(position)), still(rotations))
    return MapPhotographs(exterior, system.map(photographs.xyz), name, system.geographic)


def map_misfit(photographs: AdjustedPhotographs) -> Misfit | None:
    """How far image points lie off where collinearity is computed in map coordinates; None where these are no metres.

    In the ideal image, before distortion.
    """
    on_map = in_map(photographs)
    if on_map.geographic or not len(photographs.image):
        return None
    there, here = (
        _ideal_px(photographs, exterior, xyz)
        for exterior, xyz in ((on_map.exterior, on_map.xyz), (photographs.exterior, photographs.xyz))
    )
    return misfit_of(there - here)


def misfit_of(displacements: Float[np.ndarray, "n 2"]) -> Misfit:
    """Of displacements in pixels."""
    apart = np.linalg.norm(displacements, axis=1)
    return Misfit(float(np.sqrt(np.mean(apart**2))), float(apart.max())) if len(apart) else Misfit(0.0, 0.0)


def _ideal_px(photographs: AdjustedPhotographs, exterior: ExteriorOrientation, xyz: np.ndarray) -> np.ndarray:
    ray = xyz[photographs.point] - np.asarray(exterior.position)[photographs.image]
    in_camera = np.einsum("nij,nj->ni", np.asarray(exterior.camera_from_object)[photographs.image], ray)
    of_row, ideal = np.array(photographs.image_camera, object)[photographs.image], np.zeros((len(ray), 2))
    for name, (sensor, interior) in photographs.cameras.items():
        own = of_row == name
        xy = interior.projection.ideal_from_direction(still(interior.c), *in_camera[own].T)
        ideal[own] = np.stack([still(v) for v in xy], axis=1) / sensor.pixel_mm
    return ideal
