"""Orient a block from matched features, for a calibration of the camera that took them.

1. COLMAP orients the images and joins matches to points (`colmap`).
2. The network is adjusted iteratively, all parameters of the camera observed; gross errors are rejected.
3. Parameters of the camera that the images determine become free (`self_calibration`), and the iteration is repeated.

A false match along an epipolar line gives a two-ray point at a wrong depth without residuals. Its neighbours in the
image contradict it: over an image the inverse depth of a surface varies slowly; for a plane it is linear. A two-ray
point is rejected if its inverse depth is far from the median of its neighbours in both images, relative to their robust
spread and its standard deviation. At depth discontinuities neighbours spread widely, and nothing is rejected.

During the iteration every parameter is observed at its initial value with a standard deviation of 3 % of the image
radius in the corner of the format, the principal distance with 10 %: real lenses deviate by a few times these values.
The parameters that the images determine follow from the covariance of the adjustment without these observations, for
spatially correlated errors of the image points (`correlated_noise`). The others, the weakest first, remain observed in
the block.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.adjustment import Adjustment, PaddedSizes, common_sizes, solve
from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import InteriorOrientation, Sensor, get_parameter, parameter_names, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError, camera_words
from jaxphoto.initial.matches import PairMatches
from jaxphoto.initial.rays import ideal_coordinates
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints
from jaxphoto.procedures.orientation.colmap import MappedCamera, Network, map_images
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import correlated_noise
from jaxphoto.unknowns import FIXED, FREE, Unknowns, Weighted, default_priors
from jaxphoto.variants import some_images, without_observations

# Prior standard deviations: distortion parameters and principal point (image shift in the corner of the format divided
# by its radius); c (divided by c); a free parameter (as the first).
_LENS, _C, _FREE = 0.03, 0.1, 0.3
# Maximum ratio of the standard deviation of a determined parameter to its prior one.
_DETERMINED = 0.5


class SelfCalibration(NamedTuple):
    """Parameters of one camera that are not fixed, in the order of the model."""

    camera: str
    names: tuple[str, ...]
    unit: dict[str, float]
    """Change of each parameter that shifts the corner of the format by its radius."""
    start: dict[str, float]
    sizes: PaddedSizes
    """Padded sizes of the whole block, so parts of it run the same compiled program."""

    def observation(self, name: str) -> Weighted:
        """Return the prior information of a parameter: its initial value with a standard deviation."""
        sigma = (_C if name == "c_mm" else _LENS) * self.unit[name]
        return Weighted(np.asarray(self.start[name]), np.asarray(sigma))

    def with_priors(self, block: Block, free: tuple[str, ...]) -> Block:
        """Return `block` with parameters `free` weakly observed at current values, others at initial values."""
        interior, priors = block.start.unknowns.interior[self.camera], block.priors.interior[self.camera]
        for name in self.names:
            prior = self.observation(name)
            if name in free:
                now = np.asarray(get_parameter(interior, name), float)
                prior = Weighted(now, np.asarray(_FREE * self.unit[name]))
            priors = set_parameter(priors, name, prior)
        return _with_camera_priors(block, self.camera, priors)

    def final_priors(self, block: Block, free: tuple[str, ...]) -> Block:
        """Return `block` with the parameters `free` free, and the others observed at initial values."""
        priors = freed(block.priors.interior[self.camera], free)
        for name in self.names:
            if name not in free:
                priors = set_parameter(priors, name, self.observation(name))
        return _with_camera_priors(block, self.camera, priors)


class Determined(NamedTuple):
    """Parameters of a camera that images determine."""

    names: tuple[str, ...]
    observed: list[str]
    """Reasons why other parameters remain observed, one message each."""
    sigma_factors: dict[str, float]
    """Factors of the standard deviations of all parameters due to spatially correlated errors of image points."""


def self_calibration(block: Block, camera: str) -> SelfCalibration:
    """Set up the parameters of `camera` that a free network of images estimates: all that are not fixed."""
    priors, sensor = block.priors.interior[camera], block.sensors[camera]
    interior = block.start.unknowns.interior[camera]
    names = tuple(n for n in parameter_names(priors) if get_parameter(priors, n) != FIXED)
    corner = np.array([sensor.width_mm, sensor.height_mm]) / 2
    unit = {n: float(np.linalg.norm(corner)) / corner_shift(interior, n, corner) for n in names}
    start = {n: float(np.asarray(get_parameter(interior, n))) for n in names}
    calibration = SelfCalibration(camera, names, unit, start, PaddedSizes())
    return calibration._replace(sizes=common_sizes([calibration.with_priors(block, names)]))


def corner_shift(interior: InteriorOrientation, name: str, corner: np.ndarray) -> float:
    """Return the image shift (mm) per unit of a parameter: in the corner of the format, or its maximum along the
    radius.

    The maximum is used because radial terms vanish in the corner if that is their balance radius.
    """
    if name == "c_mm":
        return float(np.linalg.norm(corner) / np.asarray(interior.c))
    if name in ("xp_mm", "yp_mm"):
        return 1.0
    value, step = float(np.asarray(get_parameter(interior, name))), 1e-12
    at = jnp.asarray(corner) * jnp.linspace(0.25, 1.0, 4)[:, None]
    both = [np.asarray(jax.vmap(set_parameter(interior, name, value + s).closed_form)(at)) for s in (step, -step)]
    return float(np.linalg.norm(both[0] - both[1], axis=1).max()) / (2 * step)


def determined(adjusted: Adjustment, calibration: SelfCalibration) -> Determined:
    """Select the parameters of `calibration` that images determine; in `adjusted` all of them are observed."""
    noise, camera, names = correlated_noise(adjusted), calibration.camera, calibration.names
    place = [noise.labels.index(f"interior[{camera}].{name}") for name in names]
    priors = [calibration.observation(name) for name in names]
    sigma = np.array([float(prior.sigma) for prior in priors])
    loose = np.array([_FREE * calibration.unit[name] for name in names])
    # Without priors the estimates have the covariance N^-1 B N^-1, with N the normal matrix of the image points and B
    # the covariance of its right-hand side.
    weights = np.linalg.inv(noise.independent)
    right = (weights @ noise.of_images @ weights)[np.ix_(place, place)]
    images = weights[np.ix_(place, place)] - np.diag(sigma**-2.0)
    weak = undetermined(names, images @ np.linalg.solve(right, images), sigma, loose)
    return Determined(
        tuple(name for name in names if name not in weak),
        [
            f"{name} of {camera_words(camera)} is observed where it starts, {float(prior.value):.6g} +- "
            f"{float(prior.sigma):.2g}: the images determine the corner of the format only to "
            f"{weak[name] / calibration.unit[name]:.1%} of its radius"
            for name, prior in zip(names, priors, strict=True)
            if name in weak
        ],
        {name: noise.factors[noise.labels[k]] for name, k in zip(names, place, strict=True)},
    )


def undetermined(
    names: tuple[str, ...], normal: np.ndarray, observed: np.ndarray, loose: np.ndarray
) -> dict[str, float]:
    """Return the parameters that the images do not determine, and their standard deviations from the images.

    `normal` contains the normal equations of the images. Undetermined parameters are added as observations with the
    standard deviations `observed`, the weakest first. The others are observed with `loose`, to keep the equations
    regular.
    """
    weak = np.zeros(len(names), bool)
    sigmas: dict[str, float] = {}
    while True:
        weight = np.where(weak, observed, loose) ** -2.0
        sigma = np.sqrt(np.diagonal(np.linalg.inv(normal + np.diag(weight))))
        part = np.where(weak, 0.0, sigma / observed)
        weakest = int(np.argmax(part))
        if not part[weakest] > _DETERMINED:
            return sigmas
        weak[weakest], sigmas[names[weakest]] = True, float(sigma[weakest])


def freed(priors: InteriorOrientation, names: tuple[str, ...]) -> InteriorOrientation:
    """Return priors of a camera with the parameters `names` FREE and all others FIXED."""
    for name in parameter_names(priors):
        priors = set_parameter(priors, name, FREE if name in names else FIXED)
    return priors


def _with_camera_priors(block: Block, camera: str, priors: InteriorOrientation) -> Block:
    interior = block.priors.interior | {camera: priors}
    return dataclasses.replace(block, priors=dataclasses.replace(block.priors, interior=interior))


CAMERA = "camera"
"""Name of the camera of photographs in the block."""
SIGMA_PX = 0.5
"""Default standard deviation of a feature, in pixels."""
MIN_MATCHES = 15
"""Minimum number of matches of a pair: fewer false ones agree by chance."""
MIN_POINTS = 10
"""Minimum number of points of an oriented photograph."""
ITERATIONS = 20
# Maximum fraction of image points, or number if larger, rejected in the last iteration.
_CONVERGED, _FEW = 1e-3, 2
# Maximum number of steps: over flat ground a weakly determined principal distance converges slowly.
_MAX_STEPS = 200

Report = Callable[[str], object]


class GrossErrors(NamedTuple):
    """Rejected matches and image points, counted by reason."""

    unoriented: int
    """Matches of pairs with an unoriented image."""
    off_epipolar: int
    """Matches that contradict the relative orientation of their pair."""
    untriangulated: int
    """Other matches whose features were not triangulated to one point."""
    beyond: int
    """Image points whose residual exceeds the limit."""
    too_few: int
    """Image points of points and images with too few remaining image points."""
    unsupported: int
    """Image points of two-ray points whose depth contradicts neighbouring points."""


class OrientationReport(NamedTuple):
    """Summary of an orientation."""

    n_images: int
    n_matches: int
    n_pairs: int
    """Number of pairs with a relative orientation."""
    order: tuple[str, ...]
    """Oriented images, in the order of their orientation."""
    unoriented: dict[str, str]
    """Reasons for images that are not oriented."""
    gross_errors: GrossErrors
    n_points: int
    n_image_points: int
    rounds: int
    """Number of iterations of adjustment and rejection."""
    settled: bool
    """True if the last iteration rejected hardly any image points."""
    converged: bool
    """True if the last adjustment converged and the iteration settled."""
    limit_px: float
    """Maximum residual of accepted image points."""
    mean_px: float
    """Mean length of the residuals."""
    sigma0: float
    estimated: tuple[str, ...]
    """Parameters of the interior orientation that are free in the block."""
    observed: tuple[str, ...]
    """Reasons why other parameters remain observed at their initial values, one message each."""
    sigma_factors: dict[str, float]
    """Factors of the camera's standard deviations due to spatially correlated errors of image points, by parameter."""


@pretty_repr
class Oriented(NamedTuple):
    """Block of photographs, oriented as a free network of arbitrary scale, and the report."""

    block: Block
    """Block with initial values from the last adjustment; `jaxphoto.adjust` gives statistics."""
    residuals_mm: Float[np.ndarray, "rows 2"]
    """Residuals of the block's image points, observed minus computed."""
    report: OrientationReport
    sizes: PaddedSizes
    """Padded sizes of the compiled adjustments; `block` can reuse their program with these sizes."""


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
    """Orient the images `names` of one camera from matches of their features, which may include gross errors.

    `features` are measured image coordinates (mm, from the image centre) by image, `sigmas_mm` their standard
    deviations (half a pixel by default), `matches` index them. `interior` is the initial camera; parameters that the
    images determine are free in the block. `report` is called with the current step.

    Raises BlockError if no two images can be oriented, and for unconnected groups of images (all named).
    """
    features = [np.asarray(xy, float).reshape(-1, 2) for xy in features]
    if sigmas_mm is None:
        sigmas_mm = [np.full(len(xy), SIGMA_PX * sensor.pixel_mm) for xy in features]
    report(f"orienting {len(names)} images (COLMAP)")
    c_px = float(interior.c) / sensor.pixel_mm
    network = map_images(
        names,
        [MappedCamera(sensor.width_px, sensor.height_px, c_px, False)],
        [0] * len(names),
        [sensor.px_from_mm(ideal_coordinates(interior, xy)) for xy in features],
        matches,
        MIN_MATCHES,
        MIN_POINTS,
    )
    block = network_block(title, names, sensor, interior, features, sigmas_mm, network)
    calibration = self_calibration(block, CAMERA)
    start = set_parameter(block.start.unknowns.interior[CAMERA], "c_mm", np.asarray(network.c_px[0] * sensor.pixel_mm))
    block = _started(block, dataclasses.replace(block.start.unknowns, interior={CAMERA: start}))
    sigma = float(np.median(np.concatenate(sigmas_mm)))
    first = _iterated(block, calibration, (), report)
    camera = determined(first.adjusted, calibration)
    last = _iterated(first.block, calibration, camera.names, report)
    final = calibration.final_priors(last.block, camera.names)
    rejected = {reason: first.rejected[reason] + last.rejected[reason] for reason in first.rejected}
    residual = np.asarray(last.adjusted.residuals.image).T * np.asarray(final.image_points.sigma)
    return Oriented(
        final,
        residual,
        OrientationReport(
            n_images=len(names),
            n_matches=sum(len(m.features) for m in matches),
            n_pairs=len(network.verified),
            order=tuple(names[i] for i in network.order if names[i] in final.images),
            unoriented=_unoriented(names, network, final, first.lost | last.lost),
            gross_errors=GrossErrors(*_match_errors(matches, network), **rejected),
            n_points=len(final.points),
            n_image_points=len(final.image_points.image),
            rounds=first.iterations + last.iterations,
            settled=last.settled,
            converged=last.settled and bool(last.adjusted.converged),
            limit_px=last.limit * sigma / sensor.pixel_mm,
            mean_px=float(np.mean(np.hypot(*residual.T))) / sensor.pixel_mm,
            sigma0=float(last.adjusted.sigma0),
            estimated=camera.names,
            observed=tuple(camera.observed),
            sigma_factors=camera.sigma_factors,
        ),
        calibration.sizes,
    )


class _Iterated(NamedTuple):
    """Adjusted network without gross errors."""

    block: Block
    adjusted: Adjustment
    limit: float
    """Maximum residual in a priori standard deviations."""
    iterations: int
    settled: bool
    rejected: dict[str, int]
    lost: dict[str, str]
    """Images with too few points after rejection of gross errors."""


def _iterated(block: Block, calibration: SelfCalibration, free: tuple[str, ...], report: Report) -> _Iterated:
    """Adjust `block` with the parameters `free` and observed others, until hardly any image points are rejected."""
    rejected, lost = {"beyond": 0, "too_few": 0, "unsupported": 0}, dict[str, str]()
    for iteration in range(1, ITERATIONS + 1):
        report(f"adjusting {len(block.images)} images, iteration {iteration}")
        part = calibration.with_priors(block, free)
        adjusted = solve(part, part.start.unknowns, part.priors, _MAX_STEPS, calibration.sizes)
        if np.isfinite(float(adjusted.sum_of_squares)):
            block = _started(block, adjusted.unknowns)
        far, limit = beyond_limit(block, np.asarray(adjusted.residuals.image))
        alone = unsupported(block) & ~far
        out = far | alone
        settled = bool(out.sum() <= max(_FEW, _CONVERGED * len(out)))
        if settled or iteration == ITERATIONS:
            break
        before = len(out)
        block, _ = without_observations(block, {"image_points": out})
        seen = np.bincount(block.image_points.image, minlength=len(block.images))
        if (seen < MIN_POINTS).any():
            lost |= {
                block.images[k]: f"only {seen[k]} of its points fit, and {MIN_POINTS} are needed"
                for k in np.flatnonzero(seen < MIN_POINTS).tolist()
            }
            block = some_images(block, seen >= MIN_POINTS)
            if len(block.images) < 2:
                raise BlockError(f"no two images keep {MIN_POINTS} points without gross errors: {lost}")
        rejected["beyond"] += int(far.sum())
        rejected["unsupported"] += int(alone.sum())
        rejected["too_few"] += before - len(block.image_points.image) - int(out.sum())
    return _Iterated(block, adjusted, limit, iteration, settled, rejected, lost)


def _started(block: Block, unknowns: Unknowns) -> Block:
    return dataclasses.replace(block, start=dataclasses.replace(block.start, unknowns=unknowns))


def _match_errors(matches: Sequence[PairMatches], network: Network) -> tuple[int, int, int]:
    """Count matches of unoriented images, off the epipolar line, and of features without a common point."""
    point = {(i, f): p for i, f, p in zip(network.image, network.feature, network.point, strict=True)}
    of_pair = {(m.first, m.second): m.features for m in network.verified}
    unoriented = off = untriangulated = 0
    for m in matches:
        if not (network.oriented[m.first] and network.oriented[m.second]):
            unoriented += len(m.features)
            continue
        features = of_pair.get((m.first, m.second), np.zeros((0, 2), int))
        off += len(m.features) - len(features)
        ends = ((point.get((m.first, a), -1), point.get((m.second, b), -2)) for a, b in features.tolist())
        untriangulated += sum(int(a != b) for a, b in ends)
    return unoriented, off, untriangulated


def _unoriented(names, network: Network, block: Block, lost: dict[str, str]) -> dict[str, str]:
    """Return the reasons why images are not oriented."""
    paired = {names[k] for m in network.verified for k in (m.first, m.second)}
    few = f"it shares too few points with the others that fit one orientation; {MIN_POINTS} are needed"
    alone = "no other image has a relative orientation to it"
    return {n: lost.get(n, few if n in paired else alone) for n in names if n not in block.images}


def network_block(title, names, sensor, interior, features, sigmas_mm, network: Network) -> Block:
    """Build the block of the oriented images and points of `network`; the usual parameters of the camera are free."""
    for name in parameter_names(interior):
        interior = set_parameter(interior, name, np.asarray(get_parameter(interior, name), float))
    priors = freed(interior, ("c_mm", "xp_mm", "yp_mm", *interior.distortion.usual()))
    begin = np.concatenate([[0], np.cumsum([len(xy) for xy in features])])[network.image] + network.feature
    sigma = np.concatenate(sigmas_mm)[begin]
    exterior = ExteriorOrientation(network.positions, network.camera_from_object)  # type: ignore[arg-type]
    block = photographs_block(
        title,
        names,
        [f"t{k + 1}" for k in range(len(network.points))],
        sensor,
        (interior, priors),
        (exterior, network.points),
        ImagePoints(network.image, network.point, np.concatenate(features)[begin], np.stack([sigma, sigma], axis=1)),
    )
    return block if network.oriented.all() else some_images(block, network.oriented)


def photographs_block(
    title: str,
    names: Sequence[str],
    points: Sequence[str],
    sensor: Sensor,
    camera: tuple[InteriorOrientation, InteriorOrientation],
    start: tuple[ExteriorOrientation, Float[np.ndarray, "points 3"]],
    rows: ImagePoints,
) -> Block:
    """Build a free network of photographs of one `camera` (interior orientation, priors), initial values `start`."""
    interior, priors = camera
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


# Maximum residual in robust standard deviations; minimum of this limit in a priori standard deviations.
_LIMIT, _MIN_LIMIT = 4.0, 1.0
# Number of nearest points in the image; maximum deviation of a depth in their robust spreads.
_NEIGHBOURS, _DEPTH_LIMIT = 12, 8.0
# Ratio of the standard deviation of a normal distribution to its median absolute deviation; ratio of the standard
# deviation per axis to the median length of 2-D errors (Rayleigh).
_MAD, _RAYLEIGH = 1.4826, 1 / 1.1774


def beyond_limit(block: Block, residuals: Float[np.ndarray, "2 rows"]) -> tuple[Bool[np.ndarray, " rows"], float]:
    """Mark image rows whose `residuals`, over their sigmas, exceed the limit, at most one per point; also return the
    limit.

    Residuals are divided by the square root of the redundancy of one of n rays, (2 n - 3) / (2 n).
    """
    point = np.asarray(block.image_points.point)
    rays = np.bincount(point, minlength=len(block.points))[point]
    length = np.hypot(*residuals) / np.sqrt(1 - 1.5 / rays)
    limit = max(_MIN_LIMIT, _LIMIT * _RAYLEIGH * float(np.median(length)))
    largest = np.zeros(len(block.points))
    np.maximum.at(largest, point, length)
    return (length > limit) & (length == largest[point]), limit


def unsupported(block: Block) -> Bool[np.ndarray, " rows"]:
    """Mark image rows of two-ray points whose depths contradict their neighbours in both images."""
    rows, start = block.image_points, block.start.unknowns
    image, point = np.asarray(rows.image), np.asarray(rows.point)
    ray = np.asarray(start.points)[point] - np.asarray(start.exterior.position)[image]
    inverse = -1 / np.einsum("ni,ni->n", np.asarray(start.exterior.camera_from_object)[image, 2], ray)
    c = np.array([float(start.interior[camera].c) for camera in block.image_camera])[image]
    sigma = inverse * _relative_depth_sigma(ray, point, np.sqrt(np.mean(np.asarray(rows.sigma) ** 2, axis=1)) / c)
    two = np.bincount(point)[point] == 2
    contradicted = np.zeros(len(point), bool)
    for number in np.unique(image):
        rows_of = np.flatnonzero(image == number)
        xy, tested = np.asarray(rows.xy)[rows_of], two[rows_of]
        if len(rows_of) > _NEIGHBOURS and tested.any():
            contradicted[rows_of[tested]] = _far(xy, inverse[rows_of], sigma[rows_of], tested)
    return (np.bincount(point[contradicted], minlength=len(block.points)) == 2)[point]


def _far(xy, inverse, sigma, tested: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " tested"]:
    """Mark the `tested` points of an image whose `inverse` depths contradict their neighbours."""
    # The nearest point is the point itself.
    around = inverse[scipy.spatial.cKDTree(xy).query(xy[tested], _NEIGHBOURS + 1)[1][:, 1:]]
    median = np.median(around, axis=1)
    spread = _MAD * np.median(np.abs(around - median[:, None]), axis=1)
    return np.abs(inverse[tested] - median) > _DEPTH_LIMIT * np.hypot(spread, sigma[tested])


def _relative_depth_sigma(ray, point, sigma_rad) -> Float[np.ndarray, " rows"]:
    """Return the relative standard deviation of the depths of two-ray points: errors of both rays over their angle."""
    direction = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    total = np.stack([np.bincount(point, v) for v in direction.T], axis=1)
    # The sum of two unit vectors at an angle g has the length 2 cos(g / 2).
    half = np.arccos(np.clip(np.linalg.norm(total, axis=1) / 2, 0, 1))[point]
    return np.sqrt(2) * sigma_rad / np.sin(np.maximum(2 * half, 1e-9))
