"""Stations, attitudes and motion, read from tables or interpolated from the file of [trajectory]."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Block, Frame, Motion
from jaxphoto.compiling import jit_quickly
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import RigCamera, covered, interpolate
from jaxphoto.georeferencing.time_scales import looks_like
from jaxphoto.georeferencing.trajectory import SHORTEST
from jaxphoto.io.block_folder.observations import Images, read_attitudes, read_stations
from jaxphoto.io.block_folder.settings import Settings, default_sigma
from jaxphoto.io.block_folder.table_layout import RATE, VELOCITY
from jaxphoto.io.text_tables import Table
from jaxphoto.io.trajectory import Records, trajectory_in
from jaxphoto.observations import Attitudes, CameraPositions, RelativeAttitudes, RelativePositions, RigPlaces, RigTurns
from jaxphoto.rotation import roll_pitch_yaw_from_matrix
from jaxphoto.unknowns import FIXED, Unknowns, late_cameras

# Number of records before and after each exposure used for the spline; records farther away have no effect.
_MARGIN = 64
# Ratio of an interval to the median interval above which it is a gap; one record may be missing.
_GAP = 2.5

_interpolate = jit_quickly(interpolate)
_angles = jit_quickly(jax.vmap(roll_pitch_yaw_from_matrix))


class ObservedFlight(NamedTuple):
    """Observed stations, attitudes and motion, with masks of the images whose velocity and rate are known."""

    stations: CameraPositions
    attitudes: Attitudes
    motion: Motion | None
    velocity_known: np.ndarray
    rate_known: np.ndarray

    def without_heads(self, head: np.ndarray) -> "ObservedFlight":
        """Remove stations and attitudes of the images in the mask `head`."""
        stations, attitudes = self.stations, self.attitudes
        return self._replace(
            stations=stations.take(~head[stations.who]), attitudes=attitudes.take(~head[attitudes.image])
        )


def read_flight(
    tables: Mapping[str, Table], trajectory: Records | None, images: Images, frame: Frame, settings: Settings
) -> ObservedFlight:
    """Read stations, attitudes and motion, from the trajectory or from their tables."""
    stations, attitudes = tables["stations"], tables["attitudes"]
    if trajectory is not None:
        for table in (stations, attitudes):
            if len(table):
                raise InputError(
                    f"{table.file}: stations and attitudes are interpolated in {trajectory.file}; remove this file, or "
                    f"[trajectory] from {settings.file}"
                )
        return _interpolated(trajectory, images, frame, settings)
    velocity, velocity_known = _motion(stations, VELOCITY, images)
    rate, rate_known = _motion(attitudes, RATE, images)
    motion = None
    if velocity_known.any() or rate_known.any():
        motion = Motion(as_jax_array(velocity), as_jax_array(np.deg2rad(rate)))
    return ObservedFlight(
        read_stations(stations, images, settings),
        read_attitudes(attitudes, images, settings),
        motion,
        velocity_known,
        rate_known,
    )


def _motion(table: Table, columns: tuple[str, ...], images: Images) -> tuple[np.ndarray, np.ndarray]:
    """Return the motion by image, zero if unknown, and the mask of images with known motion."""
    values = np.full((len(images.ids), 3), np.nan)
    given = table.matrix(columns, empty=True)
    table.check(
        np.isnan(given).any(axis=1) & ~np.isnan(given).all(axis=1),
        lambda _: f"the motion is given in part; fill in {', '.join(columns)}, or none of them",
    )
    values[images.find(table)] = given
    known = ~np.isnan(values).any(axis=1)
    return np.nan_to_num(values), known


def check_motion(
    flight: ObservedFlight,
    rows: Iterable[Any],
    image_mount: tuple[str, ...],
    start: Unknowns,
    priors: Unknowns,
    images: Images,
    file: str,
) -> None:
    """Raise BlockError if the time offset of a mount, or a delay in a rig, requires motion that is unknown."""
    rows = list(rows)
    positions, turns = (
        [index for group in rows if isinstance(group, kind) for _, index in group.indices()]
        for kind in (RelativePositions, RelativeAttitudes)
    )
    offset = {
        name
        for name, mount in start.mounts.items()
        if priors.mounts[name].time_offset != FIXED or float(mount.time_offset) != 0
    }
    uses = np.array([mount in offset for mount in image_mount], bool)
    for index, known, table, columns in (
        (np.concatenate([flight.stations.who, *positions]), flight.velocity_known, "stations.csv", VELOCITY),
        (np.concatenate([flight.attitudes.image, *turns]), flight.rate_known, "attitudes.csv", RATE),
    ):
        for image in index[uses[index] & ~known[index]][:1]:
            raise images.table.misfit(
                image,
                f"the time_offset of [mounts.{image_mount[image]}] in {file} needs the motion of image "
                f"{images.ids[image]}; give a [trajectory], add {', '.join(columns)} to {table}, or make time_offset "
                '"fixed" at zero',
            )
    known = flight.velocity_known & flight.rate_known
    for reference, camera in _late_pairs(rows, images.cameras, late_cameras(start, priors)):
        if not known[reference]:
            raise images.table.misfit(
                reference,
                f"the delay of [unknowns.{RigCamera.kind}.{camera}] needs the motion of image "
                f"{images.ids[reference]}; give a [trajectory], add {', '.join(VELOCITY)} to stations.csv and "
                f'{", ".join(RATE)} to attitudes.csv, or make delay "fixed" at zero',
            )


def check_motion_held(block: Block) -> None:
    """Raise BlockError if the tables cannot contain the motion that the delay of a rig camera requires."""
    late = late_cameras(block.start.unknowns, block.priors)
    held = set(np.asarray(block.stations.who).tolist()) & set(np.asarray(block.attitudes.image).tolist())
    for reference, camera in _late_pairs(block.more, block.image_camera, late):
        if reference not in held:
            raise BlockError(
                f"the delay of {RigCamera.kind}[{camera}] needs the motion of image {block.images[reference]}, which "
                "is stored in stations.csv and attitudes.csv: add a station and an attitude of it, or fix the delay "
                "at zero"
            )


def _late_pairs(rows: Iterable[Any], cameras: Sequence[str], late: Collection[str]) -> Iterator[tuple[int, str]]:
    """Yield (image of the reference camera, camera) for each rig observation of a camera with a delay."""
    for group in rows:
        if isinstance(group, RigPlaces | RigTurns):
            for reference, image in zip(group.reference.tolist(), group.image.tolist(), strict=True):
                if cameras[image] in late:
                    yield reference, cameras[image]


def _interpolated(records: Records, images: Images, frame: Frame, settings: Settings) -> ObservedFlight:
    """Interpolate stations, attitudes and motion of the images at `time_s` + `shift_s`.

    Raises InputError if the trajectory does not fit the frame, and BlockError if it does not cover the exposures or has
    a different time scale.
    """
    keys = settings.keys.trajectory
    shift = keys.shift_s if keys is not None else 0.0
    times = images.table.numbers("time_s", empty=True) + shift
    image = np.flatnonzero(~np.isnan(times))
    if not len(image):
        raise images.table.misfit(0, f"no image has a time_s, but {records.file} needs it; add it")
    times = times[image]
    _check_unit(records, times, images.table.file)
    max_gap = keys.max_gap_s if keys is not None and keys.max_gap_s else _GAP * float(np.median(np.diff(records.time)))
    near = _near(records, times)
    sigmas = []
    for given, key, column in ((near.sigma_m, "station_m", "X_m"), (near.sigma_deg, "attitude_deg", "roll_deg")):
        sigmas.append(np.where(np.isnan(given), default_sigma(settings, key), given))
        if np.isnan(sigmas[-1]).any():
            raise InputError(
                f"{records.file}: missing standard deviation; add {key} under [sigmas] in {settings.file}, or "
                f"columns such as sigma_{column}"
            )
    trajectory = trajectory_in(near, frame, sigmas[0], np.deg2rad(sigmas[1]))
    for k in np.flatnonzero((times < records.time[0]) | (times > records.time[-1]))[:1]:
        raise images.table.misfit(
            image[k],
            f"image {images.ids[image[k]]} is exposed outside {records.file}: exposures at {looks_like(times)}, "
            f"trajectory at {looks_like(records.time)}; correct time_s or leave it empty, use a trajectory that covers "
            "it, or give the shift between the two clocks as shift_s under [trajectory]",
        )
    for k in np.flatnonzero(~np.asarray(covered(trajectory, jnp.asarray(times), max_gap)))[:1]:
        i = np.clip(np.searchsorted(records.time, times[k], side="right") - 1, 0, len(records.time) - 2)
        raise images.table.misfit(
            image[k],
            f"image {images.ids[image[k]]} is exposed at {times[k]:.3f} s in a gap of {records.file}, from "
            f"{records.time[i]:.3f} to {records.time[i + 1]:.3f} s; fill the gap, leave time_s empty, or raise "
            "max_gap_s under [trajectory]",
        )
    poses = jax.tree.map(np.asarray, _interpolate(trajectory, jnp.asarray(times), max_gap))
    velocity, rate = np.zeros((len(images.ids), 3)), np.zeros((len(images.ids), 3))
    velocity[image], rate[image] = poses.velocity, poses.rate
    who, axis = np.repeat(image, 3), np.tile(np.arange(3), len(image))
    stations = CameraPositions(
        who, axis, jnp.asarray(poses.position.ravel()), jnp.asarray(poses.sigma_position.ravel())
    )
    attitudes = Attitudes(image, _angles(poses.object_from_body), jnp.asarray(poses.sigma_attitude))
    known = np.isin(np.arange(len(images.ids)), image)
    return ObservedFlight(stations, attitudes, Motion(jnp.asarray(velocity), jnp.asarray(rate)), known, known)


def _check_unit(records: Records, times: np.ndarray, file: str) -> None:
    """Raise InputError if the times of one file are in milliseconds: in seconds the records cover all exposures.

    Records that cover them without conversion must be further apart than the exposures, to no use of a trajectory.
    """
    # The cameras of a rig expose at the same time.
    steps = (np.diff(np.unique(t)) for t in (records.time, times))
    apart, between = (float(np.median(step)) if len(step) else np.inf for step in steps)
    if ((times >= records.time[0]) & (times <= records.time[-1])).all() and apart <= between:
        return
    for name, start, end, exposures in (
        (records.file, *records.time[[0, -1]] / 1000, times),
        (file, *records.time[[0, -1]], times / 1000),
    ):
        if (exposures >= start).all() and (exposures <= end).all():
            raise InputError(
                f"{name}: its times are in milliseconds: divided by 1000, the trajectory covers all exposures; "
                "write time_s in seconds"
            )


def _near(records: Records, times: np.ndarray) -> Records:
    """Select the records near the exposures: interpolating in hours of 200 Hz data is slow."""
    n, at = len(records.time), np.searchsorted(records.time, times)
    change = np.zeros(n + 1, int)
    np.add.at(change, np.clip(at - _MARGIN, 0, n - SHORTEST), 1)
    np.add.at(change, np.clip(at + _MARGIN, SHORTEST, n), -1)
    chosen = np.cumsum(change[:-1]) > 0
    columns: dict[str, Any] = {n: v[chosen] for n, v in records._asdict().items() if isinstance(v, np.ndarray)}
    return records._replace(**columns)
