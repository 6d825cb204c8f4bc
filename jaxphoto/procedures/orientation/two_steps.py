"""One more image oriented by its pairs with images that are: first its rotation, then its position.

Each oriented image i that the new image k makes a pair with says R_ik M_i of k's rotation; the quaternions are
averaged. Each says, too, on which line through i the new image lies; the lines are intersected. Where they do not meet,
because all centres lie on one line, the scale along it is that of the points in common.

He and Habib (2014), "Linear approach for initial recovery of the exterior orientation parameters of randomly captured
images by low-cost mobile mapping systems".
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.initial.averaging import average_rotation, intersect_directions
from jaxphoto.procedures.orientation.network import Network, Sight
from jaxphoto.procedures.orientation.related_pairs import Pair

# A pair whose rotation is so far from the average of the others (rad) is a false one.
_FALSE = np.deg2rad(5.0)


class Placed(NamedTuple):
    """An orientation of one image, and how well its pairs agree on it."""

    position: Float[np.ndarray, "3"]
    camera_from_object: Float[np.ndarray, "3 3"]
    spread: float
    """Of the rotations that its pairs say (rad), over the root of the matches they rest on."""


def two_steps(image: int, pairs: Sequence[Pair], network: Network, sight: Sight) -> Placed | None:
    """The orientation of `image` by its pairs with oriented images; None where its position stays open."""
    others, rotations, origins, directions, weights = [], [], [], [], []
    for pair in pairs:
        if image not in (pair.first, pair.second):
            continue
        other = pair.second if image == pair.first else pair.first
        if network.oriented[other]:
            _, image_from_other, direction = pair.of(other)
            others.append(other)
            rotations.append(image_from_other @ network.camera_from_object[other])
            directions.append(network.camera_from_object[other].T @ direction)
            origins.append(network.positions[other])
            weights.append(float(pair.n))
    if not rotations:
        return None
    rotation, origin, direction, weight = (np.array(v) for v in (rotations, origins, directions, weights))
    # Those that agree with the one most agree with; of two orientations of a pair, the one that agrees better.
    alike = np.einsum("aij,bij->ab", rotation, rotation)
    near = alike > 1 + 2 * np.cos(_FALSE)
    chosen = int(np.argmax((near * alike) @ weight))
    by_likeness = np.argsort(-alike[chosen], kind="stable")
    best = by_likeness[np.unique(np.array(others)[by_likeness], return_index=True)[1]]
    best = best[near[chosen][best]]
    matrix, spread = average_rotation(rotation[best], weight[best])
    position = _position(image, matrix, origin[best], direction[best], weight[best], network, sight)
    return None if position is None else Placed(position, matrix, spread / np.sqrt(weight[best].sum()))


def _position(image, matrix, origins, directions, weights, network: Network, sight: Sight):
    """Where the lines meet; along the line of most matches, as the points in common say, where they do not."""
    if len(origins) > 1:
        found = intersect_directions(origins, directions, weights)
        if found is not None:
            return found.position
    rows = sight.of_image(image)
    rows = rows[network.met(sight)[sight.point[rows]]]
    if not len(rows):
        return None
    best = np.argmax(weights)
    ray = sight.ray[rows] @ matrix
    across = np.cross(ray, network.points[sight.point[rows]] - origins[best])
    moved = np.cross(ray, directions[best])
    scale, weight = np.sum(across * moved, axis=1), np.sum(moved**2, axis=1)
    # The median weighted by what a point has to say: many are false, and those near the line say nothing.
    scale = scale / np.maximum(weight, 1e-300)
    order = np.argsort(scale)
    middle = order[np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())]
    return origins[best] + scale[middle] * directions[best]
