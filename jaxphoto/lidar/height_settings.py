"""Settings of height interpolation, and flags of heights."""

import enum

import equinox as eqx
import numpy as np

from jaxphoto.errors import InputError


class HeightFlag(enum.IntFlag):
    """Problems of a height; several may apply."""

    OK = 0
    HOLE = 1
    """No point is close enough, given the density of the surrounding points."""
    EDGE = 2
    """The nearest points do not surround the place: it would be extrapolated."""
    VEGETATION = 4
    """The nearest points are vegetation or of several returns, or too rough for a surface."""
    BREAKLINE = 8
    """The nearest points lie on two surfaces: wall, ridge, kerb."""
    PLANE = 16
    """`local` fitted a plane to the nearest points, which do not determine a quadratic; not refused."""


REFUSED = HeightFlag.HOLE | HeightFlag.EDGE | HeightFlag.VEGETATION | HeightFlag.BREAKLINE


class HeightSettings(eqx.Module):
    """Settings of height interpolation, and errors of the lidar.

    `points` is the number of nearest points of `idw` and `plane`; if `radius_m` is given they use all points within it
    instead. `local` uses three times `points`, at least 24. `power` is that of `idw`. Standard deviations are those of
    a laser point in Z and in each of X and Y, and of the common error of all points. A place is flagged if the fraction
    `leafy_share` of the points used is vegetation or of several returns; heights with a flag of `refuse` are NaN.
    """

    points: int = 8
    power: float = 2.0
    radius_m: float | None = None
    sigma_z_m: float = 0.15
    sigma_xy_m: float = 0.5
    sigma_systematic_m: float = 0.0
    leafy_share: float = 0.25
    refuse: HeightFlag = REFUSED

    def __check_init__(self) -> None:
        if self.points < 4:
            raise InputError(f"points is {self.points}, and heights need 4 points at least: give 4 or more")
        for name in ("power", "sigma_z_m", "radius_m"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value}: give a positive number")
        for name in ("sigma_xy_m", "sigma_systematic_m", "leafy_share"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InputError(f"{name} is {getattr(self, name)}: give a number that is not negative")
