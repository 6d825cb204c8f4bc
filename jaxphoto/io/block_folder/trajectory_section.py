"""The [trajectory] table of block.toml: stations, attitudes and motion interpolated at the times of images.csv."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.block import Frame, Motion
from jaxphoto.compiling import jit_quickly
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import Poses, Trajectory, covered, interpolate
from jaxphoto.georeferencing.time_scales import DAY, LEAP_SECONDS, looks_like, shift_that_fits
from jaxphoto.georeferencing.trajectory import SHORTEST
from jaxphoto.io.block_folder.attitude_units import check_yaw
from jaxphoto.io.block_folder.images import Images
from jaxphoto.io.block_folder.motion import ObservedFlight
from jaxphoto.io.block_folder.settings import Settings
from jaxphoto.io.trajectory import Records
from jaxphoto.io.trajectory.in_frame import positions_in, trajectory_in
from jaxphoto.observations import Attitudes, StationRows
from jaxphoto.rotation import roll_pitch_yaw_from_matrix

# The spline is given so many records before and after each exposure: what lies further off does not move it.
_MARGIN = 64
# An interval is a gap from this many times the usual interval: one record may be lost.
_GAP = 2.5

_interpolate = jit_quickly(interpolate)


def read_flight(records: Records, images: Images, frame: Frame, settings: Settings) -> ObservedFlight:
    """Stations, attitudes and motion of the images at `time_s` + `shift_s`.

    Raises InputError where the trajectory does not go with the frame, BlockError where it does not cover the exposures
    or its clock is another one.
    """
    section = settings.trajectory
    section.known("file", "shift_s", "max_gap_s")
    times = images.table.numbers("time_s", empty=True) + _shift(settings)
    image = np.flatnonzero(~np.isnan(times))
    if not len(image):
        raise images.table.misfit(
            0, f"no image has a time_s, at which to take the position from {records.file}; add it"
        )
    times = times[image]
    usual = float(np.median(np.diff(records.time)))
    max_gap = section.positive("max_gap_s") if "max_gap_s" in section else _GAP * usual
    near = _near(records, times)
    trajectory = _in_frame(near, frame, settings)
    flown = np.diff(np.asarray(trajectory.position), axis=0)
    check_yaw(near.roll_pitch_yaw_deg[:-1, 2], flown, records.file)
    _check_covered(trajectory, times, image, max_gap, records, images, settings)
    poses = jax.tree.map(np.asarray, _interpolate(trajectory, jnp.asarray(times), max_gap))
    _check_leap_seconds(poses, times, image, records, images, frame, settings)
    velocity, rate = np.zeros((len(images.ids), 3)), np.zeros((len(images.ids), 3))
    velocity[image], rate[image] = poses.velocity, poses.rate
    who, axis = np.repeat(image, 3), np.tile(np.arange(3), len(image))
    stations = StationRows(who, axis, jnp.asarray(poses.position.ravel()), jnp.asarray(poses.sigma_position.ravel()))
    angles = _angles(poses.object_from_body)
    motion = Motion(jnp.asarray(velocity), jnp.asarray(rate))
    known = np.isin(np.arange(len(images.ids)), image)
    return ObservedFlight(stations, Attitudes(image, angles, jnp.asarray(poses.sigma_attitude)), motion, known, known)


def _shift(settings: Settings) -> float:
    return settings.trajectory.number("shift_s", 0.0)


def _near(records: Records, times: np.ndarray) -> Records:
    """The records about the exposures: of hours at 200 Hz the rest would only take time."""
    n, at = len(records.time), np.searchsorted(records.time, times)
    change = np.zeros(n + 1, int)
    np.add.at(change, np.clip(at - _MARGIN, 0, n - SHORTEST), 1)
    np.add.at(change, np.clip(at + _MARGIN, SHORTEST, n), -1)
    return _taken(records, np.cumsum(change[:-1]) > 0)


def _taken(records: Records, chosen: np.ndarray) -> Records:
    return records._replace(**{n: v[chosen] for n, v in records._asdict().items() if isinstance(v, np.ndarray)})


def _in_frame(records: Records, frame: Frame, settings: Settings) -> Trajectory:
    sigmas = []
    for given, key, column in ((records.sigma_m, "station_m", "X_m"), (records.sigma_deg, "attitude_deg", "roll_deg")):
        if np.isnan(given).any() and key not in settings.sigmas:
            raise InputError(
                f"{records.file}: there is no standard deviation; add {key} under [sigmas] in {settings.file}, or the "
                f"columns sigma_{column} and so on"
            )
        sigmas.append(np.where(np.isnan(given), settings.sigmas.get(key, 0.0), given))
    return trajectory_in(records, frame, sigmas[0], np.deg2rad(sigmas[1]))


def _check_covered(
    trajectory: Trajectory,
    times: np.ndarray,
    image: np.ndarray,
    max_gap: float,
    records: Records,
    images: Images,
    settings: Settings,
) -> None:
    """Raise BlockError for an exposure outside the trajectory or in a gap, with the clock mistaken if it is one."""
    start, end = float(records.time[0]), float(records.time[-1])
    outside = np.flatnonzero((times < start) | (times > end))
    if len(outside):
        k = outside[0]
        shift = shift_that_fits(times, start, end)
        if shift is not None:
            mend = f"write shift_s = {shift + _shift(settings):.15g} under [trajectory] to bring all exposures into it"
            if shift % DAY == 0:
                mend += f" (and {LEAP_SECONDS[0]} s more if time_s is UTC)"
        elif times.min() < 600 and len(outside) == len(times):
            mend = (
                "give GPS times in images.csv, or the time of the first exposure on the clock of the trajectory as "
                "shift_s under [trajectory]"
            )
        else:
            mend = "take a trajectory that covers it, correct time_s, or leave time_s empty"
        raise images.table.misfit(
            image[k],
            f"image {images.ids[image[k]]} is exposed outside {records.file}: exposures at {looks_like(times)}, "
            f"trajectory at {looks_like(records.time)}; {mend}",
        )
    for k in np.flatnonzero(~np.asarray(covered(trajectory, jnp.asarray(times), max_gap))):
        i = np.clip(np.searchsorted(records.time, times[k], side="right") - 1, 0, len(records.time) - 2)
        raise images.table.misfit(
            image[k],
            f"image {images.ids[image[k]]} is exposed at {times[k]:.3f} s in a gap of {records.file}, from "
            f"{records.time[i]:.3f} to {records.time[i + 1]:.3f} s; fill the gap, leave time_s empty, or raise "
            "max_gap_s under [trajectory]",
        )


def _check_leap_seconds(
    poses: Poses,
    times: np.ndarray,
    image: np.ndarray,
    records: Records,
    images: Images,
    frame: Frame,
    settings: Settings,
) -> None:
    """Raise BlockError where approximate positions fit a clock that is off by leap seconds, and not this one."""
    known = images.known[image]
    if not known.any():
        return
    expected = np.asarray(images.exterior.position)[image[known]]

    def distance(shift: float) -> float:
        """Median distance to the trajectory at shifted times, whose ends stand for what is beyond them."""
        last = np.clip(np.searchsorted(records.time, times[known] + shift), 1, len(records.time) - 1)
        before, after = (positions_in(_taken(records, k), frame) for k in (last - 1, last))
        span = records.time[last] - records.time[last - 1]
        part = np.clip((times[known] + shift - records.time[last - 1]) / span, 0.0, 1.0)[:, None]
        return float(np.median(np.linalg.norm((1 - part) * before + part * after - expected, axis=1)))

    now, speed = distance(0.0), float(np.median(np.linalg.norm(poses.velocity, axis=1)))
    # Less than half of it is no leap: then the approximations decide nothing.
    if now <= 0.5 * min(LEAP_SECONDS) * speed:
        return
    far = {sign * leap: distance(sign * leap) for leap in LEAP_SECONDS for sign in (1, -1)}
    best = min(far, key=lambda shift: far[shift])
    if far[best] < 0.1 * now:
        raise BlockError(
            f"{images.table.file}: the approximate positions are {now:.0f} m from {records.file} at time_s, but "
            f"{far[best]:.0f} m at {best:+d} s, so one clock is UTC and the other GPS; write "
            f"shift_s = {best + _shift(settings):.15g} under [trajectory]"
        )


_angles = jit_quickly(jax.vmap(roll_pitch_yaw_from_matrix))
