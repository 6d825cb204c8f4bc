"""The self-calibrating adjustment of what is oriented so far, as a free network.

All adjustments of one network, small or large, run one compiled program: they have one set of unknowns and are padded
to one size. What is not to be estimated yet gets a weight that holds it.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxphoto.adjustment import Adjustment, PaddedSizes, common_sizes, solve
from jaxphoto.block import Block, Datum, Frame, Start
from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import Corrections
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints, SurfaceRows
from jaxphoto.procedures.orientation.network import Network
from jaxphoto.unknowns import FIXED, FREE, Unknowns, Weighted, default_priors

# Over flat ground a principal distance that is hardly told creeps.
_STEPS = 200
# By what part of the radius a parameter moves the corner of the format: one that is held, and what lenses have. The
# latter is observed about the start: images that say little of a lens would else let a wrong principal distance and
# distortions of many tens of pixels make up for one another.
_HELD, _LENS = 1e-7, 0.03
# The same of a principal distance, which a start says to so much, and which moves by so much a step while a network
# grows; and what hardly counts.
_C, _FREE = 0.1, 0.3
_EARLY = ("c_mm", "k1", "k2")
Names = dict[str, tuple[str, ...]]


class Asked(NamedTuple):
    """The parameters that an adjustment estimates; the others of a calibration are held."""

    free: Names
    """By camera: of which nothing is known."""
    observed: Names
    """By camera: observed where they start, with the standard deviation of `observation`."""


class SelfCalibration(NamedTuple):
    """What is estimated of the interior orientation while a network grows."""

    names: Names
    """Parameters by camera: those that the block does not hold."""
    unit: dict[str, dict[str, float]]
    """By camera and parameter: the change that moves the corner of the format by its whole radius."""
    start: dict[str, dict[str, float]]
    """By camera and parameter."""
    sizes: PaddedSizes
    """Of the whole block, which all its parts are padded to."""


def calibration_of(block: Block) -> SelfCalibration:
    """What a free network of the images of `block` estimates: all that its priors do not hold fixed."""
    names, unit, begin = {}, {}, {}
    for camera, priors in block.priors.interior.items():
        names[camera] = tuple(n for n in parameter_names(priors) if get_parameter(priors, n) != FIXED)
        sensor, interior = block.sensors[camera], block.start.unknowns.interior[camera]
        corner = np.array([sensor.width_mm, sensor.height_mm]) / 2
        unit[camera] = {n: float(np.linalg.norm(corner)) / _at_corner(interior, n, corner) for n in names[camera]}
        begin[camera] = {n: float(np.asarray(get_parameter(interior, n))) for n in names[camera]}
    calibration = SelfCalibration(names, unit, begin, PaddedSizes())
    return calibration._replace(sizes=common_sizes([_with_priors(bare(block), calibration, Asked(names, {}))]))


def _at_corner(interior: InteriorOrientation, name: str, corner: np.ndarray) -> float:
    """By how many mm a unit of a parameter moves the image at the corner of the format, or nearer where that is more.

    A balance radius may lie at the corner, which radial terms then leave where it is.
    """
    if name == "c_mm":
        return float(np.linalg.norm(corner) / np.asarray(interior.c))
    if name in ("xp_mm", "yp_mm"):
        return 1.0
    value, step = float(np.asarray(get_parameter(interior, name))), 1e-12
    at = jnp.asarray(corner) * jnp.linspace(0.25, 1.0, 4)[:, None]
    both = [np.asarray(jax.vmap(set_parameter(interior, name, value + s).closed_form)(at)) for s in (step, -step)]
    return float(np.linalg.norm(both[0] - both[1], axis=1).max()) / (2 * step)


def observation(calibration: SelfCalibration, camera: str, name: str) -> Weighted:
    """What is known of a parameter beforehand: its start, as closely as lenses are alike and as c is known."""
    sigma = (_C if name == "c_mm" else _LENS) * calibration.unit[camera][name]
    return Weighted(np.asarray(calibration.start[camera][name]), np.asarray(sigma))


def hardly_known(calibration: SelfCalibration, camera: str, name: str) -> float:
    """A standard deviation that hardly counts, for a parameter that is free."""
    return _FREE * calibration.unit[camera][name]


def asked(calibration: SelfCalibration, free: Names) -> Asked:
    """All parameters of `calibration`: those in `free`, and the others observed."""
    rest = {camera: tuple(n for n in names if n not in free[camera]) for camera, names in calibration.names.items()}
    return Asked(free, rest)


def early(calibration: SelfCalibration) -> Asked:
    """What few images can tell of a camera."""
    return Asked({}, {camera: tuple(n for n in names if n in _EARLY) for camera, names in calibration.names.items()})


def refined(
    block: Block, network: Network, calibration: SelfCalibration, estimated: Asked, growing: bool = False
) -> tuple[Network, Adjustment]:
    """The network after an adjustment of its oriented images and of the points that they meet in.

    What is free is observed where it is now, so loosely that it hardly counts. While a network is `growing`, c is
    observed where it is now, too: it may be off by any amount, and moves so much a step.
    """
    images = np.flatnonzero(network.oriented)
    points = np.unique(np.asarray(block.image_points.point)[network.used])
    part = part_of(block, network, images, points, network.used)
    part = _with_priors(part, calibration, estimated, growing)
    adjusted = solve(part, part.start.unknowns, part.priors, _STEPS, calibration.sizes)
    if not bool(adjusted.converged) and not np.isfinite(float(adjusted.sum_of_squares)):
        return network, adjusted
    exterior = adjusted.unknowns.exterior
    positions, matrices, at = network.positions.copy(), network.camera_from_object.copy(), network.points.copy()
    positions[images], matrices[images] = exterior.position, exterior.camera_from_object
    at[points] = adjusted.unknowns.points
    interior = network.interior | adjusted.unknowns.interior
    found = network._replace(interior=interior, positions=positions, camera_from_object=matrices, points=at)
    return found, adjusted


def _with_priors(block: Block, calibration: SelfCalibration, estimated: Asked, growing: bool = False) -> Block:
    interiors = {}
    for camera, start in block.start.unknowns.interior.items():
        priors = block.priors.interior[camera]
        for name in calibration.names[camera]:
            prior, now = observation(calibration, camera, name), np.asarray(get_parameter(start, name), float)
            if name in estimated.free.get(camera, ()):
                prior = Weighted(now, np.asarray(hardly_known(calibration, camera, name)))
            elif name not in estimated.observed.get(camera, ()):
                # A principal distance stays where it has come to, the others are held at their start.
                held = np.asarray(_HELD * calibration.unit[camera][name])
                prior = Weighted(now if name == "c_mm" else prior.value, held)
            elif growing and name == "c_mm":
                prior = Weighted(now, prior.sigma)
            priors = set_parameter(priors, name, prior)
        interiors[camera] = priors
    return dataclasses.replace(block, priors=dataclasses.replace(block.priors, interior=interiors))


def part_of(
    block: Block, network: Network, images: np.ndarray, points: np.ndarray, rows: Bool[np.ndarray, " rows"]
) -> Block:
    """`images` and `points` of `block` with the image rows `rows`, oriented as in `network`, as a free network."""
    free, measured = bare(block), block.image_points
    image, point = (_numbers(kept, n) for kept, n in ((images, len(block.images)), (points, len(block.points))))
    cameras = tuple(block.image_camera[i] for i in images)
    exterior = ExteriorOrientation(network.positions[images], network.camera_from_object[images])  # type: ignore[arg-type]
    interior = {name: network.interior[name] for name in network.interior if name in cameras}
    unknowns = Unknowns(interior, exterior, network.points[points], {}, {})
    priors = default_priors(unknowns)
    own = {name: block.priors.interior[name] for name in interior}
    return dataclasses.replace(
        free,
        images=tuple(block.images[i] for i in images),
        points=tuple(block.points[p] for p in points),
        sensors={name: block.sensors[name] for name in interior},
        image_camera=cameras,
        image_mount=("",) * len(images),
        image_strip=("",) * len(images),
        image_time=np.zeros(len(images)),
        image_points=ImagePoints(
            image[np.asarray(measured.image)[rows]],
            point[np.asarray(measured.point)[rows]],
            np.asarray(measured.xy)[rows],
            np.asarray(measured.sigma)[rows],
        ),
        start=Start(unknowns, np.ones(len(images), bool), np.ones(len(points), bool)),
        priors=dataclasses.replace(priors, interior=own),
    )


def _numbers(kept: np.ndarray, n: int) -> np.ndarray:
    new = np.full(n, -1)
    new[kept] = np.arange(len(kept))
    return new


def bare(block: Block) -> Block:
    """`block` with its image rows only, and its datum free: no control, no sensor, no mount, no strip."""
    n = len(block.images)
    none: dict = {"mounts": {}, "strips": {}, "scanner": None, "more": {}}
    return dataclasses.replace(
        block,
        image_mount=("",) * n,
        image_strip=("",) * n,
        image_time=np.zeros(n),
        flight_time=None,
        temperatures=None,
        partitions={},
        control=ControlCoordinates.none(),
        fixed=ControlCoordinates.none(),
        check=ControlCoordinates.none(),
        stations=CameraPositions.none(),
        attitudes=Attitudes.none(),
        distances=Distances.none(),
        datum=Datum("inner", "points"),
        start=dataclasses.replace(block.start, unknowns=dataclasses.replace(block.start.unknowns, **none)),
        priors=dataclasses.replace(block.priors, **none),
        motion=None,
        frame=Frame(),
        corrections=Corrections(),
        surfaces=SurfaceRows.none(),
        more=(),
    )


def freed(priors: InteriorOrientation, names: tuple[str, ...]) -> InteriorOrientation:
    """Priors of a camera of which `names` are FREE and everything else is FIXED."""
    for name in parameter_names(priors):
        priors = set_parameter(priors, name, FREE if name in names else FIXED)
    return priors
