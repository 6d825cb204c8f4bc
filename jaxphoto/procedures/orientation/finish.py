"""The end of an orientation: all parameters estimated, gross errors left out in rounds, and what the camera needs.

Which parameters of the interior orientation the images can tell follows from one adjustment of all of them, freed of
what was known beforehand. One after the other, those that would leave the corner of the format open are observed where
they start; each time the rest is what it would be with that one observed. What the images tell stays free even where it
hardly differs from its start: drawn to it, it would bend a strip by more than its own uncertainty does.

Rays beside one another in an image err alike where the lens, a rolling shutter or the features do what no model says.
Standard deviations that take them for independent are too small by the root of the design effect (Kish),

    d = sum over cells (sum over the rays of a cell v)^2 / sum over all rays v^2,

1 for independent residuals v, and the number of rays in a cell for such as are the same in it.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment, NormalEquations
from jaxphoto.block import Block
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import camera_words
from jaxphoto.procedures.orientation.depths import supported
from jaxphoto.procedures.orientation.network import Network, meet, normalised_misfits, robust_scale, sight_of
from jaxphoto.procedures.orientation.refine import Asked, Names, SelfCalibration, hardly_known, observation, refined
from jaxphoto.procedures.orientation.related_pairs import Report

# Gross errors are beyond so many robust standard deviations, and never within the second, in a priori ones.
_LIMIT, _LEAST_LIMIT = 4.0, 1.0
# Rounds end where less than this part of the image points, or so few of them, change sides; before the last adjustment
# they need not come to that, and before the second look at all matches two are enough.
_STILL, _FEW = 1e-3, 2
FIRST_ROUNDS, ROUNDS, LAST_ROUNDS = 2, 6, 20
# The images tell a parameter that they know by so much better than anybody beforehand.
_TOLD = 0.5
# Cells along the longer side of an image.
_CELLS = 8


class Finished(NamedTuple):
    """A network without gross errors, adjusted."""

    network: Network
    adjusted: Adjustment
    limit: float
    """Rays that miss their points by more a priori standard deviations are gross errors."""
    rounds: int
    settled: bool
    """Whether the last round changed hardly any image point."""
    lost: dict[int, str]
    """Images that see too few points once gross errors are left out."""


def finished(
    block: Block,
    network: Network,
    calibration: SelfCalibration,
    estimated: Asked,
    angle: float,
    least: int,
    report: Report = lambda text: None,
    rounds: int = ROUNDS,
) -> Finished:
    """`network` adjusted in turn with its points met anew until hardly any image point changes.

    Rays make a point at `angle` (rad) or more; an image that sees fewer than `least` points goes. After `rounds` it
    ends in any case; `settled` says whether it had to.
    """
    lost: dict[int, str] = {}
    settled = False
    for number in range(1, rounds + 1):
        report(f"adjusting {int(network.oriented.sum())} images, round {number}")
        # Of a large block each adjustment is hundreds of megabytes: only the last one is kept.
        network = refined(block, network, calibration, estimated)[0]
        sight, before = sight_of(block, network.interior), network.fate
        limit = max(_LEAST_LIMIT, _LIMIT * robust_scale(normalised_misfits(sight, network)))
        network = supported(sight, meet(sight, network, limit, angle))
        seen = np.bincount(sight.image[network.used], minlength=len(network.oriented))
        few = np.flatnonzero(network.oriented & (seen < least))
        for image in few.tolist():
            lost[image] = f"only {seen[image]} of its points fit, and {least} are needed"
            network = network.without_image(image)
        if len(few):
            network = supported(sight, meet(sight, network, limit, angle))
        elif np.sum(before != network.fate) <= max(_FEW, _STILL * len(before)):
            settled = True
            break
    network, adjusted = refined(block, network, calibration, estimated)
    return Finished(network, adjusted, limit, number, settled, lost)


class Told(NamedTuple):
    """The parameters of cameras that images tell."""

    names: Names
    open: list[str]
    """Why others are observed, a sentence each."""
    alike: float
    """By what their standard deviations are larger than they were if all rays erred independently."""


def told(adjusted: Adjustment, calibration: SelfCalibration) -> Told:
    """The parameters of `calibration` that images tell; in `adjusted` all of them were observed."""
    alike = erring_alike(adjusted.block, np.asarray(adjusted.residuals.image))
    matrix, labels = _shared_covariance(adjusted), adjusted.structure.labels
    kept: Names = {}
    said: list[str] = []
    for camera, names in calibration.names.items():
        place = [labels.index(f"interior[{camera}].{name}") for name in names]
        known = [observation(calibration, camera, name) for name in names]
        sigma = np.array([float(prior.sigma) for prior in known])
        hardly = np.array([hardly_known(calibration, camera, name) for name in names])
        # What the images say by themselves.
        images = np.linalg.inv(matrix[np.ix_(place, place)]) - np.diag(sigma**-2.0)
        left_open = _open(names, images / (float(adjusted.sigma0) * alike) ** 2, sigma, hardly)
        kept[camera] = tuple(name for name in names if name not in left_open)
        said += [
            f"{name} of {camera_words(camera)} is observed where it starts, {float(prior.value):.6g} +- "
            f"{float(prior.sigma):.2g}: the images leave the corner of the format open by "
            f"{left_open[name] / calibration.unit[camera][name]:.1%} of its radius"
            for name, prior in zip(names, known, strict=True)
            if name in left_open
        ]
    return Told(kept, said, alike)


def erring_alike(block: Block, residuals: Float[np.ndarray, "2 rows"]) -> float:
    """The root of the design effect of the `residuals` of the image rows of `block`, both axes together; 1 or more."""
    rows, sensors = block.image_points, [block.sensors[camera] for camera in block.image_camera]
    half = np.array([(s.width_mm, s.height_mm) for s in sensors])[rows.image] / 2
    side = 2 * half.max(axis=1, keepdims=True) / _CELLS
    place = np.clip((np.asarray(rows.xy) + half) // side, 0, _CELLS - 1).astype(int)
    cell = (np.asarray(rows.image) * _CELLS + place[:, 0]) * _CELLS + place[:, 1]
    sums = np.stack([np.bincount(cell, v) for v in residuals])
    return float(np.sqrt(max(1.0, np.sum(sums**2) / np.sum(residuals**2))))


def _shared_covariance(adjusted: Adjustment) -> np.ndarray:
    """A priori covariance of the unknowns that images share; no datum changes it, so its constraints stay in."""
    equations, n = adjusted.equations, adjusted.structure.n_shared
    scale = np.asarray(equations.scale.shared)
    inverse = np.asarray(call_compiled(_inverse, equations))[-n:, -n:]
    return inverse * np.outer(scale, scale)


@eqx.filter_jit
def _inverse(equations: NormalEquations) -> Float[Array, "reduced reduced"]:
    # All of statistics.covariance, points and all, would take several times longer to compile.
    return equations.inverse_of_reduced()


def _open(names: tuple[str, ...], normal: np.ndarray, observed: np.ndarray, hardly: np.ndarray) -> dict[str, float]:
    """Parameters that the images do not tell, and their standard deviations by the images.

    `normal` are the normal equations of the images. What they do not tell joins them, the least told first, with the
    standard deviations `observed`; the rest with `hardly`, which keep them regular.
    """
    found = np.zeros(len(names), bool)
    said: dict[str, float] = {}
    while True:
        weight = np.where(found, observed, hardly) ** -2.0
        sigma = np.sqrt(np.diagonal(np.linalg.inv(normal + np.diag(weight))))
        part = np.where(found, 0.0, sigma / observed)
        out = int(np.argmax(part))
        if not part[out] > _TOLD:
            return said
        found[out], said[names[out]] = True, float(sigma[out])
