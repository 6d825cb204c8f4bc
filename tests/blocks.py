"""Small blocks with known truth for the tests of the core: seeded, simulated by the library's own models.

`simulated(name)` is one of `VARIANTS`: the block with noisy observations and rough start values, and its truth. All
aerial variants have the same points in the same images and share compiled programs where only numbers differ.
"""

import dataclasses
import functools
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxphoto import FIXED, FREE, Outcome, Unknowns, Weighted, adjust, covariance, read_block, read_recipe
from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import Balanced, Brown, InteriorOrientation, Sensor, Smac, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.compiling.fast_compilation import jit_quickly
from jaxphoto.georeferencing import Mount, Scanner, StripBias
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints, SurfaceRows
from jaxphoto.rotation import small_rotation
from jaxphoto.simulation import remeasure, simulate
from jaxphoto.unknowns import default_priors
from tests.formulas import camera_from_object, collinearity

SENSOR = Sensor(4500, 3000, 0.008)
BROWN = InteriorOrientation(35.1, 0.05, -0.08, Brown(k1=-9e-5, k2=1.0e-7))
SMAC = InteriorOrientation(34.8, -0.04, 0.06, Smac(k1=-8e-5, k2=9e-8, p1=1e-5, r0=9.0))
BALANCED = InteriorOrientation(35.4, 0.02, 0.03, Balanced(a1=8e-5, a2=-5e-8, b1=1e-5, c1=1e-4, r0=10.0))
FIVE = ("c_mm", "xp_mm", "yp_mm", "k1", "k2")
LEVER_ARM = np.array([0.35, -0.52, 1.10])
BORESIGHT = np.array([0.006, -0.009, 0.013])


class Simulated(NamedTuple):
    block: Block
    truth: Unknowns


class Scene(NamedTuple):
    """Truth of exterior orientation and points."""

    positions: np.ndarray
    angles: np.ndarray
    points: np.ndarray


@functools.cache
def aerial(seed: int = 5) -> Scene:
    """Two crossing strips of five images 1000 m over ground with 150 m of relief."""
    rng = np.random.default_rng(seed)
    along = np.linspace(-420.0, 420.0, 5)
    across = rng.normal(0.0, 25.0, 5)
    height = 1000 + rng.normal(0.0, 20.0, 10)
    east, north = np.column_stack([along, across]), np.column_stack([-across, along])
    positions = np.column_stack([np.concatenate([east, north]), height])
    angles = rng.normal(0.0, 0.03, (10, 3)) + np.repeat([[0, 0, 0.2], [0, 0, 1.7]], 5, axis=0)
    grid = np.stack(np.meshgrid(np.linspace(-420, 420, 7), np.linspace(-420, 420, 7)), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid + rng.normal(0, 20, grid.shape), rng.uniform(0, 150, len(grid))])
    return Scene(positions, angles, points)


@functools.cache
def close_range(seed: int = 6) -> Scene:
    """Eight convergent images, rolled by quarter turns, around an object of 2 m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (36, 3)) * [1.0, 0.8, 0.5]
    positions, angles = [], []
    for k in range(8):
        azimuth, up = 2 * np.pi * k / 8, 0.5 + 0.4 * (k % 3)
        back = np.array([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)])
        right = np.cross([0, 0, 1.0], back)
        right /= np.linalg.norm(right)
        matrix = np.stack([right, np.cross(back, right), back])
        roll = k % 4 * np.pi / 2
        matrix = camera_from_object(0.0, 0.0, roll) @ matrix
        phi = np.arcsin(matrix[2, 0])
        angles.append([np.arctan2(-matrix[2, 1], matrix[2, 2]), phi, np.arctan2(-matrix[1, 0], matrix[0, 0])])
        positions.append(4.0 * back + rng.normal(0, 0.1, 3))
    return Scene(np.array(positions), np.array(angles), points)


def bare(scene: Scene, cameras: dict[str, InteriorOrientation], of_image, mounts=None, strips=None) -> Simulated:
    """Block of image points alone, which are zero, with fixed cameras."""
    n_images, n_points = len(scene.positions), len(scene.points)
    of_image = tuple(of_image)
    rows = []
    for p, point in enumerate(scene.points):
        seen = []
        for i in range(n_images):
            c = float(cameras[of_image[i]].c)
            x, y = collinearity(c, scene.angles[i], scene.positions[i], point)
            if abs(x) < 17 and abs(y) < 11:
                seen.append((i, p))
        rows += seen if len(seen) >= 2 else []
    image, point = np.array(rows).T
    n = len(image)
    used, point = np.unique(point, return_inverse=True)
    mounts, strips = mounts or {}, strips or {}
    exterior = ExteriorOrientation.from_angles(scene.positions, scene.angles)
    truth = Unknowns(
        {name: jax.tree.map(np.float64, camera) for name, camera in cameras.items()},
        jax.tree.map(np.asarray, exterior),
        scene.points[used],
        mounts,
        strips,
    )
    n_points = len(used)
    half = n_images // 2
    time = np.concatenate([np.linspace(-6, 6, half), np.linspace(-7, 7, n_images - half)])
    block = Block(
        title="simulated",
        images=tuple(f"i{k}" for k in range(n_images)),
        points=tuple(f"p{k}" for k in range(n_points)),
        sensors=dict.fromkeys(cameras, SENSOR),
        image_camera=of_image,
        image_mount=(next(iter(mounts), ""),) * n_images,
        image_strip=("a",) * half + ("b",) * (n_images - half) if strips else ("",) * n_images,
        image_time=time if strips else np.zeros(n_images),
        image_points=ImagePoints(image, point, np.zeros((n, 2)), np.full((n, 2), 0.004)),
        control=ControlCoordinates.none(),
        fixed=ControlCoordinates.none(),
        check=ControlCoordinates.none(),
        stations=CameraPositions.none(),
        attitudes=Attitudes.none(),
        distances=Distances.none(),
        datum=Datum(),
        start=Start(truth, np.ones(n_images, bool), np.ones(n_points, bool)),
        priors=default_priors(truth),
    )
    return Simulated(block, truth)


def rows(who, axes=(0, 1, 2), sigma=0.03, kind=ControlCoordinates):
    """Rows of all `axes` of `who`; `measured` fills the values."""
    who, axis = (v.ravel() for v in np.meshgrid(np.asarray(who, int), axes, indexing="ij"))
    return kind(who, axis, np.zeros(len(who)), np.full(len(who), sigma))


def all_stations(block: Block, sigma=0.10) -> CameraPositions:
    return rows(range(len(block.images)), sigma=sigma, kind=CameraPositions)


def all_attitudes(block: Block, sigma=1e-4) -> Attitudes:
    n = len(block.images)
    return Attitudes(np.arange(n), np.zeros((n, 3)), np.full((n, 3), sigma) * [1, 1, 2])


def with_priors(block: Block, camera: str, **priors) -> Block:
    """Replace the priors of parameters of one camera."""
    tree = block.priors.interior[camera]
    for name, prior in priors.items():
        tree = set_parameter(tree, name, prior)
    return eqx.tree_at(lambda b: b.priors.interior[camera], block, tree)


def free(block: Block, camera: str, names=FIVE) -> Block:
    return with_priors(block, camera, **dict.fromkeys(names, FREE))


def measured(simulated: Simulated, seed: int = 1) -> Simulated:
    """Replace observations by noisy ones of the truth, and start values by rough ones."""
    block, truth = simulated
    block = _remeasured(block, truth, jax.random.key(seed))
    return Simulated(eqx.tree_at(lambda b: b.start.unknowns, block, rough(block, truth)), truth)


def _remeasured(block: Block, truth: Unknowns, key) -> Block:
    # Eager JAX would compile every operation.
    once = jit_quickly(lambda u, k: observed(remeasure(block, u, k)))
    return eqx.tree_at(observed, block, jax.tree.map(np.asarray, once(truth, key)))


def observed(b: Block):
    """Observations of a block that `remeasure` draws."""
    rows = (b.stations, b.control, b.fixed, b.check, b.distances)
    return b.image_points.xy, b.attitudes.roll_pitch_yaw, *(r.value for r in rows), b.surfaces.foot


def rough(block: Block, truth: Unknowns, seed: int = 2) -> Unknowns:
    """Start values: every free unknown off by far more than its standard deviation."""
    rng = np.random.default_rng(seed)
    metres = 2.0 if np.ptp(truth.points[:, 2]) > 10 else 0.01
    angles = np.asarray(truth.exterior.omega_phi_kappa) + rng.normal(0, 0.004, (len(block.images), 3))
    position = truth.exterior.position + rng.normal(0, metres, truth.exterior.position.shape)
    points = truth.points + rng.normal(0, metres, truth.points.shape)

    def moved(value, prior, step):
        return value + step * np.sign(rng.normal()) if prior != FIXED else value

    def tables(function, known, priors):
        return {name: jax.tree.map(function, known[name], priors[name]) for name in known}

    interior = {}
    for name, camera in truth.interior.items():
        priors = block.priors.interior[name]
        camera = InteriorOrientation(
            moved(camera.c, priors.c, 0.2),
            moved(camera.xp, priors.xp, 0.05),
            moved(camera.yp, priors.yp, 0.05),
            jax.tree.map(lambda v, p: v if p == FIXED else np.float64(0.5 * v), camera.distortion, priors.distortion),
        )
        interior[name] = jax.tree.map(np.float64, camera)
    return Unknowns(
        interior,
        jax.tree.map(np.asarray, ExteriorOrientation.from_angles(position, angles)),
        points,
        tables(lambda v, p: v if p == FIXED else v + 0.01, truth.mounts, block.priors.mounts),
        tables(lambda v, p: v if p == FIXED else 0.0 * v, truth.strips, block.priors.strips),
        jax.tree.map(lambda v: 0.0 * v, truth.scanner),
    )


CONTROL = (3, 4, 20, 36, 37)
CHECK = (12, 34)


def _aerial(cameras=None, of_image=("one",) * 10, **more) -> Simulated:
    block, truth = bare(aerial(), cameras or {"one": BROWN}, of_image, **more)
    block = dataclasses.replace(
        block, control=rows(CONTROL), check=rows(CHECK, sigma=0.0), stations=all_stations(block)
    )
    return Simulated(block, truth)


def _cross() -> Simulated:
    block, truth = _aerial()
    return Simulated(free(block, "one"), truth)


def _two_cameras() -> Simulated:
    """One model twice, not sorted by image, with different free parameters and one of them weighted."""
    other = InteriorOrientation(34.6, 0.1, 0.02, Brown(k1=-7e-5, k2=5e-8, p1=1e-5))
    block, truth = _aerial({"one": BROWN, "two": other}, ("one", "two", "two", "one", "one") * 2)
    block = with_priors(free(block, "two", ("c_mm", "xp_mm", "yp_mm", "k1")), "two", p1=Weighted(1.2e-5, 5e-6))
    return Simulated(free(block, "one"), truth)


def _three_models() -> Simulated:
    cameras = {"smac": SMAC, "brown": BROWN, "balanced": BALANCED}
    block, truth = _aerial(cameras, ("brown", "smac", "balanced", "smac", "brown", "balanced") + ("smac",) * 4)
    block = free(free(block, "brown"), "smac", (*FIVE, "p1"))
    return Simulated(free(block, "balanced", ("c_mm", "xp_mm", "yp_mm", "a1", "a2", "b1")), truth)


def _mount() -> Simulated:
    """Lever arm and boresight free, attitudes observed, rotations of the images tilted by boresight."""
    block, truth = _aerial(mounts={"imu": Mount(LEVER_ARM, BORESIGHT)})
    block = dataclasses.replace(block, attitudes=all_attitudes(block), stations=all_stations(block, 0.02))
    block = eqx.tree_at(lambda b: b.priors.mounts["imu"], block, Mount(FREE, FREE, FIXED))
    return Simulated(free(block, "one"), truth)


def _strips() -> Simulated:
    """Shift and drift of two strips free."""
    strips = {
        "a": StripBias(np.array([0.8, -0.5, 0.6]), np.array([0.03, 0.02, -0.04])),
        "b": StripBias(np.array([-0.7, 0.9, -0.4]), np.array([-0.02, 0.05, 0.03])),
    }
    block, truth = _aerial(strips=strips)
    block = dataclasses.replace(block, stations=all_stations(block, 0.02))
    priors = {name: StripBias(FREE, FREE) for name in strips}
    block = eqx.tree_at(lambda b: b.priors.strips, block, priors)
    return Simulated(free(block, "one"), truth)


def _inner_shift() -> Simulated:
    """No control, and stations of two strips with free shifts: position is open, scale and rotation are not."""
    block, truth = _strips()
    priors = {name: StripBias(FREE, FIXED) for name in truth.strips}
    block = eqx.tree_at(lambda b: b.priors.strips, block, priors)
    return Simulated(dataclasses.replace(block, control=ControlCoordinates.none(), datum=Datum("inner")), truth)


def _everything() -> Simulated:
    """All groups of observations and unknowns at once: weighted ones, and control in height only, among them."""
    strips = {
        "a": StripBias(np.array([0.2, -0.1, 0.3]), np.array([0.0, 0.01, 0.0])),
        "b": StripBias(np.array([-0.3, 0.2, -0.2]), np.zeros(3)),
    }
    other = InteriorOrientation(34.6, 0.1, 0.02, Brown(k1=-7e-5, k2=5e-8))
    block, truth = _aerial(
        {"one": BROWN, "two": other, "smac": SMAC},
        ("one", "two", "smac", "one", "two") * 2,
        mounts={"imu": Mount(LEVER_ARM, BORESIGHT)},
        strips=strips,
    )
    ends = np.array([[3, 17], [17, 40], [5, 35]])
    block = dataclasses.replace(
        block,
        attitudes=all_attitudes(block).take(np.arange(1, 7)),
        control=ControlCoordinates.joined(rows(CONTROL), rows((5, 21, 33), (2,))),
        fixed=rows((17,), (0, 1), 0.0),
        distances=Distances(ends, np.zeros(3), np.array([0.02, 0.03, 0.01])),
    )
    block = free(with_priors(block, "one", c_mm=Weighted(35.0, 0.05), k1=Weighted(-9.5e-5, 1e-5)), "one", FIVE[1:3])
    block = free(free(block, "smac"), "two", ("c_mm", "k1"))
    priors = {
        "a": StripBias(FREE, Weighted(np.zeros(3), np.full(3, 0.02))),
        "b": StripBias(Weighted(np.zeros(3), 0.5), FIXED),
    }
    block = eqx.tree_at(
        lambda b: (b.priors.mounts["imu"], b.priors.strips),
        block,
        (Mount(Weighted(np.array([0.3, -0.5, 1.0]), np.array([0.05, 0.06, 0.07])), FREE, FIXED), priors),
    )
    return Simulated(block, truth)


def _fixed_interior() -> Simulated:
    return _aerial()


def _fixed_control() -> Simulated:
    """Control without error, among it a point that is fixed in height only; no stations."""
    block, truth = _cross()
    fixed = ControlCoordinates.joined(rows(CONTROL, sigma=0.0), rows((21,), (2,), 0.0))
    return Simulated(
        dataclasses.replace(block, control=ControlCoordinates.none(), fixed=fixed, stations=CameraPositions.none()),
        truth,
    )


def _surfaces() -> Simulated:
    """Points on the surfaces of two lidar strips for control; boresight and shifts of the scanner unknown."""
    block, truth = _mount()
    shifts = {"l1": np.array([0.1, 0.2, -0.3]), "l2": np.array([-0.2, 0.1, 0.2])}
    scanner = Scanner(np.array([0.002, -0.003, 0.004]), shifts)
    rng = np.random.default_rng(11)
    # Some points lie on surfaces of both strips.
    point = np.concatenate([np.arange(30), np.arange(12, 40)])
    n = len(point)
    normal = rng.normal([0, 0, 1.0], 0.5, (n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turn = np.cross(rng.normal([0, 0, -1000.0], 200, (n, 3)), normal)
    surfaces = SurfaceRows(point, np.arange(n) // 30, np.zeros((n, 3)), normal, turn, np.full(n, 0.1))
    block = dataclasses.replace(block, surfaces=surfaces, control=rows(CONTROL[:1]))
    of_scanner = lambda b: (b.start.unknowns.scanner, b.priors.scanner)  # noqa: E731
    prior = Scanner(FREE, {"l1": Weighted(np.zeros(3), np.array([0.3, 0.3, 0.2])), "l2": FREE})
    block = eqx.tree_at(of_scanner, block, (scanner, prior), is_leaf=lambda x: x is None)
    return Simulated(block, dataclasses.replace(truth, scanner=scanner))


def _close(datum: Datum, bars: bool = True) -> Simulated:
    block, truth = bare(close_range(), {"one": BROWN}, ("one",) * 8)
    ends = np.array([[0, 1], [1, 2], [5, 30]])
    distances = Distances(ends, np.zeros(3), np.full(3, 1e-4)) if bars else Distances.none()
    return Simulated(free(dataclasses.replace(block, distances=distances, datum=datum), "one"), truth)


def free_network(kind: str = "inner", distances: Distances | None = None) -> Block:
    """Aerial block of image points alone, or with distances."""
    block, truth = bare(aerial(), {"one": BROWN}, ("one",) * 10)
    own = {"datum": Datum(kind), "distances": distances or Distances.none()}
    return measured(Simulated(dataclasses.replace(block, **own), truth)).block


def from_afar(block: Block, known: Unknowns) -> Block:
    """Move the start values so far from `known` that steps are rejected."""
    rng, n = np.random.default_rng(1), len(block.images)
    turn = np.asarray(jax.jit(jax.vmap(small_rotation))(rng.normal(0, 0.3, (n, 3))))
    exterior = dataclasses.replace(
        known.exterior,
        position=known.exterior.position + rng.normal(0, 120.0, (n, 3)),
        camera_from_object=turn @ known.exterior.camera_from_object,
    )
    points = known.points + rng.normal(0, 60.0, known.points.shape)
    start = eqx.tree_at(lambda u: (u.exterior, u.points), known, (exterior, points))
    return eqx.tree_at(lambda b: b.start.unknowns, block, start)


VARIANTS = {
    "cross": _cross,
    "two_cameras": _two_cameras,
    "three_models": _three_models,
    "mount": _mount,
    "strips": _strips,
    "everything": _everything,
    "surfaces": _surfaces,
    "fixed_interior": _fixed_interior,
    "fixed_control": _fixed_control,
    "inner": lambda: _close(Datum("inner", "points", False)),
    "inner_images": lambda: _close(Datum("inner", "images")),
    "inner_some": lambda: _close(Datum("inner", tuple(f"p{k}" for k in range(4, 16)))),
    "inner_scale": lambda: _close(Datum("inner", "points", True), bars=False),
    "inner_shift": _inner_shift,
    "minimal": lambda: _close(Datum("minimal")),
}


def _field(n_images: int = 60) -> Simulated:
    """A test field: points without error, each seen by nearly all images."""
    rng = np.random.default_rng(13)
    grid = np.stack(np.meshgrid(np.linspace(-300, 300, 5), np.linspace(-250, 250, 4)), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid + rng.normal(0, 20, grid.shape), rng.uniform(0, 150, len(grid))])
    positions = np.column_stack([rng.normal(0, 60, (n_images, 2)), rng.normal(1000, 30, n_images)])
    angles = rng.normal(0, 0.05, (n_images, 3)) + np.linspace(0, 6, n_images)[:, None] * [0, 0, 1]
    block, truth = bare(Scene(positions, angles, points), {"one": BROWN}, ("one",) * n_images)
    block = dataclasses.replace(block, fixed=rows(np.arange(len(block.points)), sigma=0.0))
    return Simulated(free(block, "one"), truth)


def _field_and_ground() -> Simulated:
    """Points without error that nearly all images see, and others that few see; distances between both kinds."""
    block, truth = _field(26)
    fixed, n = np.arange(0, len(block.points), 2), len(block.points)
    image, point, xy, sigma = (getattr(block.image_points, k) for k in ("image", "point", "xy", "sigma"))
    few = (point % 2 == 0) | ((image + point) % 6 == 0)
    ends = np.array([[0, 3], [5, 7]])
    block = dataclasses.replace(
        block,
        image_points=ImagePoints(image[few], point[few], xy[few], sigma[few]),
        fixed=ControlCoordinates.joined(rows(fixed, sigma=0.0), rows((n - 1,), (2,), 0.0)),
        control=rows((1, 9)),
        distances=Distances(ends, np.zeros(2), np.array([0.02, 0.03])),
    )
    return Simulated(block, truth)


# Blocks with fixed points at several places of the padded arrays.
FIELDS = {"field": _field, "field_and_ground": _field_and_ground}


@functools.cache
def simulated(name: str) -> Simulated:
    """One of `VARIANTS` or `FIELDS` with noisy observations."""
    return measured((VARIANTS | FIELDS)[name]())


@functools.cache
def adjusted(name: str):
    """Adjustment of one of `VARIANTS`, once per session."""
    block = simulated(name).block
    result = adjust(block, block.start.unknowns)
    assert result.outcome is Outcome.CONVERGED
    return result


@functools.cache
def covariance_of(name: str):
    """Covariance of `adjusted(name)`, rotations about the camera axes."""
    return covariance(adjusted(name), "camera")


@functools.cache
def example() -> Block:
    """The block of examples/cross_block."""
    return read_block(Path(__file__).parents[1] / "examples" / "cross_block")


@functools.cache
def adjusted_example():
    """`example`, adjusted."""
    return adjust(example())


@functools.cache
def calibration_flight():
    """Simulation of calibration_flight.toml: images, stations and attitudes of strips at two heights, and control."""
    return simulate(read_recipe(Path(__file__).parent / "calibration_flight.toml"), seed=3)
