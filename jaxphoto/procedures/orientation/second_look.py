"""All matches tested again, once images and camera are known: against the epipolar lines of the network itself."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation
from jaxphoto.initial.coplanarity import RayPairs, behind, essential, misclosures
from jaxphoto.initial.matches import PairMatches
from jaxphoto.initial.rays import ideal_coordinates, unit_rays
from jaxphoto.procedures.orientation.network import Network


class SecondLook(NamedTuple):
    """Matches that agree with a network, and how many others there are."""

    matches: tuple[PairMatches, ...]
    off_epipolar: int
    """Off the epipolar line, or behind an image."""
    unoriented: int
    """Of pairs in which an image is not oriented."""


def second_look(
    network: Network,
    interior: InteriorOrientation,
    features: Sequence[Float[np.ndarray, "_ 2"]],
    matches: Sequence[PairMatches],
    sigma_mm: float,
    limit: float,
) -> SecondLook:
    """The `matches` whose misclosure of the coplanarity condition is within `limit` standard deviations.

    `features` (mm) are by image, of standard deviation `sigma_mm`.
    """
    c = float(interior.c)
    rays = [unit_rays(c, ideal_coordinates(interior, xy)) for xy in features]
    kept: list[PairMatches] = []
    off = unoriented = 0
    for match in matches:
        i, j = match.first, match.second
        if not (network.oriented[i] and network.oriented[j]):
            unoriented += len(match.features)
            continue
        base = network.camera_from_object[i] @ (network.positions[j] - network.positions[i])
        base = base / np.linalg.norm(base)
        rotation = network.camera_from_object[j] @ network.camera_from_object[i].T
        pairs = RayPairs.of(rays[i][match.features[:, 0]], rays[j][match.features[:, 1]], sigma_mm / c)
        good = np.abs(misclosures(essential(rotation, base)[None], pairs)[0]) <= limit
        good &= ~behind(rotation[None], base[None], pairs, limit)[0]
        off += int((~good).sum())
        kept.append(match._replace(features=match.features[good]))
    return SecondLook(tuple(kept), off, unoriented)
