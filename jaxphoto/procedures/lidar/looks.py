"""Looks of a scanner: forward and backward returns of a strip.

A line scanner sees a place once per strip. A circular scanner sees it ahead and, seconds later, behind: at other
angles, at another time of the trajectory. Planes from the two looks of one strip are compared like those of two strips.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.cloud import Cloud
from jaxphoto.georeferencing import Pattern
from jaxphoto.lidar.correction import PORTION, ScannerPath, scanner_poses


class Look(NamedTuple):
    """Returns of one strip."""

    strip: int
    name: str
    returns: Int[np.ndarray, "n"]
    """Indices in the cloud."""


def looks_of(cloud: Cloud, path: ScannerPath | None, pattern: Pattern) -> list[Look]:
    """Return one look per strip; for a circular scanner two, "1 ahead" and "1 behind" of strip 1."""
    looks = []
    for k, name in enumerate(cloud.strips):
        own = np.flatnonzero(cloud.strip == k)
        if pattern == "line" or path is None:
            looks.append(Look(k, name, own))
            continue
        ahead = aside(cloud, own, path)[:, 1] > 0
        sides = (f"{name} ahead", own[ahead]), (f"{name} behind", own[~ahead])
        looks += [Look(k, side, returns) for side, returns in sides if len(returns)]
    return looks


def aside(cloud: Cloud, which: Int[np.ndarray, "n"], path: ScannerPath) -> Float[np.ndarray, "n 2"]:
    """Return tangents of the angles of returns to the right and ahead, from the body's nadir."""
    parts = [np.zeros((0, 2))]
    for first in range(0, len(which), PORTION):
        own = which[first : first + PORTION]
        poses = scanner_poses(path, cloud.time[own])  # type: ignore[index]
        shot = np.einsum("nji,nj->ni", poses.object_from_body, cloud.xyz[own] - poses.position)
        parts.append(shot[:, :2] / np.maximum(-shot[:, 2:], 1e-9))
    return np.concatenate(parts)
