"""From matched features to an oriented block, for a calibration of the camera that took them.

1. Relative orientations of all pairs; matches off the epipolar lines go.
2. What is left hangs together to points; a network grows over them (`growing`).
3. With the camera as the network knows it now, and all images oriented, every match is tested again: lens distortion
   has made true ones look false, in the corners of the format above all. Points anew, adjustments in rounds.
4. Parameters of the camera that the images cannot tell are observed where they start, and the rounds run again.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import PaddedSizes
from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import InteriorOrientation, Sensor, get_parameter, parameter_names, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.initial.matches import PairMatches, Tracks, tracks
from jaxphoto.initial.rays import ideal_coordinates, unit_rays
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints
from jaxphoto.procedures.orientation.finish import FIRST_ROUNDS, LAST_ROUNDS, finished, told
from jaxphoto.procedures.orientation.growing import grown
from jaxphoto.procedures.orientation.network import Fate, Network, empty_network, meet, sight_of
from jaxphoto.procedures.orientation.refine import (
    Asked,
    SelfCalibration,
    asked,
    calibration_of,
    early,
    freed,
    observation,
    part_of,
)
from jaxphoto.procedures.orientation.related_pairs import LENS_PX, MOST, Report, check_connected, relate
from jaxphoto.procedures.orientation.second_look import second_look
from jaxphoto.short_repr import pretty_repr
from jaxphoto.unknowns import Unknowns, default_priors

CAMERA = "camera"
"""What the camera of the photographs is called in the block."""
METHOD = 2
"""Changes with the way photographs are oriented: what a run has kept of another way is not taken up."""
SIGMA_PX = 0.5
"""Standard deviation of a feature, in pixels, where none is given."""
LEAST_MATCHES = 15
"""Of a pair of photographs: fewer false ones agree with some orientation by chance."""
LEAST_POINTS = 10
"""That an oriented photograph sees."""


class GrossErrors(NamedTuple):
    """What was left out on the way, counted by reason."""

    unoriented: int
    """Matches of pairs in which an image is not oriented."""
    off_epipolar: int
    """Matches off the epipolar line of their pair."""
    conflicting: int
    """Matches by which a point would show twice in an image."""
    beyond: int
    """Image points whose ray misses the point."""
    small_angle: int
    """Image points whose rays meet at too small an angle."""
    too_few: int
    """Image points left alone by those that went."""
    unsupported: int
    """Image points of two rays that meet where nothing near them in the images is."""


class OrientationReport(NamedTuple):
    """How an orientation came about."""

    n_images: int
    n_matches: int
    n_pairs: int
    """Pairs with a relative orientation."""
    order: tuple[str, ...]
    """Images as they were oriented."""
    unoriented: dict[str, str]
    """Images that are not, and why."""
    gross_errors: GrossErrors
    n_points: int
    n_image_points: int
    rounds: int
    settled: bool
    """Whether the last of them changed hardly any image point."""
    converged: bool
    """Whether the last adjustment did, and the rounds settled."""
    limit_px: float
    """Rays that missed their points by more were left out."""
    mean_px: float
    """Mean length of the residuals."""
    sigma0: float
    estimated: tuple[str, ...]
    """Parameters of the interior orientation that are free in the block."""
    observed: tuple[str, ...]
    """Why others are observed where they start, a sentence each."""
    alike: float
    """By what the standard deviations of the camera are larger than if neighbouring rays erred independently."""


@pretty_repr
class Oriented(NamedTuple):
    """A block of photographs, oriented as a free network of arbitrary scale, and how it was made."""

    block: Block
    """It starts where the orientation left it; `jaxphoto.adjust` gives its statistics."""
    residuals_mm: Float[np.ndarray, "rows 2"]
    """Of its image points, observed minus computed."""
    report: OrientationReport
    sizes: PaddedSizes
    """That its adjustments were compiled for; with them that of `block` runs the same program."""


def orient(
    names: Sequence[str],
    sensor: Sensor,
    interior: InteriorOrientation,
    features: Sequence[Float[np.ndarray, "_ 2"]],
    matches: Sequence[PairMatches],
    sigmas_mm: Sequence[Float[np.ndarray, "_"]] | None = None,
    title: str = "photographs",
    report: Report = lambda text: None,
) -> Oriented:
    """Orient the images `names` of one camera from matches of their features, false ones among them.

    `features` are measured image coordinates (mm, from the image centre) by image, `sigmas_mm` their standard
    deviations (half a pixel where they are not given), `matches` index them. `interior` is where its parameters start;
    those that the images tell are free in the block. `report` is told what is being done.

    Raises BlockError where no two images begin a network, and for groups of images that nothing connects (all named).
    """
    features = [np.asarray(xy, float).reshape(-1, 2) for xy in features]
    if sigmas_mm is None:
        sigmas_mm = [np.full(len(xy), SIGMA_PX * sensor.pixel_mm) for xy in features]
    sigma = float(np.median(np.concatenate(sigmas_mm)))
    c = float(interior.c)
    loose = float(np.hypot(sigma, LENS_PX * sensor.pixel_mm)) / c
    rays = [unit_rays(c, ideal_coordinates(interior, xy)) for xy in features]
    related = relate(names, rays, loose, matches, LEAST_MATCHES, report)
    check_connected(names, related)

    number = [len(xy) for xy in features]
    found = tracks(number, list(related.matches))
    block = _block_of(title, names, sensor, interior, features, sigmas_mm, found)
    calibration = calibration_of(block)
    start = grown(block, related.pairs, calibration, LEAST_POINTS, MOST * loose * c / sigma, report)
    network, _, limit, rounds, _, lost = finished(
        block, start.network, calibration, early(calibration), start.angle, LEAST_POINTS, report, FIRST_ROUNDS
    )

    look = second_look(network, network.interior[CAMERA], features, matches, sigma, limit)
    found = tracks(number, list(look.matches))
    block = _block_of(title, names, sensor, interior, features, sigmas_mm, found)
    again = calibration_of(block)
    calibration = again._replace(sizes=again.sizes | calibration.sizes)
    network = empty_network(block)._replace(
        interior=network.interior,
        positions=network.positions,
        camera_from_object=network.camera_from_object,
        oriented=network.oriented,
    )
    network = meet(sight_of(block, network.interior), network, limit, start.angle)
    observed = asked(calibration, {CAMERA: ()})
    second = finished(block, network, calibration, observed, start.angle, LEAST_POINTS, report)
    camera = told(second.adjusted, calibration)
    estimated = asked(calibration, camera.names)
    last = finished(block, second.network, calibration, estimated, start.angle, LEAST_POINTS, report, LAST_ROUNDS)

    network = last.network
    refused = start.refused | lost | second.lost | last.lost
    made = _oriented_block(block, network, calibration, estimated)
    residual = np.asarray(last.adjusted.residuals.image).T * np.asarray(made.image_points.sigma)
    fate = np.bincount(network.fate, minlength=len(Fate))
    return Oriented(
        made,
        residual,
        OrientationReport(
            n_images=len(names),
            n_matches=sum(len(m.features) for m in matches),
            n_pairs=len({(p.first, p.second) for p in related.pairs}),
            order=tuple(names[i] for i in start.order if network.oriented[i]),
            unoriented={names[i]: refused[i] for i in np.flatnonzero(~network.oriented).tolist()},
            gross_errors=GrossErrors(
                look.unoriented, look.off_epipolar, found.n_conflicting, *(int(fate[f]) for f in _COUNTED)
            ),
            n_points=len(made.points),
            n_image_points=len(made.image_points.image),
            rounds=rounds + second.rounds + last.rounds,
            settled=last.settled,
            converged=last.settled and bool(last.adjusted.converged),
            limit_px=last.limit * sigma / sensor.pixel_mm,
            mean_px=float(np.mean(np.hypot(*residual.T))) / sensor.pixel_mm,
            sigma0=float(last.adjusted.sigma0),
            estimated=camera.names[CAMERA],
            observed=tuple(camera.open),
            alike=camera.alike,
        ),
        calibration.sizes,
    )


_COUNTED = (Fate.BEYOND, Fate.SMALL_ANGLE, Fate.TOO_FEW, Fate.UNSUPPORTED)


def _block_of(title, names, sensor, interior, features, sigmas_mm, found: Tracks) -> Block:
    """A block of which nothing is known but the camera, and of that only where it starts."""
    n, n_points = len(names), int(found.point.max(initial=-1)) + 1
    for name in parameter_names(interior):
        interior = set_parameter(interior, name, np.asarray(get_parameter(interior, name), float))
    exterior = ExteriorOrientation(np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))  # type: ignore[arg-type]
    rows = np.concatenate([[0], np.cumsum([len(xy) for xy in features])])[found.image] + found.feature
    xy, sigma = np.concatenate(features)[rows], np.concatenate(sigmas_mm)[rows]
    block = photographs_block(
        title,
        names,
        [f"t{k + 1}" for k in range(n_points)],
        sensor,
        (interior, freed(interior, _candidates(interior))),
        (exterior, np.zeros((n_points, 3))),
        ImagePoints(found.image, found.point, xy, np.stack([sigma, sigma], axis=1)),
    )
    nothing = dataclasses.replace(block.start, image_known=np.zeros(n, bool), point_known=np.zeros(n_points, bool))
    return dataclasses.replace(block, start=nothing)


def photographs_block(
    title: str,
    names: Sequence[str],
    points: Sequence[str],
    sensor: Sensor,
    camera: tuple[InteriorOrientation, InteriorOrientation],
    start: tuple[ExteriorOrientation, Float[np.ndarray, "points 3"]],
    rows: ImagePoints,
) -> Block:
    """Photographs of one `camera`, its interior orientation and the priors of that, as a free network from `start`."""
    interior, priors = (dataclasses.replace(part, residuals="measured") for part in camera)
    unknowns = Unknowns({CAMERA: interior}, *start, {}, {})
    n, n_points = len(names), len(points)
    return Block(
        title=title,
        images=tuple(names),
        points=tuple(points),
        sensors={CAMERA: sensor},
        image_camera=(CAMERA,) * n,
        image_mount=("",) * n,
        image_strip=("",) * n,
        image_time=np.zeros(n),
        image_points=rows,
        control=ControlCoordinates.none(),
        fixed=ControlCoordinates.none(),
        check=ControlCoordinates.none(),
        stations=CameraPositions.none(),
        attitudes=Attitudes.none(),
        distances=Distances.none(),
        datum=Datum("inner", "points"),
        start=Start(unknowns, np.ones(n, bool), np.ones(n_points, bool)),
        priors=dataclasses.replace(default_priors(unknowns), interior={CAMERA: priors}),
    )


def _candidates(interior: InteriorOrientation) -> tuple[str, ...]:
    """Parameters that the images are asked for: c, principal point and the usual of the model."""
    return ("c_mm", "xp_mm", "yp_mm", *interior.distortion.usual())


def _oriented_block(block: Block, network: Network, calibration: SelfCalibration, estimated: Asked) -> Block:
    images = np.flatnonzero(network.oriented)
    points = np.unique(block.image_points.point[network.used])
    made = part_of(block, network, images, points, network.used)
    priors = freed(made.priors.interior[CAMERA], estimated.free[CAMERA])
    for name in estimated.observed[CAMERA]:
        priors = set_parameter(priors, name, observation(calibration, CAMERA, name))
    return dataclasses.replace(made, priors=dataclasses.replace(made.priors, interior={CAMERA: priors}))
