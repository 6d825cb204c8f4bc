"""Coverage of laser points by a trajectory."""

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import Trajectory
from jaxphoto.georeferencing.time_scales import looks_like, shift_that_fits

# Ratio of a record interval to the median interval above which it is a gap; one record may be missing.
_GAP = 2.5


def longest_interval(trajectory: Trajectory) -> float:
    """Return the longest interval between two records (s) that is not a gap."""
    return _GAP * float(np.median(np.diff(np.asarray(trajectory.time))))


def covers(trajectory: Trajectory, time: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Return True for times (s) within the trajectory and outside its gaps."""
    record = np.asarray(trajectory.time)
    short = np.diff(record) <= longest_interval(trajectory)
    # A record belongs to the intervals before and after it.
    before, after = (
        np.clip(np.searchsorted(record, time, side) - 1, 0, len(short) - 1)  # type: ignore[call-overload]
        for side in ("left", "right")
    )
    return (time >= record[0]) & (time <= record[-1]) & (short[before] | short[after])


def check_covered(cloud: Cloud, trajectory: Trajectory) -> None:
    """Raise InputError or BlockError for laser points where `trajectory` has no records, or that have all one time."""
    if cloud.time is None:
        return
    strip = np.zeros(len(cloud), int) if cloud.strip is None else cloud.strip
    for k in np.unique(strip):
        time, name = cloud.time[strip == k], f" of strip {cloud.strips[k]}" if len(cloud.strips) > 1 else ""
        if len(time) > 1 and time.min() == time.max():
            raise InputError(
                f"all laser points{name} have one time, {time[0]:.3f} s, so their positions on the trajectory are "
                "unknown: use a cloud with the GPS time of each point, or omit the trajectory"
            )
        if not covers(trajectory, time).all():
            raise not_covered(trajectory, time, name)
        # A strip with records missing in its middle consists of two flight lines.
        inside = np.asarray(trajectory.time)
        gap = np.flatnonzero(np.diff(inside) > longest_interval(trajectory))
        split = gap[(inside[gap] > time.min()) & (inside[gap + 1] < time.max())]
        for at in inside[split[:1]]:
            raise BlockError(
                f"laser points{name} lie before and after a gap of the trajectory at {at:.3f} s, as for two flight "
                "lines with one point source ID: give each line its own ID, or use a trajectory without the gap"
            )


def not_covered(trajectory: Trajectory, time: Float[np.ndarray, "n"], of: str = "") -> BlockError:
    """Return the error for times (s) of laser points outside the trajectory."""
    record = np.asarray(trajectory.time)
    shift = shift_that_fits(time, record[0], record[-1])
    cure = f", or shift its clock (--trajectory-shift-s {shift:+.15g})" if shift is not None else ""
    first = time[~covers(trajectory, time)].min()
    clocks = (looks_like(times, "a start of its own") for times in (time, record))
    return BlockError(
        f"laser points{of} were measured where the trajectory has no records, first at {first:.3f} s: the cloud's "
        f"clock shows {next(clocks)}, the trajectory's {next(clocks)}; "
        f"give the trajectory of the whole flight, or the cloud without these points{cure}"
    )
