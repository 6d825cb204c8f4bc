"""Control and check points of a block, for formats that have such: points, not rows of coordinates.

A point that is control in some coordinates and a check in others is control in the former alone.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.block import Block, Frame
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.observations import ControlRows

# Of a coordinate that the block holds fixed, in formats that have no such.
_HELD_M = 1e-4


class ControlPoints(NamedTuple):
    """By point of the block: coordinates in its Cartesian frame (m) and their standard deviations."""

    point: Int[np.ndarray, "known"]
    xyz: Float[np.ndarray, "known 3"]
    """NaN for a coordinate that is not given."""
    sigma_m: Float[np.ndarray, "known 3"]
    """NaN where there is none; of a coordinate that is held 0.1 mm."""
    check: Bool[np.ndarray, "known"]

    @staticmethod
    def of(block: Block) -> "ControlPoints":
        """Those of a block, control first."""
        control = _points([(block.control, np.nan), (block.fixed, _HELD_M)], len(block.points))
        check = _points([(block.check, np.nan)], len(block.points))
        only = ~np.isin(check.point, control.point)
        arrays = (np.concatenate([a, b[only]]) for a, b in zip(control, check, strict=True))
        point, xyz, sigma, _ = arrays
        return ControlPoints(point, xyz, sigma, np.arange(len(point)) >= len(control.point))

    def on_map(self, frame: Frame, points: Float[np.ndarray, "points 3"], *, ellipsoidal: bool = False) -> np.ndarray:
        """Coordinates in the system of the files of `frame`, with heights above its ellipsoid if that is said.

        `points` are the adjusted ones of the block, which complete what is not given on the way, as it is NaN again.
        """
        if frame.kind != "epsg":
            return self.xyz
        assert frame.code is not None and frame.origin is not None
        system = MapFrame(frame.code, None, frame.origin) if ellipsoidal else frame.map
        missing = np.isnan(self.xyz)
        return np.where(missing, np.nan, system.map(np.where(missing, points[self.point], self.xyz)))


def _points(kinds: list[tuple[ControlRows, float]], n_points: int) -> ControlPoints:
    """Rows by point, each kind with the standard deviation that stands for none."""
    xyz, sigma = np.full((n_points, 3), np.nan), np.full((n_points, 3), np.nan)
    for rows, none in kinds:
        at, given = (np.asarray(rows.who), np.asarray(rows.axis)), np.asarray(rows.sigma)
        xyz[at], sigma[at] = np.asarray(rows.value), np.where(given > 0, given, none)
    known = np.flatnonzero(~np.isnan(xyz).all(axis=1))
    return ControlPoints(known, xyz[known], sigma[known], np.zeros(len(known), bool))
