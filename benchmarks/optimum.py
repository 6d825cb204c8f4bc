"""The optimum of a block to rounding, and differences of its unknowns in standard deviations."""

from collections.abc import Sequence

import numpy as np

from jaxphoto import Adjustment, Block, Unknowns, adjust, covariance
from jaxphoto.adjustment import MINIMAL_SIZES, PaddedSizes
from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.parameters import numbers_of

Values = dict[str, np.ndarray]
# Iterations from the result, each by `adjust`: until no unknown moves by more (in sigma), or by no less than before.
_RESOLVED, _RESOLVES = 1e-11, 6


def optimum(block: Block, start: Unknowns | None = None, priors: Unknowns | None = None,
            sizes: PaddedSizes = MINIMAL_SIZES, sigma: Values | None = None) -> Adjustment:  # fmt: skip
    """Return the adjustment of `block`, iterated beyond the solver's tolerance by further calls from its result."""
    found, last = adjust(block, start, priors, sizes=sizes), np.inf
    if not bool(found.converged):
        raise RuntimeError(found.outcome.value)
    sigma = sigma or sigmas_of(covariance(found, "camera"))
    for _ in range(_RESOLVES):
        before, found = found, adjust(found.block, found.unknowns, found.priors, sizes=sizes)
        moved = max(worst(*pair) for pair in differences(unknowns_of(found), unknowns_of(before), sigma).values())
        if moved < _RESOLVED or moved > last / 2:
            break
        last = moved
    return found


def parameters_of(unknowns: Unknowns) -> dict[str, float]:
    """Return the shared parameters by label, fixed ones included."""
    found = {f"interior[{camera}].{name}": get_parameter(own, name)
             for camera, own in unknowns.interior.items() for name in parameter_names(own)}  # fmt: skip
    for owners in unknowns.tables.values():
        for owner, own in owners.items():
            found |= zip(own.labels(owner), numbers_of(own), strict=True)
    return found


def unknowns_of(adjusted: Adjustment, labels: Sequence[str] | None = None) -> Values:
    """Return the free shared parameters in the order of `labels`, and orientations and points in the block's order.

    Where `labels` is None, shared parameters are in the adjustment's own order.
    """
    u, n = adjusted.unknowns, len(adjusted.block.images)
    shared = parameters_of(u)
    labels = adjusted.structure.labels if labels is None else labels
    return {
        "shared": np.array([float(shared[label]) for label in labels]),
        "position": np.asarray(u.exterior.position),
        "rotation": np.asarray(u.exterior.camera_from_object).reshape(n, 9),
        "points": np.asarray(u.points),
    }


def sigmas_of(known) -> Values:
    """Return the a posteriori standard deviations of `unknowns_of`, rotations about the axes of the camera."""
    exterior = np.asarray(known.exterior_sigma)
    return {"shared": np.asarray(known.shared_sigma), "position": exterior[:, :3], "rotation": exterior[:, 3:],
            "points": np.asarray(known.point_sigma)}  # fmt: skip


def differences(now: Values, then: Values, sigma: Values) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return differences of unknowns beside their standard deviations; rotations about the axes of the camera."""
    found = {}
    for name, value in now.items():
        off = value - then[name]
        if name == "rotation":
            turn = np.einsum("nij,nkj->nik", value.reshape(-1, 3, 3), then[name].reshape(-1, 3, 3))
            off = np.stack([turn[:, k - 1, k - 2] - turn[:, k - 2, k - 1] for k in range(3)], axis=1) / 2
        found[name] = off, sigma[name]
    return found


def worst(off: np.ndarray, unit: np.ndarray) -> float:
    """Return the largest difference in its unit, infinite if NaN; without those whose unit is 0 (fixed unknowns)."""
    known = unit > 0
    found = np.abs(off[known]) / unit[known]
    return float(np.max(np.where(np.isnan(found), np.inf, found), initial=0.0))
