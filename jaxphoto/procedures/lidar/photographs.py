"""Photographs of the same flight as laser strips: their exposures lie on the trajectory of the scanner."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.block import Block
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import StripSpline, Trajectory
from jaxphoto.georeferencing.time_scales import looks_like, shift_that_fits
from jaxphoto.lidar.correction import scanner_path, scanner_poses
from jaxphoto.lidar.coverage import covers
from jaxphoto.lidar.strip_planes import StripSettings
from jaxphoto.observations import Attitudes, CameraPositions, StripPlanes, TrajectoryAttitudes, TrajectoryStations
from jaxphoto.procedures.lidar.iterate_to_convergence import check_without_surfaces

# Maximum distance (m) of stations from the trajectory; larger ones belong to another trajectory or time.
_FAR_M = 10.0


class Photographs(NamedTuple):
    """Block of images, and the exposure times on the clock of the cloud and its trajectory."""

    block: Block
    """Block whose stations and attitudes come from the trajectory."""
    time: Float[np.ndarray, "images"]
    """Exposure times in seconds."""


def check_photographs(photographs: Photographs, trajectory: Trajectory | None) -> None:
    """Raise InputError or BlockError for photographs that do not match the trajectory."""
    block, time = photographs.block, photographs.time
    if trajectory is None:
        raise InputError(
            "photographs and strips need their common trajectory: give it (--trajectory), or adjust the strips alone"
        )
    if any(isinstance(rows, StripPlanes) for rows in block.more):
        raise BlockError(
            "the block is the result of a joint adjustment (planes in strip_planes.csv): adjust it by jaxphoto "
            "adjust, or give the original block"
        )
    check_without_surfaces(block)
    unknown = np.flatnonzero(~np.isfinite(time))
    if len(unknown):
        raise InputError(
            f"image {block.images[unknown[0]]} has no time_s, so its position on the trajectory is unknown: give the "
            "times of all exposures in images.csv"
        )
    if not len(block.stations):
        raise InputError("the block has no stations: add [trajectory] to block.toml, or stations.csv")
    times = np.asarray(trajectory.time)
    outside = np.flatnonzero((time < times[0]) | (time > times[-1]))
    if len(outside):
        shift = shift_that_fits(time, times[0], times[-1])
        on_its_clock = "on its clock (--exposure-shift-s)"
        if shift is not None:
            on_its_clock = f"{shift:+.15g} s later, all within the trajectory (--exposure-shift-s)"
        raise BlockError(
            f"image {block.images[outside[0]]} was exposed at {time[outside[0]]:.3f} s, where the trajectory has no "
            f"records: the exposures are at {looks_like(time)}, the trajectory at {looks_like(times)}; give the "
            f"trajectory of the whole flight, or the exposures {on_its_clock}"
        )
    for k in np.flatnonzero(~covers(trajectory, time)):
        before, after = times[times <= time[k]][-1], times[times >= time[k]][0]
        raise BlockError(
            f"image {block.images[k]} was exposed at {time[k]:.3f} s, in a gap of the trajectory from {before:.3f} to "
            f"{after:.3f} s: give the trajectory with the records of this time, or the block without this image"
        )
    rows = block.stations
    at = scanner_poses(scanner_path(trajectory), time[rows.who]).position
    offset = np.asarray(rows.value) - at[np.arange(len(rows)), rows.axis]
    apart = float(np.median(np.sqrt(np.bincount(rows.who, offset**2)[np.unique(rows.who)])))
    if apart > _FAR_M:
        raise BlockError(
            f"the stations of the block are {apart:.0f} m from the trajectory at their times: bring both onto one "
            "clock (--exposure-shift-s) and into one coordinate system"
        )


def spans_with(
    time: Float[np.ndarray, "images"], spans: Float[np.ndarray, "strips 2"]
) -> Float[np.ndarray, "strips 2"]:
    """Return first and last times of strips (s), extended to the exposures on their trajectories."""
    strip = _strip_of(time, spans)
    times_of_strip = [np.append(time[strip == k], span) for k, span in enumerate(spans)]
    return np.array([(t.min(), t.max()) for t in times_of_strip])


def on_trajectory(
    photographs: Photographs,
    splines: Sequence[StripSpline],
    spans: Float[np.ndarray, "strips 2"],
    settings: StripSettings,
) -> Block:
    """Return the block with stations and attitudes of a trajectory with errors `splines` over `spans`.

    They replace the block's observations, which come from the same instruments and would be used twice.
    """
    block, time = photographs.block, photographs.time
    strip, knots, weights = _strip_of(time, spans), np.zeros((len(time), 4), int), np.zeros((len(time), 4))
    for k, spline in enumerate(splines):
        in_strip = strip == k
        knots[in_strip], weights[in_strip] = spline.weights(time[in_strip])
    s, a = block.stations, block.attitudes
    sigma, turn = np.full(len(s), settings.sigma_exposure_m), np.deg2rad(settings.sigma_exposure_deg)
    position = TrajectoryStations(s.who, knots[s.who], weights[s.who], s.axis, np.asarray(s.value), sigma)
    angles = np.asarray(a.roll_pitch_yaw)
    attitude = TrajectoryAttitudes(a.image, knots[a.image], weights[a.image], angles, np.full(angles.shape, turn))
    more = (*block.more, position, *([attitude] if len(attitude) else []))
    return dataclasses.replace(block, stations=CameraPositions.none(), attitudes=Attitudes.none(), more=more)


def _strip_of(time: Float[np.ndarray, "images"], spans: Float[np.ndarray, "strips 2"]) -> Int[np.ndarray, "images"]:
    """Return the laser strip of each exposure: the nearest in time."""
    away = np.maximum(spans[:, :1] - time, time - spans[:, 1:])
    return np.argmin(np.maximum(away, 0.0), axis=0)
