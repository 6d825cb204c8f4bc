"""Orient a block from matched features, for a calibration of the camera that took them.

1. COLMAP orients the images and joins matches to points (`colmap`).
2. The network is adjusted iteratively, all parameters of the camera observed; gross errors are rejected.
3. Parameters of the camera that the images determine become free (`self_calibration`), and the iteration is repeated.

A false match along an epipolar line gives a two-ray point at a wrong depth without residuals. Its neighbours in the
image contradict it: over an image the inverse depth of a surface varies slowly; for a plane it is linear. A two-ray
point is rejected if its inverse depth is far from the median of its neighbours in both images, relative to their robust
spread and its standard deviation. At depth discontinuities neighbours spread widely, and nothing is rejected.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.adjustment import Adjustment, PaddedSizes, solve
from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import InteriorOrientation, Sensor, get_parameter, parameter_names, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.initial.matches import PairMatches
from jaxphoto.initial.rays import ideal_coordinates
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints
from jaxphoto.procedures.orientation.colmap import MappedCamera, Network, map_images
from jaxphoto.procedures.orientation.self_calibration import (
    SelfCalibration,
    determined,
    freed,
    self_calibration,
)
from jaxphoto.short_repr import pretty_repr
from jaxphoto.unknowns import Unknowns, default_priors
from jaxphoto.variants import some_images, without_observations

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
    alike: float
    """Factor of the camera's standard deviations due to the correlation of neighbouring residuals."""


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
            alike=camera.correlation_factor,
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
