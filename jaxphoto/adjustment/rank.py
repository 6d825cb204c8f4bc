"""Rank defects: names of unknowns that the observations cannot determine or separate."""

import math
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxphoto.adjustment.layout.sharding import EVERYWHERE, sharded
from jaxphoto.adjustment.normal_equations import NormalEquations
from jaxphoto.adjustment.result import Adjustment
from jaxphoto.adjustment.solver.band import Band
from jaxphoto.adjustment.solver.normal import Linearised
from jaxphoto.adjustment.solver.reduced import reduce_normal
from jaxphoto.arrays import is_traced, to_numpy
from jaxphoto.block import Block, exposures
from jaxphoto.camera import RATES, CameraSpline
from jaxphoto.errors import DatumError, RankError
from jaxphoto.georeferencing import RigCamera
from jaxphoto.observations import AbstractObservations, CameraPositions, Correlated, RigPlaces, RigTurns
from jaxphoto.parameters import dynamic_fields
from jaxphoto.unknowns import FREE, Unknowns, late_cameras

# Pivot of the unit-diagonal reduced matrix below which it is singular: a rounding error of float64, not geometry.
DEFECT = 1e-13


def check_priors(block: Block, priors: Unknowns) -> None:
    """Raise RankError or DatumError for free unknowns that no observation can determine.

    Uses only the unknowns that each observation involves, so nothing is compiled.
    """
    _check_scales(priors)
    with_station = _images_of_stations(block)
    with_attitude = set(np.asarray(block.attitudes.image).tolist())
    # Another observation of an image may determine its mount: for example, a trajectory shared with a scanner.
    further = _images_touched(block)
    _check_mounts(block, priors, with_station | further, with_attitude | further)
    _check_strips(block, priors, with_station)
    _check_shifts(block, priors, with_station)
    _check_scanner(block, priors)
    _check_camera_rates(block, priors)
    _check_camera_splines(block)
    _check_rigs(block, priors)


def _images_of_stations(block: Block) -> set[int]:
    """Return the images whose stations are observed, individually or in sets with a joint covariance."""
    joint = [of.rows.who for of in block.more if isinstance(of, Correlated) and isinstance(of.rows, CameraPositions)]
    return {int(i) for who in (block.stations.who, *joint) for i in np.ravel(np.asarray(who))}


def _images_touched(block: Block) -> set[int]:
    """Return the images that other observations involve."""
    rows = [of for of in block.more if isinstance(of, AbstractObservations)]
    return {int(i) for of in rows for what, index in of.indices() if what == "image" for i in np.ravel(index)}


def _check_scales(priors: Unknowns) -> None:
    """Raise RankError if a camera's principal distance and an equivalent coefficient are both free.

    The normal matrix would not be singular. Residuals refer to ideal coordinates, so a smaller scale reduces the
    residuals, and the sum of squares has no minimum.
    """
    for camera, interior in priors.interior.items():
        for name in interior.distortion.scales:
            if interior.c == FREE and getattr(interior.distortion, name) == FREE:
                raise RankError(
                    f"interior[{camera}].c_mm and interior[{camera}].{name} both scale the image and cannot both be "
                    f"estimated: fix {name}"
                )


def _check_mounts(block: Block, priors: Unknowns, with_station: set[int], with_attitude: set[int]) -> None:
    for name, prior in priors.mounts.items():
        images = _images_of(name, block.image_mount)
        stations, attitudes = images & with_station, images & with_attitude
        if prior.boresight == FREE and not attitudes:
            raise RankError(
                f"mounts[{name}].boresight is free, but none of its images has an observed attitude: add attitudes, "
                "or fix the boresight"
            )
        if prior.lever_arm == FREE and not stations:
            raise RankError(
                f"mounts[{name}].lever_arm is free, but none of its images has an observed station: add stations, "
                "or fix the lever arm"
            )
        if prior.time_offset == FREE and not (stations or attitudes):
            raise RankError(
                f"mounts[{name}].time_offset is free, but none of its images has an observed station or attitude: "
                "add them, or fix the time offset"
            )
        if prior.time_offset == FREE and block.motion is None:
            raise RankError(
                f"mounts[{name}].time_offset is free, but the motion of the sensor at the exposures is unknown: "
                "give its velocity and angular rates (Block.motion), or fix the time offset"
            )


def _check_strips(block: Block, priors: Unknowns, with_station: set[int]) -> None:
    times = block.image_time if is_traced(block.image_time) else np.asarray(block.image_time)
    for name, prior in priors.strips.items():
        images = sorted(_images_of(name, block.image_strip) & with_station)
        n = len(images)
        for what, least in (("shift", 1), ("drift", 2)):
            if getattr(prior, what) == FREE and n < least:
                found = "one image with an observed station" if n else "no image with an observed station"
                raise RankError(
                    f"strips[{name}].{what} is free, but the strip has {found}: fix the {what} of strip {name}, "
                    f"or add stations of {least} of its images or more"
                )
        if prior.drift == FREE and not is_traced(times) and np.ptp(times[images]) == 0:
            raise RankError(
                f"strips[{name}].drift is free, but all images of the strip with an observed station have one time: "
                f"give the times of their exposures, or fix the drift of strip {name}"
            )


def _check_shifts(block: Block, priors: Unknowns, with_station: set[int]) -> None:
    """Raise an error if free shifts of all stations leave the position of the block undetermined."""
    if block.datum.kind != "control" or not with_station:
        return
    if len(block.control.who) + len(block.fixed.who) + len(block.surfaces.point):
        return
    shifted = [name for name, prior in priors.strips.items() if prior.shift == FREE]
    if {block.image_strip[i] for i in with_station} <= set(shifted):
        raise DatumError(
            f"the shift of every strip is free (strips {', '.join(shifted)}) and the block has no control, so its "
            f"position is undetermined: add control points, or fix the shift of one strip, such as {shifted[0]}"
        )


def _check_scanner(block: Block, priors: Unknowns) -> None:
    if priors.scanner is None:
        return
    others = any("scanner" in rows.block_parameters for rows in block.more if isinstance(rows, AbstractObservations))
    turned = is_traced(block.surfaces.turn) or np.any(np.asarray(block.surfaces.turn))
    if priors.scanner.boresight == FREE and not others and not turned:
        raise RankError(
            "scanner.boresight is free, but no point lies on a laser scanner's surface that the boresight moves: add "
            "such points, measured from known positions of the scanner, or fix the boresight"
        )
    for k, (name, prior) in enumerate(priors.scanner.shifts.items()):
        if prior == FREE and not np.any(block.surfaces.strip == k):
            raise RankError(
                f"scanner[{name}].shift is free, but no point lies on a surface of that lidar strip: fix the shift, "
                "or remove the strip"
            )


def _check_camera_rates(block: Block, priors: Unknowns) -> None:
    for rates in RATES:
        owners, what = priors.more.get(rates.kind, {}), rates.along.split("_")[0]
        if not owners:
            continue
        # Concrete values, also inside a traced function.
        with jax.ensure_compile_time_eval():
            along = to_numpy(rates.argument(exposures(block)))
        for name, prior in owners.items():
            free = [field for field in dynamic_fields(rates) if getattr(prior, field) == FREE]
            own = sorted(_images_of(name, block.image_camera))
            if free and not is_traced(along) and np.ptp(along[own]) == 0:
                raise RankError(
                    f"{rates.kind}[{name}].{free[0]} is free, but all images of the camera have one {what}: give the "
                    f"{what}s of their exposures, or fix the rate"
                )
            distortion = priors.interior[name].distortion
            if "k1_rate" in free and "k1" not in distortion.coefficients:
                raise RankError(
                    f"{rates.kind}[{name}].k1_rate is free, but the distortion {distortion.name} has no k1: fix the "
                    "rate"
                )


def _check_camera_splines(block: Block) -> None:
    """Check that splines cover their flight and have a common interval: they are evaluated together."""
    splines: Any = block.start.unknowns.more.get(CameraSpline.kind, {})
    if not splines:
        return
    in_flight = to_numpy(exposures(block).in_flight)
    seconds = np.zeros(len(block.images)) if is_traced(in_flight) else np.abs(in_flight)
    for name, own in splines.items():
        first, spline = next(iter(splines.items()))
        if (own.knots, own.interval_s) != (spline.knots, spline.interval_s):
            raise RankError(f"the splines of cameras {first} and {name} differ: give both the same knots and interval")
        farthest = seconds[sorted(_images_of(name, block.image_camera))].max(initial=0.0)
        reach = (own.knots - 3) / 2 * own.interval_s
        if reach < farthest:
            needed = 2 * math.ceil(farthest / own.interval_s + 1.5)
            raise RankError(
                f"{CameraSpline.kind}[{name}] has {own.knots} knots, which reach {reach:g} s from the middle of the "
                f"flight, but an image is {farthest:.0f} s from it: give it {needed} knots, or a longer interval"
            )


def _check_rigs(block: Block, priors: Unknowns) -> None:
    """Check that images of a rig belong to its cameras, and that their motion is known if a camera exposes late."""
    known = block.start.unknowns.more.get(RigCamera.kind, {})
    late = late_cameras(block.start.unknowns, priors)
    if late and block.motion is None:
        raise RankError(
            f"{RigCamera.kind}[{late[0]}].delay needs the motion of the rig: give its velocity and angular rates "
            "(Block.motion; a [trajectory], or their columns in stations.csv and "
            "attitudes.csv), or fix the delay at zero"
        )
    for rows in (of for of in block.more if isinstance(of, RigPlaces | RigTurns)):
        for i in rows.image:
            if (camera := block.image_camera[i]) not in known:
                raise RankError(
                    f"{rows.group} has image {block.images[i]}, but its camera {camera} is not in the rig: add "
                    f"[unknowns.{RigCamera.kind}.{camera}], or remove the image"
                )


def _images_of(name: str, names: Iterable[str]) -> set[int]:
    """Return the indices of the images whose mount or strip is `name`."""
    return {i for i, other in enumerate(names) if other == name}


def check_rank(adjusted: Adjustment) -> None:
    """Raise RankError if the normal matrix at the optimum is singular, with the undetermined unknowns and the cure."""
    if adjusted.factored is None or not bool(adjusted.converged):
        return
    if np.asarray(adjusted.equations.pivots()).min() > DEFECT:
        return
    from jaxphoto.adjustment.weakness_messages import weaknesses_of

    if found := weaknesses_of(adjusted):
        sentences = "; ".join(weakness.sentence for weakness in found)
        points = {p for weakness in found for p in weakness.points} if all(w.points for w in found) else set()
        raise RankError(f"rank defect: {sentences}", sorted(points))


@eqx.filter_jit
def reduced_matrix(equations: NormalEquations) -> Band:
    """Return the undamped reduced normal matrix; the solver stores only its factor, which is incomplete at a defect."""

    def of_device(at: Linearised) -> Band:
        return reduce_normal(at, 0.0)[0]

    return sharded(of_device, equations.structure, EVERYWHERE)(equations.at)
