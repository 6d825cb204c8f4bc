"""The end of an orientation: all parameters estimated, gross errors left out in rounds, and what the camera needs.

Which parameters of the interior orientation the images can tell follows from one adjustment of all of them. Those are
held, one after the other, that would move the corner of the format by an unknown amount; each time the rest is what it
would be with that one held (a conditional normal distribution). What the images tell stays free even where it hardly
differs from its start: held two of its standard deviations from the truth, it would bend a strip by many of theirs.

Rays beside one another in an image err alike where the lens, a rolling shutter or the features do what no model says.
Standard deviations that take them for independent are too small by the root of the design effect (Kish),

    d = sum over cells (sum over the rays of a cell v)^2 / sum over all rays v^2,

1 for independent residuals v, and the number of rays in a cell for such as are the same in it.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.band import invert_band
from jaxphoto.block import Block
from jaxphoto.camera import get_parameter, set_parameter
from jaxphoto.compiling import call_compiled
from jaxphoto.procedures.orientation.network import Network, meet, normalised_misfits, robust_scale, sight_of
from jaxphoto.procedures.orientation.pairs import Report
from jaxphoto.procedures.orientation.refine import Calibration, Names, refined

# Gross errors are beyond so many robust standard deviations, and never within the second, in a priori ones.
_LIMIT, _LEAST_LIMIT = 4.0, 1.0
# Rounds end where less than this part of the image points, or so few of them, change sides; before the last adjustment
# they need not come to that.
_STILL, _FEW = 1e-3, 2
ROUNDS, LAST_ROUNDS = 6, 20
# The images tell a parameter that leaves the corner of the format open by less than the first part of the radius, or
# is so many standard deviations from its start; none that leaves it open by more than the second. A principal distance
# is told up to the second: what is known of one beforehand is often no better.
_COUNTS = 3.0
_TOLD, _LOST = 0.02, 0.1
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
    calibration: Calibration,
    names: Names,
    angle: float,
    least: int,
    report: Report = lambda text: None,
    rounds: int = ROUNDS,
) -> Finished:
    """`network` adjusted, `names` estimated, in turn with its points met anew until hardly any image point changes.

    Rays make a point at `angle` (rad) or more; an image that sees fewer than `least` points goes. After `rounds` it
    ends in any case; `settled` says whether it had to.
    """
    lost: dict[int, str] = {}
    settled = False
    for number in range(1, rounds + 1):
        report(f"adjusting {int(network.oriented.sum())} images, round {number}")
        network, adjusted = refined(block, network, calibration, names, final=True)
        sight, before = sight_of(block, network.interior), network.fate
        limit = max(_LEAST_LIMIT, _LIMIT * robust_scale(normalised_misfits(sight, network)))
        network = meet(sight, network, limit, angle)
        seen = np.bincount(sight.image[network.used], minlength=len(network.oriented))
        few = np.flatnonzero(network.oriented & (seen < least))
        for image in few.tolist():
            lost[image] = f"only {seen[image]} of its points fit, and {least} are needed"
            network = network.without_image(image)
        if len(few):
            network = meet(sight, network, limit, angle)
        elif np.sum(before != network.fate) <= max(_FEW, _STILL * len(before)):
            settled = True
            break
    network, adjusted = refined(block, network, calibration, names, final=True)
    return Finished(network, adjusted, limit, number, settled, lost)


class Told(NamedTuple):
    """The parameters of cameras that images tell."""

    names: Names
    held: list[str]
    """Why others are held, a sentence each."""
    alike: float
    """By what their standard deviations are larger than they were if all rays erred independently."""


def told(block: Block, adjusted: Adjustment, calibration: Calibration) -> Told:
    """The parameters of `calibration` that the images of `block` tell."""
    alike = erring_alike(adjusted.block, np.asarray(adjusted.residuals.image))
    matrix, labels = _shared_covariance(adjusted) * alike**2, adjusted.structure.labels
    kept: Names = {}
    held: list[str] = []
    for camera, names in calibration.names.items():
        place = [labels.index(f"interior[{camera}].{name}") for name in names]
        now, then = (u.interior[camera] for u in (adjusted.unknowns, block.start.unknowns))
        moved = np.array([float(get_parameter(now, n)) - float(get_parameter(then, n)) for n in names])
        unit = np.array([calibration.unit[camera][n] for n in names])
        left, why = _eliminate(names, moved, matrix[np.ix_(place, place)], unit)
        kept[camera] = left
        held += [f"{name} of camera {camera} is held: {reason}" for name, reason in why.items()]
    return Told(kept, held, alike)


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
    """A posteriori covariance of the unknowns that images share; no datum changes it, so its constraints stay in."""
    factored, n = adjusted.computed.factored, adjusted.structure.n_shared
    scale = np.asarray(factored.scale.shared)
    inverse = np.asarray(call_compiled(_inverse, factored.factor))[-n:, -n:]
    return inverse * np.outer(scale, scale) * float(adjusted.sigma0) ** 2


# All of statistics.covariance, points and all, would take several times longer to compile.
_inverse = eqx.filter_jit(invert_band)


def _eliminate(names: tuple[str, ...], moved: np.ndarray, matrix: np.ndarray, unit: np.ndarray):
    """Names that are left, and by name why the others are not.

    `moved` are the values from their starts, `matrix` is their covariance.
    """
    left, why = list(range(len(names))), {}
    while left:
        sigma = np.sqrt(np.diagonal(matrix))
        at_corner, ratio = sigma / unit[left], np.abs(moved) / sigma
        told_by = np.array([_LOST if names[k] == "c_mm" else _TOLD for k in left])
        open_ = (at_corner > _LOST) | ((at_corner > told_by) & (ratio < _COUNTS))
        if not open_.any():
            break
        out = int(np.argmax(np.where(open_, at_corner, 0.0)))
        why[names[left[out]]] = f"the images leave the corner of the format open by {at_corner[out]:.1%} of its radius"
        rest = [k for k in range(len(left)) if k != out]
        gain = matrix[rest, out] / matrix[out, out]
        moved = moved[rest] - gain * moved[out]
        matrix = matrix[np.ix_(rest, rest)] - np.outer(gain, matrix[out, rest])
        left.pop(out)
    return tuple(names[k] for k in left), why


def with_held(block: Block, network: Network, calibration: Calibration, names: Names) -> Network:
    """`network` with the parameters of `calibration` that are not in `names` as the block starts them."""
    interiors = dict(network.interior)
    for camera, all_names in calibration.names.items():
        for name in set(all_names) - set(names[camera]):
            value = get_parameter(block.start.unknowns.interior[camera], name)
            interiors[camera] = set_parameter(interiors[camera], name, np.asarray(value, float))
    return network._replace(interior=interiors)
