"""One block that observes and estimates every declared kind, of jaxphoto and of a user: it compiles once."""

import dataclasses
import functools

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto import AbstractObservations, AbstractParameters, KnownParameters, Outcome, adjust, correlated, index_of
from jaxphoto.adjustment.adjust import _residuals
from jaxphoto.adjustment.layout.padding import pad_structure
from jaxphoto.adjustment.model.block_values import values_of
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.arrays import ArrayLike
from jaxphoto.block import Block, Motion
from jaxphoto.camera import CameraSpline, StripCamera
from jaxphoto.compiling import run_compiled
from jaxphoto.georeferencing import Mount, RigCamera, ScannerCalibration, StripSpline, TrajectoryKnot
from jaxphoto.observations import (
    AXES,
    AttitudeSteps,
    CameraPositions,
    Distances,
    ImageState,
    PositionSteps,
    RelativeAttitudes,
    RelativePositions,
    RigPlaces,
    RigTurns,
    StripCameraSteps,
    StripPlanes,
    StripPoints,
    TrajectoryAttitudes,
    TrajectoryStations,
    exponential_covariance,
)
from jaxphoto.rotation import matrix_from_roll_pitch_yaw, roll_pitch_yaw_from_matrix, small_rotation
from jaxphoto.unknowns import FIXED, FREE, Unknowns, Weighted
from tests.blocks import VARIANTS, Simulated, free, measured, rows, with_priors
from tests.levelling import HeightDifferences


class Baselines(AbstractObservations):
    """Relative positions of two exposures (m)."""

    group = "baselines"
    unit = "m"
    axes = AXES

    start: Int[np.ndarray, "n"] = index_of("image")
    end: Int[np.ndarray, "n"] = index_of("image")
    value: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n 3"]

    def residual(self, start: ImageState, end: ImageState) -> Float[Array, "3"]:
        return self.value - (end.position - start.position)


class RateOfC(AbstractParameters):
    """The principal distance of a camera grows as it warms up."""

    kind = "c_rates"
    owner = "camera"
    names = {"rate": ("rate_mm_per_s",)}  # noqa: RUF012
    modifies_interior = ("c",)

    rate: float

    def interior(self, interior, exposure):
        return dataclasses.replace(interior, c=interior.c + self.rate * exposure.time)


class Heights(AbstractParameters):
    """GNSS heights of a strip are too large by this."""

    kind = "heights"
    owner = "strip"
    names = {"offset": ("offset_m",)}  # noqa: RUF012

    offset: float

    def station(self, position, exposure):
        return position.at[2].add(self.offset)


class Clocks(AbstractParameters):
    """The receiver's clock is slow by this, in each session."""

    kind = "clocks"
    owner = "session"
    names = {"offset": ("offset_s",)}  # noqa: RUF012

    offset: float

    def station(self, position, exposure):
        return position + exposure.velocity * self.offset


class CommonShift(AbstractParameters):
    """All stations are shifted in plan."""

    kind = "shifts"
    owner = "block"
    names = {"shift": ("X_m", "Y_m")}  # noqa: RUF012

    shift: Float[Array, "2"]

    def station(self, position, exposure):
        return position.at[:2].add(self.shift)


OWN = {
    "c_rates": {"one": RateOfC(np.float64(0.012))},
    "heights": {"a": Heights(np.float64(0.35)), "b": Heights(np.float64(-0.25))},
    "clocks": {"early": Clocks(np.float64(0.006)), "late": Clocks(np.float64(-0.004))},
    "shifts": {"": CommonShift(np.array([0.3, -0.2]))},
}
"""Truth of the user-defined unknowns, one of each kind of owner."""
LASER = {
    "scanner_calibration": {
        "": ScannerCalibration(
            np.array([0.03, -0.02, 0.05]),
            *map(np.float64, (0.04, 60.0, 90.0)),
            np.array([2e-5, -3e-5]),
            np.asarray(2e-3),
        )
    },
    "trajectory_knots": {
        f"1 at {k} s": TrajectoryKnot(0.05 * np.array([1, -k, k % 2]), 1e-4 * np.array([k - 2, 1, -k]))
        for k in range(5)
    },
}
"""Truth of a laser scanner's, all known beforehand to about their size."""
STRIPS = {
    "strip_cameras": {
        "a": StripCamera(*map(np.float64, (0.02, -0.01, 0.015))),
        "b": StripCamera(*map(np.float64, (-0.01, 0.02, 0.005))),
    }
}
"""Truth of what cameras of strips have more than that of the block, likewise."""
_WANDERING = 0.01 * np.array([[1, -1, 2, 1], [-1, 0.5, 1, 2], [1, 2, -1, 1]])
SPLINE = {"camera_splines": {"one": CameraSpline(*_WANDERING, 4, 20.0)}}
"""Truth of how the camera wanders, likewise."""
RIG = {"rig_cameras": {"one": RigCamera(np.array([0.2, -0.1, 0.05]), np.array([2e-3, -1e-3, 3e-3]), np.asarray(4e-3))}}
"""Truth of where it sits beside itself: any two photographs are a rig that bends by what is between them."""
KNOWN = ("interior[one].c_mm", "interior[one].k1")


def own_priors(prior_of) -> dict:
    """Priors of all of `OWN`: `prior_of` a true value."""
    return jax.tree.map(prior_of, OWN)


def residuals_of(block: Block, unknowns: Unknowns):
    """Residuals over their standard deviations at `unknowns`, and the structure."""
    s = structure_of(block, block.priors)
    padded = pad_structure(s, dense=bool(s.coupled))
    values = padded.pad(values_of(block, unknowns, block.priors, s))
    return padded.crop_residuals(run_compiled(_residuals, (values, padded.structure), {}, "residuals")), s


def changed(block: Block, change) -> Block:
    """The block with `change(rows, k)` in place of all observations; k is the place of their group, -1 for images."""
    place = {id(of): k for k, of in enumerate(of for of in block.observations if len(of))}
    named = block.named_observations.items()
    return block.with_observations({name: change(of, place.get(id(of), -1)) for name, of in named})


def _observed(block: Block, truth: Unknowns, seed: int) -> Block:
    """Every observation computed from the truth by its own residual, with noise of its own covariance."""

    def exact(of, k):
        v = found.image if k < 0 else found.others[k]
        return of.with_observation(np.asarray(of.observation) - of.physical(v).T)

    def noisy(of, k):
        return of.with_observation(np.asarray(of.observation) + of.physical(rng.normal(size=np.shape(of.sigmas)).T).T)

    # Residuals are those of ideal coordinates: what they say of measured ones is right to a few per cent.
    for _ in range(6):
        found, _ = residuals_of(block, truth)
        block = changed(block, exact)
    assert max(np.abs(v).max() for v in (found.image, *found.others[: len(block.observations)])) < 1e-5
    rng = np.random.default_rng(seed)
    return changed(block, noisy)


def _weighted(rng, truth, sigma) -> Weighted:
    sigma = np.broadcast_to(sigma, np.shape(truth))
    return Weighted(truth + sigma * rng.normal(size=np.shape(truth)), np.array(sigma))


def _further(n_images: int, angles: np.ndarray) -> tuple:
    """Observations of all further kinds; `_observed` fills the values."""
    rng = np.random.default_rng(4)
    factor = rng.normal(0, 0.02, (n_images, 3, 3)) + 0.05 * np.eye(3)
    gnss = rows(range(n_images), sigma=1.0, kind=CameraPositions)
    heights = rows(range(n_images), (2,), sigma=1.0, kind=CameraPositions)
    times = np.array([np.linspace(-6, 6, 5), np.linspace(-7, 7, 5)])
    in_time = np.stack([exponential_covariance(t, 0.08, 5.0) for t in times])
    start, end = np.array([0, 3, 8, 20, 30]), np.array([7, 9, 25, 33, 5])
    first = np.array([0, 2, 5, 4])
    pairs = np.array([0, 1, 5, 4]), np.array([1, 2, 6, 5])
    body = jax.vmap(matrix_from_roll_pitch_yaw)(angles)
    turns = np.asarray([roll_pitch_yaw_from_matrix(body[a].T @ body[b]) for a, b in zip(*pairs, strict=True)])
    return (
        HeightDifferences(start, end, np.zeros(5), np.array([0.005, 0.01, 0.02, 0.01, 0.005])),
        Baselines(first, np.array([1, 3, 9, 6]), np.zeros((4, 3)), np.full((4, 3), 0.03) * [1, 1, 2]),
        correlated(gnss, np.arange(3 * n_images).reshape(-1, 3), factor @ factor.transpose(0, 2, 1)),
        correlated(heights, np.arange(n_images).reshape(2, -1), in_time),
        *_strips(),
        *_exposures_and_ties(angles),
        RigPlaces(np.array([0, 1, 6]), np.array([1, 2, 8]), np.zeros((3, 3)), np.full((3, 3), 0.03)),
        RigTurns(np.array([0, 1, 6]), np.array([1, 2, 8]), np.zeros((3, 3)), np.full((3, 3), 2e-4)),
        RelativePositions(*pairs, np.zeros((4, 3)), np.full((4, 3), 0.01) * [1, 1, 2]),
        RelativeAttitudes(*pairs, turns, np.full((4, 3), 1e-4) * [1, 1, 2]),
    )


def _strips() -> tuple:
    """Planes seen from two strips, and steps between knots of one of them."""
    rng, n = np.random.default_rng(6), 12
    point = rng.uniform(-300, 300, (n, 3)) * [1, 1, 0.05]
    knots, weights = StripSpline(0, 5, 0.0, 1.0).weights(np.linspace(0, 2, n))
    normal = rng.normal(0, 0.3, (n, 3)) + np.array([0, 0, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    scanner = point + rng.uniform(-200, 200, (2, n, 3)) * [1, 1, 0.1] + np.array([0, 0, 700])
    angles = rng.uniform(-0.1, 0.1, (2, n, 3)) + np.array([0, 0, 1])
    motions = *(np.array([50.0, -20.0, 1.0]) + rng.normal(0, 2, (2, n, 3))), *rng.normal(0, 0.05, (2, n, 3))
    sides = (knots, knots[::-1], weights, weights[::-1], point, point + 0.01, *scanner, *angles, *motions)
    start, kept, none = np.arange(4), np.full(4, 0.9), np.zeros((4, 3))
    return (
        StripPlanes(*sides, normal, np.full(n, 0.02), np.zeros(n)),
        PositionSteps(start, start + 1, kept, np.full((4, 3), 0.03), none),
        AttitudeSteps(start, start + 1, kept, np.full((4, 3), 5e-5), none),
        StripCameraSteps(np.array([0]), np.array([1]), np.zeros((1, 3)), np.full((1, 3), 0.02)),
    )


def _exposures_and_ties(angles: np.ndarray) -> tuple:
    """Exposures on the trajectory of the scanner, and tie points on planes of its strip; two points on two planes."""
    n_images = len(angles)
    rng, spline = np.random.default_rng(7), StripSpline(0, 5, 0.0, 1.0)
    who, axis = np.repeat(np.arange(n_images), 3), np.tile(np.arange(3), n_images)
    knots, weights = spline.weights(np.linspace(0.1, 1.9, n_images))
    station = np.array([0.02, 0.02, 0.04])[axis]
    point = np.array([1, 2, 2, 6, 11, 15, 15, 22, 30, 38])
    n = len(point)
    foot = rng.uniform(-300, 300, (n, 3)) * [1, 1, 0.05]
    normal = rng.normal(0, 0.3, (n, 3)) + np.array([0, 0, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    pose = foot + rng.uniform(-200, 200, (n, 3)) * [1, 1, 0.1] + np.array([0, 0, 700])
    turned = rng.uniform(-0.1, 0.1, (n, 3)) - np.array([0, 0, 1])
    own, weight = spline.weights(np.linspace(0, 2, n))
    motion = np.array([50.0, -20.0, 1.0]) + rng.normal(0, 2, (n, 3)), rng.normal(0, 0.05, (n, 3))
    return (
        TrajectoryStations(who, knots[who], weights[who], axis, np.zeros(len(who)), station),
        TrajectoryAttitudes(np.arange(n_images), knots, weights, angles, np.full((n_images, 3), 5e-5) * [1, 1, 2]),
        StripPoints(point, own, weight, foot, pose, turned, *motion, normal, np.full(n, 0.03), np.zeros(n)),
    )


def _with_motion(block: Block) -> Block:
    """The block in two strips and two sessions, its exposures moving and turning."""
    return dataclasses.replace(
        block,
        image_strip=("a",) * 5 + ("b",) * 5,
        image_time=np.concatenate([np.linspace(-6, 6, 5), np.linspace(-7, 7, 5)]),
        motion=Motion(
            np.repeat([[60.0, 12, 0], [-8, 55.0, 0]], 5, axis=0), np.linspace(-0.02, 0.03, 30).reshape(10, 3)
        ),
        partitions={"session": ("early",) * 4 + ("late",) * 5 + ("",)},
    )


@functools.cache
def own_alone() -> Simulated:
    """Block of user-defined unknowns alone, which compiles in a tenth of the time."""
    block, truth = VARIANTS["cross"]()
    block, _ = measured(Simulated(_with_motion(block), truth))
    truth = dataclasses.replace(truth, more=OWN)
    start = dataclasses.replace(block.start.unknowns, more=jax.tree.map(np.zeros_like, OWN))
    priors = dataclasses.replace(block.priors, more=own_priors(lambda _: FREE))
    unfinished = dataclasses.replace(block, start=dataclasses.replace(block.start, unknowns=start), priors=priors)
    return Simulated(_observed(unfinished, truth, 1), truth)


@functools.cache
def simulated(seed: int = 1) -> Simulated:
    """Block of all kinds, with noise and rough start values, and its truth."""
    block, truth = VARIANTS["surfaces"]()
    n, rng = len(block.images), np.random.default_rng(seed + 100)
    ends = np.array([[3, 17], [17, 40], [5, 35]])
    block = dataclasses.replace(
        _with_motion(block),
        control=rows((3, 4, 20, 36, 37)),
        distances=Distances(ends, np.zeros(3), np.array([0.02, 0.03, 0.01])),
    )
    block, _ = measured(Simulated(free(block, "one"), truth))
    truth = dataclasses.replace(truth, more=OWN | LASER | STRIPS | SPLINE | RIG)
    start = dataclasses.replace(block.start.unknowns, more=jax.tree.map(np.zeros_like, truth.more))
    camera = truth.interior["one"]
    block = with_priors(block, "one", k2=_weighted(rng, np.float64(camera.distortion.k2), 3e-9))
    turns = rng.normal(0, 2e-3, (n, 3))
    priors = dataclasses.replace(
        block.priors,
        more=own_priors(lambda _: FREE)
        | jax.tree.map(lambda v: _weighted(rng, v, np.abs(v).max() + 1e-5), LASER | STRIPS | SPLINE | RIG),
        exterior=dataclasses.replace(
            block.priors.exterior,
            position=_weighted(rng, truth.exterior.position, [0.1, 0.1, 0.2]),
            camera_from_object=Weighted(
                np.asarray(jax.vmap(small_rotation)(turns)) @ truth.exterior.camera_from_object, np.full((n, 3), 2e-3)
            ),
        ),
        points=_weighted(rng, truth.points, 1.0),
        mounts={"imu": Mount(_weighted(rng, truth.mounts["imu"].lever_arm, 0.05), FREE, FIXED)},
    )
    sigma = np.array([0.01, 2e-6])
    covariance = np.outer(sigma, sigma) * [[1, -0.7], [-0.7, 1]]
    known = np.array([camera.c, camera.distortion.k1]) + np.linalg.cholesky(covariance) @ rng.normal(size=2)
    unfinished = dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=start),
        priors=priors,
        more=(*_further(n, np.asarray(block.attitudes.roll_pitch_yaw)), KnownParameters(KNOWN, known, covariance)),
    )
    return Simulated(_observed(unfinished, truth, seed), truth)


@functools.cache
def adjusted():
    """Adjustment of `simulated`, the further observations passed by the argument `more`."""
    block = simulated().block
    result = adjust(dataclasses.replace(block, more=()), block.start.unknowns, more=block.more)
    assert result.outcome is Outcome.CONVERGED
    return result
