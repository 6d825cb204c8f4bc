"""Exposures of files brought to the photographs that they are of, and positions of antennas to cameras."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.errors import few
from jaxphoto.georeferencing.camera_attitude import CameraAttitude, level_from_body
from jaxphoto.georeferencing.exposure_times import DAY_S, WEEK_S, ZONES_S, Matched
from jaxphoto.georeferencing.gps import moved
from jaxphoto.io.exposures.interpolated import interpolated
from jaxphoto.io.exposures.joining import FINE_S, Clock, by_marks, by_name, by_time, clock_of, distance
from jaxphoto.io.exposures.records import Exposures
from jaxphoto.io.exposures.wording import counts, fixes, joined_words, why_not
from jaxphoto.io.photographs import Photograph

Arm = tuple[float, float, float]
"""From the camera to the antenna, right, forward, up of the aircraft (m)."""

# A trajectory has records between exposures; events are about as many as photographs.
_TRACK = 3
# Positions that are farther from those of the photographs' own files are of another flight.
_FAR_M = 200.0
# Positions without corrections are within it, for the most part, of those with them.
_SAME_M = 5.0
# Times that tell a position: at 10 m/s a centimetre.
_EXACT_S = 1e-3


class Assigned(NamedTuple):
    """Photographs with what files beside them say, and a sentence for each file."""

    photographs: list[Photograph]
    sentences: list[str]


class _State(NamedTuple):
    """What is known of each photograph so far."""

    photographs: list[Photograph]
    gps_s: Float[np.ndarray, "n"]
    """Time of exposure in GPS time where time marks say it, else NaN."""
    event_s: Float[np.ndarray, "n"]
    """The same where an event of the receiver does."""
    camera_from_antenna_m: Float[np.ndarray, "n 3"]
    own: list[bool]
    """Whether the position is still that of the photograph's own file."""


def with_exposures(photographs: Sequence[Photograph], files: Sequence[Exposures], arm: Arm | None = None) -> Assigned:
    """The photographs with positions, sigmas and attitudes of the files; later kinds replace earlier ones.

    Time marks come first, whose times and lever arms those of positions of the antenna need: events, and trajectories,
    which are interpolated at the times of either. Tables, by name, are last. `arm` holds for positions of an antenna
    whose lever arm no time mark says, and where no such file is there for those of the photographs' own.
    """
    n = len(photographs)
    state = _State(list(photographs), np.full(n, np.nan), np.full(n, np.nan), np.full((n, 3), np.nan), [True] * n)
    said: list[str] = []
    track = lambda f: len(f.rows) > _TRACK * n or f.aircraft_deg is not None  # noqa: E731
    for file in sorted(files, key=lambda f: 3 if f.names else 0 if f.sequence is not None else 1 + track(f)):
        if file.names:
            state, sentence = _by_name(state, file)
        elif file.sequence is not None:
            state, sentence = _marked(state, file)
        elif track(file):
            state, sentence = _along(state, file, arm)
        else:
            state, sentence = _events(state, file, arm)
        said.append("; ".join(filter(None, (f"{file.file}: {sentence}", file.why))))
    if arm is not None and any(state.own) and not any(f.of_antenna for f in files):
        state, sentence = _own_arm(state, arm)
        said.append(sentence)
    elif arm is not None and not any(f.of_antenna for f in files):
        said.append("the lever arm is not used: positions of time marks and tables are those of the camera")
    return Assigned(state.photographs, said)


def _marked(state: _State, file: Exposures) -> tuple[_State, str]:
    """Time marks of DJI: by the number in the name where times and positions agree, else by times."""
    clock = clock_of(state.photographs)
    found, how = by_marks(state.photographs, file, clock)
    if not isinstance(found, Matched):
        return state, why_not(found)
    if other := _of_another_flight(state, file, found.exposure) or _of_another_day(state, file, found):
        return state, other
    return _taken_over(state, file, found.exposure), joined_words(state.photographs, file, found, clock, how)


def _events(state: _State, file: Exposures, arm: Arm | None) -> tuple[_State, str]:
    """Positions of the antenna at events, one an exposure."""
    clock = clock_of(state.photographs)
    if np.isfinite(state.gps_s).sum() >= 2:
        clock = Clock(state.gps_s, True, FINE_S)
    found = by_time(state.photographs, file, clock)
    if not isinstance(found, Matched):
        return state, why_not(found)
    if other := _of_another_flight(state, file, found.exposure) or _of_another_day(state, file, found):
        return state, other
    new, armed = _at_camera(state, file, found.exposure, arm)
    new = new._replace(event_s=np.where(found.exposure >= 0, file.time_s[found.exposure], state.event_s))
    return new, f"{joined_words(state.photographs, file, found, clock)}; {armed}"


def _along(state: _State, file: Exposures, arm: Arm | None) -> tuple[_State, str]:
    """A trajectory, at times that the receiver's marks or events say, or photographs to the millisecond."""
    times = np.where(np.isfinite(state.gps_s), state.gps_s, state.event_s)
    if not np.isfinite(times).any():
        clock = clock_of(state.photographs)
        exact = [clock.gps and bool(p.taken and p.taken.resolution_s <= _EXACT_S) for p in state.photographs]
        times = np.where(exact, clock.time_s, np.nan)
    if not np.isfinite(times).any():
        return state, (
            "a trajectory needs the time of every exposure to the millisecond, and there are neither time marks nor "
            "events nor photographs that say it; not used"
        )
    if file.time_s.max() < 2 * WEEK_S:
        file = file._replace(time_s=file.time_s + WEEK_S * np.floor(np.nanmin(times) / WEEK_S))
    at = interpolated(file, times)
    exposure = np.where(np.isfinite(at.place).all(axis=1), np.arange(len(times)), -1)
    if not (exposure >= 0).any():
        apart = np.nanmedian(times) - np.median(file.time_s)
        return state, f"no photograph was taken while it lasts: it is {apart:+,.0f} s from them; not used"
    if other := _of_another_flight(state, at, exposure):
        return state, other
    new, armed = _at_camera(state, at, exposure, arm)
    lost = [p.name for p, k in zip(state.photographs, exposure, strict=True) if k < 0]
    without = f" ({len(lost)} before, after or in a gap of it: {few(lost)})" if lost else ""
    said = f"positions of {len(times) - len(lost)} photographs by interpolation{fixes(at, exposure)}{without}"
    return new, f"{said}; {armed}"


def _by_name(state: _State, file: Exposures) -> tuple[_State, str]:
    exposure = by_name(state.photographs, file)
    if not (exposure >= 0).any():
        return state, f"none of its {len(file.names)} names is that of a photograph ({few(list(file.names))}); not used"
    if other := _of_another_flight(state, file, exposure):
        return state, other
    photographs = [
        p if k < 0 or file.attitude[k] is None else p._replace(attitude=file.attitude[k])
        for p, k in zip(state.photographs, exposure, strict=True)
    ]
    new = _taken_over(state._replace(photographs=photographs), file, exposure)
    return new, f"positions of {counts(state.photographs, file, exposure)} by name{fixes(file, exposure)}"


def _taken_over(state: _State, file: Exposures, exposure: Int[np.ndarray, "n"]) -> _State:
    """Positions of the camera, times and lever arms of the exposures."""
    photographs, own = list(state.photographs), list(state.own)
    gps_s, arms = state.gps_s.copy(), state.camera_from_antenna_m.copy()
    for i in np.flatnonzero(exposure >= 0):
        k = int(exposure[i])
        if (gps := file.gps(k)) is not None:
            photographs[i], own[i] = photographs[i]._replace(gps=gps), False
        gps_s[i] = file.time_s[k] if np.isfinite(file.time_s[k]) else gps_s[i]
        if file.camera_from_antenna_m is not None:
            arms[i] = file.camera_from_antenna_m[k]
    return _State(photographs, gps_s, state.event_s, arms, own)


def _at_camera(state: _State, file: Exposures, exposure: Int[np.ndarray, "n"], arm: Arm | None) -> tuple[_State, str]:
    """Positions of the antenna brought to the camera, and how."""
    photographs, own = list(state.photographs), list(state.own)
    marked = given = none = 0
    for i in np.flatnonzero(exposure >= 0):
        k = int(exposure[i])
        gps, photograph = file.gps(k), photographs[i]
        if gps is None:
            continue
        if file.aircraft_deg is not None and photograph.attitude is None:
            roll, pitch, yaw = file.aircraft_deg[k].tolist()
            fixed = CameraAttitude(level_from_body((roll, pitch, yaw)))
            photograph = photograph._replace(attitude=fixed, aircraft_deg=(roll, pitch, yaw))
        # The arms of time marks are those to the antenna; a trajectory with attitudes is that of its IMU.
        if file.aircraft_deg is None and np.isfinite(state.camera_from_antenna_m[i]).all():
            gps, marked = moved(gps, state.camera_from_antenna_m[i]), marked + 1
        elif arm is not None and (turn := _aircraft(photograph)) is not None:
            gps, given = moved(gps, -turn @ np.array(arm)), given + 1
        else:
            none += 1
        photographs[i], own[i] = photograph._replace(gps=gps), False
    instead = ", not the one given" if arm is not None else ""
    parts = [f"lever arms of {marked} are those of the time marks{instead}"] if marked else []
    parts += [f"the lever arm of {given} is as given"] if given else []
    if none:
        why = "--lever-arm gives it" if arm is None else "no attitude of the aircraft turns it"
        whose = "antenna" if file.aircraft_deg is None else "IMU"
        parts.append(f"{none} are positions of the {whose}, the lever arm is not known ({why})")
    return state._replace(photographs=photographs, own=own), ", ".join(parts)


def _own_arm(state: _State, arm: Arm) -> tuple[_State, str]:
    """The lever arm that is given, taken off positions of the photographs' own files."""
    photographs, turned, left = list(state.photographs), 0, 0
    for i, p in enumerate(photographs):
        if not state.own[i] or p.gps is None:
            continue
        turn = _aircraft(p)
        turned, left = turned + (turn is not None), left + (turn is None)
        photographs[i] = p if turn is None else p._replace(gps=moved(p.gps, -turn @ np.array(arm)))
    without = f"; {left} have no attitude that turns it, and stay where they are" if left else ""
    said = f"the lever arm is taken off {turned} positions of the photographs' own files{without}"
    return state._replace(photographs=photographs), said


def _aircraft(photograph: Photograph) -> Float[np.ndarray, "3 3"] | None:
    """From the aircraft's axes right, forward, up to the level frame: its own attitude, else that of a fixed camera."""
    if photograph.aircraft_deg is not None:
        return level_from_body(photograph.aircraft_deg)
    return None if photograph.attitude is None else photograph.attitude.level_from_camera


def _of_another_flight(state: _State, file: Exposures, exposure: Int[np.ndarray, "n"]) -> str:
    """Why a file is not used whose positions are far from the photographs' own; "" where they are not."""
    far = distance(state.photographs, file, exposure)
    if far is None or far <= _FAR_M:
        return ""
    back = distance(state.photographs, file._replace(place=file.place[:, [1, 0, 2]]), exposure)
    if back is not None and back <= _FAR_M:
        return (
            "its longitudes and latitudes have changed places, as the photographs' own positions show; not used: "
            "exchange the two in the file"
        )
    return f"its positions are {far:,.0f} m from those of the photographs, as of another flight; not used"


def _of_another_day(state: _State, file: Exposures, found: Matched) -> str:
    """Why a file is not used whose times no clock of the day of the photographs shows; "" where positions prove it."""
    if not abs(found.offset_s) > ZONES_S:
        return ""
    near = distance(state.photographs, file, found.exposure)
    if near is not None and near <= _SAME_M:
        return ""
    when = "before" if found.offset_s > 0 else "after"
    return (
        f"its times are {abs(found.offset_s) / DAY_S:.1f} days {when} those of the photographs, as of another day, and "
        "no positions prove that only the clock is wrong; not used"
    )
