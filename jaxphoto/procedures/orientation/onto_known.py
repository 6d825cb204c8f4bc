"""The similarity that brings a network in a frame of its own to points and stations that are known."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Block
from jaxphoto.errors import BlockError
from jaxphoto.procedures.orientation.network import Network

# Known places whose spread across their line is less than this part of that along it leave a turn about it open.
_LINE = 1e-3


class Similarity(NamedTuple):
    """X in one frame is `shift + scale * turn @ x` of x in another."""

    shift: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3 3"]
    scale: float


def similarity_between(there: Float[np.ndarray, "n 3"], here: Float[np.ndarray, "n 3"]) -> Similarity | None:
    """The similarity that takes `there` nearest to `here` (least squares); None where they leave one open.

    Umeyama (1991), "Least-squares estimation of transformation parameters between two point patterns". Three places
    that do not lie on a line are needed.
    """
    if len(here) < 3:
        return None
    a, b = there - there.mean(axis=0), here - here.mean(axis=0)
    for spread in (np.linalg.svd(v, compute_uv=False) for v in (a, b)):
        if not spread[1] > _LINE * spread[0]:
            return None
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = (u * sign) @ vt
    scale = float(np.sum(d * sign) / np.sum(a * a))
    return Similarity(here.mean(axis=0) - scale * turn @ there.mean(axis=0), turn, scale)


def onto_known(block: Block, network: Network) -> Network:
    """`network` in the frame of the known points and camera stations of `block`; as it is where there is none.

    Raises BlockError where there are some, but fewer than three, or on a line: they leave the frame open.
    """
    met = np.isfinite(network.points).all(axis=1)
    points = np.flatnonzero(np.asarray(block.start.point_known) & met)
    station = np.full((len(block.images), 3), np.nan)
    station[np.asarray(block.stations.who), np.asarray(block.stations.axis)] = np.asarray(block.stations.value, float)
    images = np.flatnonzero(np.isfinite(station).all(axis=1) & network.oriented)
    if not len(points) + len(images):
        return network
    there = np.concatenate([network.points[points], network.positions[images]])
    here = np.concatenate([np.asarray(block.start.unknowns.points, float)[points], station[images]])
    found = similarity_between(there, here)
    if found is None:
        raise BlockError(
            f"the images are oriented to one another, but the {len(here)} known points and stations that they see are "
            "fewer than three or lie on a line, which leaves the frame open: measure more known points, or give "
            "approximate X_m, Y_m, Z_m, omega_deg, phi_deg, kappa_deg in images.csv"
        )
    move = lambda x: found.shift + found.scale * x @ found.turn.T  # noqa: E731
    return network._replace(
        positions=move(network.positions),
        camera_from_object=network.camera_from_object @ found.turn.T,
        points=move(network.points),
    )
