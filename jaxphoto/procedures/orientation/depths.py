"""Points of two rays that lie where nothing else does.

A false match along an epipolar line makes a point of two rays that meet as well as those of a true one, at any depth.
What is near it in the image is not: over the places (x, y) of an image the inverse depth of a surface varies little,
and that of a plane is linear. So a point of two rays goes whose inverse depth is far from the median of its neighbours
in both of its images, in terms of their robust spread and of its own standard deviation. At an edge, or where things
stand before one another, neighbours spread as widely as the scene is deep, and everything stays.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.initial.rays import turn_to_object
from jaxphoto.procedures.orientation.network import Fate, Network, Sight

# Nearest points in the image, and by how many of their spreads a point may differ from their median.
_NEIGHBOURS, _LIMIT = 12, 8.0
# Distances that are computed at a time.
_AT_ONCE = 4_000_000
# The standard deviation of a normal distribution over its median absolute deviation.
_NORMAL = 1.4826


def supported(sight: Sight, network: Network) -> Network:
    """`network` without the points of two rays whose depths their neighbours in both images contradict."""
    rows = np.flatnonzero(network.used)
    point, image = sight.point[rows], sight.image[rows]
    axes = network.camera_from_object[image, 2]
    inverse = -1 / np.einsum("ni,ni->n", axes, network.points[point] - network.positions[image])
    sigma = inverse * _relative_sigma(sight, network, rows)
    two = np.bincount(point, minlength=len(network.points))[point] == 2
    far = np.zeros(len(rows), bool)
    for number in np.unique(image):
        own = np.flatnonzero(image == number)
        if len(own) > _NEIGHBOURS:
            far[own[two[own]]] = _far(sight.ideal[rows[own]], inverse[own], sigma[own], two[own])
    contradicted = np.bincount(point[far], minlength=len(network.points)) == 2
    fate = network.fate.copy()
    fate[rows[contradicted[point]]] = Fate.UNSUPPORTED
    return network._replace(fate=fate)


def _far(xy, inverse, sigma, tested: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " tested"]:
    """Which of the `tested` points of one image, at `xy` (n, 2) with `inverse` depths, their neighbours contradict."""
    near = np.concatenate(
        [_nearest(xy, some) for some in np.array_split(xy[tested], 1 + tested.sum() * len(xy) // _AT_ONCE)]
    )
    around = inverse[near]
    median = np.median(around, axis=1)
    spread = _NORMAL * np.median(np.abs(around - median[:, None]), axis=1)
    return np.abs(inverse[tested] - median) > _LIMIT * np.hypot(spread, sigma[tested])


def _nearest(xy: Float[np.ndarray, "n 2"], to: Float[np.ndarray, "m 2"]) -> Int[np.ndarray, "m neighbours"]:
    """The nearest of `xy` but one: each of `to` is its own neighbour."""
    apart = np.sum(xy**2, axis=1) - 2 * to @ xy.T
    order = np.argpartition(apart, _NEIGHBOURS, axis=1)[:, : _NEIGHBOURS + 1]
    itself = np.argmin(np.take_along_axis(apart, order, axis=1), axis=1)
    others = np.arange(_NEIGHBOURS + 1) != itself[:, None]
    return order[others].reshape(len(to), _NEIGHBOURS)


def _relative_sigma(sight: Sight, network: Network, rows: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Of the depths of points of two rays: the errors of both over the angle at which they meet."""
    point = sight.point[rows]
    direction = turn_to_object(network.camera_from_object, sight.image[rows], sight.ray[rows])
    total = np.stack([np.bincount(point, v, len(network.points)) for v in direction.T], axis=1)
    # Two unit vectors at an angle g add to one of length 2 cos(g / 2).
    half = np.arccos(np.clip(np.linalg.norm(total, axis=1) / 2, 0, 1))[point]
    return np.sqrt(2) * sight.sigma[rows] / np.sin(np.maximum(2 * half, 1e-9))
