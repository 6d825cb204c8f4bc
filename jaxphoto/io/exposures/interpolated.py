"""A trajectory of positions at the times of exposures."""

import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.io.exposures.records import Exposures

# Of the usual interval: a longer one is a gap.
_GAP = 2.5
# Records that a cubic spline takes.
_LEAST = 4


def interpolated(track: Exposures, times_s: Float[np.ndarray, "n"]) -> Exposures:
    """The trajectory `track` at `times_s` by a cubic spline; without a position before, after and in gaps of it.

    Standard deviations are interpolated as they are, the kind of solution is that of the nearest record.
    """
    time, first = np.unique(track.time_s, return_index=True)
    inside = np.isfinite(times_s)
    n = len(times_s)
    place, sigma = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    aircraft = None if track.aircraft_deg is None else np.full((n, 3), np.nan)
    nearest = np.zeros(n, int)
    if len(time) >= _LEAST:
        gap = _GAP * float(np.median(np.diff(time)))
        inside &= (times_s >= time[0]) & (times_s <= time[-1])
        at = np.where(inside, times_s, time[0])
        after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
        inside &= (time[after] - time[after - 1] <= gap) | np.isin(at, time)
        nearest = np.where(at - time[after - 1] < time[after] - at, after - 1, after)
        middle = np.nanmedian(track.place, axis=0)
        place = middle + scipy.interpolate.CubicSpline(time - time[0], track.place[first] - middle)(at - time[0])
        sigma = np.stack([np.interp(at, time, track.sigma_m[first, k]) for k in range(3)], axis=1)
        if track.aircraft_deg is not None:
            part = ((at - time[after - 1]) / (time[after] - time[after - 1]))[:, None]
            aircraft = _between(track.aircraft_deg[first], after, part)
        place[~inside], sigma[~inside] = np.nan, np.nan
    return track._replace(
        rows=track.rows[first[nearest]],
        time_s=times_s,
        place=place,
        sigma_m=sigma,
        fix=tuple(track.fix[first[k]] for k in nearest),
        aircraft_deg=aircraft,
    )


def _between(angles_deg: np.ndarray, after: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw a part of the way to the record `after`, by the rotation between the two."""
    before = scipy.spatial.transform.Rotation.from_euler("ZYX", angles_deg[after - 1][:, ::-1], degrees=True)
    turn = before.inv() * scipy.spatial.transform.Rotation.from_euler("ZYX", angles_deg[after][:, ::-1], degrees=True)
    return (before * scipy.spatial.transform.Rotation.from_rotvec(part * turn.as_rotvec())).as_euler(
        "ZYX", degrees=True
    )[:, ::-1]
