"""Self-calibration of a network without control: select the camera parameters that the images determine.

During the iteration every parameter is observed at its initial value with a standard deviation of 3 % of the image
radius in the corner of the format, the principal distance with 10 %: real lenses deviate by a few times these values.
The parameters that the images determine follow from the covariance of the adjustment without these observations. The
others, the weakest first, remain observed in the block.

Residuals of neighbouring rays are correlated if lens, rolling shutter or features have unmodelled errors. Standard
deviations of independent rays are then too small by the square root of the design effect (Kish),

    d = sum over cells (sum over the rays of a cell v)^2 / sum over all rays v^2,

which is 1 for independent residuals v, and the number of rays per cell for residuals that are equal within cells.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment, NormalEquations, PaddedSizes, common_sizes
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names, set_parameter
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import camera_words
from jaxphoto.unknowns import FIXED, FREE, Weighted

# Prior standard deviations: distortion parameters and principal point (image shift in the corner of the format divided
# by its radius); c (divided by c); a free parameter (as the first).
_LENS, _C, _FREE = 0.03, 0.1, 0.3
# Maximum ratio of the standard deviation of a determined parameter to its prior one.
_DETERMINED = 0.5
# Number of cells along the longer side of an image.
_CELLS = 8


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
    correlation_factor: float
    """Factor of their standard deviations due to the correlation of neighbouring residuals."""


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
    factor = correlation_factor(adjusted.block, np.asarray(adjusted.residuals.image))
    matrix, labels = shared_covariance(adjusted), adjusted.structure.labels
    camera, names = calibration.camera, calibration.names
    place = [labels.index(f"interior[{camera}].{name}") for name in names]
    priors = [calibration.observation(name) for name in names]
    sigma = np.array([float(prior.sigma) for prior in priors])
    loose = np.array([_FREE * calibration.unit[name] for name in names])
    # Normal equations of the image points alone.
    images = np.linalg.inv(matrix[np.ix_(place, place)]) - np.diag(sigma**-2.0)
    weak = undetermined(names, images / (float(adjusted.sigma0) * factor) ** 2, sigma, loose)
    return Determined(
        tuple(name for name in names if name not in weak),
        [
            f"{name} of {camera_words(camera)} is observed where it starts, {float(prior.value):.6g} +- "
            f"{float(prior.sigma):.2g}: the images determine the corner of the format only to "
            f"{weak[name] / calibration.unit[name]:.1%} of its radius"
            for name, prior in zip(names, priors, strict=True)
            if name in weak
        ],
        factor,
    )


def correlation_factor(block: Block, residuals: Float[np.ndarray, "2 rows"]) -> float:
    """Return the square root of the design effect of the `residuals` of image rows, both axes together; at least 1."""
    rows, sensors = block.image_points, [block.sensors[camera] for camera in block.image_camera]
    half = np.array([(s.width_mm, s.height_mm) for s in sensors])[rows.image] / 2
    side = 2 * half.max(axis=1, keepdims=True) / _CELLS
    place = np.clip((np.asarray(rows.xy) + half) // side, 0, _CELLS - 1).astype(int)
    cell = (np.asarray(rows.image) * _CELLS + place[:, 0]) * _CELLS + place[:, 1]
    sums = np.stack([np.bincount(cell, v) for v in residuals])
    return float(np.sqrt(max(1.0, np.sum(sums**2) / np.sum(residuals**2))))


def shared_covariance(adjusted: Adjustment) -> np.ndarray:
    """Return the a priori covariance of the unknowns that images share, independent of the datum."""
    equations, n = adjusted.equations, adjusted.structure.n_shared
    scale = np.asarray(equations.scale.shared)
    inverse = np.asarray(call_compiled(_inverse, equations))[-n:, -n:]
    return inverse * np.outer(scale, scale)


@eqx.filter_jit
def _inverse(equations: NormalEquations) -> Float[Array, "reduced reduced"]:
    # Avoid statistics.covariance: with all points its compilation takes several times longer.
    return equations.inverse_of_reduced()


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
