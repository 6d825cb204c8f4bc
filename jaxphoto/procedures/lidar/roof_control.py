"""Roofs as additional control: tie points on planes of roof faces, and measured centroids as control points.

A roof face is a plane of many laser points. It constrains a tie point along its normal better than any single height,
and roof normals have many directions. The centroid of a roof constrains a point in X, Y and Z, if it was measured in
the images. Paper 004 cites both methods. Other tie points have heights as control as in `vertical_control`. These also
give the initial positions of the points, accurate enough to identify roofs.
"""

import dataclasses
from collections.abc import Callable, Collection

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError, InputError
from jaxphoto.lidar import HeightSettings
from jaxphoto.lidar.planes import Patch, planar_patches, plane_feet, roof_centroid
from jaxphoto.observations import ControlCoordinates, SurfaceRows
from jaxphoto.procedures.lidar.iterate_to_convergence import (
    MAX_ROUNDS,
    Round,
    SurfaceAtPoints,
    at_result,
    check_without_surfaces,
    iterate_to_convergence,
)
from jaxphoto.procedures.lidar.vertical_control import lidar_control, tie_points
from jaxphoto.statistics import Covariance

BUILDING = 6
"""LAS class of buildings."""
# Maximum distance (m) of laser points from the requested points for a search of their roofs.
_NEAR = 40.0
# Minimum number of laser points of a roof.
_LEAST = 20
# Maximum distance (m) of a point from its plane, for positions adjusted with heights as control.
_STOREY = 2.0


class RoofControl(eqx.Module):
    """Adjustment with roofs as control; arrays are over the tie points on roof faces."""

    block: Block
    """Block with the planes as `surfaces`, heights and centroids as control, and the adjusted unknowns as initial
    values.
    """
    adjusted: Adjustment
    points: Int[np.ndarray, "n"]
    """Index of each point in the block."""
    apart: Float[np.ndarray, "n"]
    """Height of each point above its plane (m)."""
    faces: int
    """Number of roof faces with a tie point."""
    rounds: tuple[Round, ...]
    converged: bool
    """True if the iteration converged."""


def roof_control(
    block: Block,
    cloud: Cloud,
    settings: HeightSettings | None = None,
    *,
    points: Collection[str] | None = None,
    centroids: Collection[str] = (),
    max_rounds: int = MAX_ROUNDS,
    report: Callable[[Round], None] = lambda made: None,
) -> RoofControl:
    """Adjust `block` with its tie points (or the named `points`) on roof faces of `cloud` constrained to their planes.

    All other tie points have control heights (`lidar_control`, by planes). Roofs are laser points of class 6; in a
    cloud without classes (or with 0 and 1 only) all points are searched, including level ground. Points named in
    `centroids` were measured at the centre of a roof face, and become control in X, Y and Z. The standard deviation of
    n points on one plane is sqrt(n) times the standard deviation of the plane there, which is common to them.
    """
    settings = HeightSettings() if settings is None else settings
    check_without_surfaces(block)
    which, middles = tie_points(block, points), tie_points(block, centroids) if centroids else np.zeros(0, int)
    which = np.setdiff1d(which, middles)
    heights = lidar_control(block, cloud, "plane", settings, max_rounds=max_rounds, report=report)
    first = heights.adjusted
    places = np.asarray(first.unknowns.points)
    patches = _patches(cloud, places[np.concatenate([which, middles])], settings)
    margin = 2 * settings.sigma_xy_m
    centres = _centroid_rows(block, middles, places, patches, cloud)
    # Remove the block's control, which comes first.
    of_heights = heights.block.control.take(np.arange(len(block.control.who), len(heights.block.control.who)))
    chosen = np.full(len(which), -1)

    def look(adjusted: Adjustment) -> SurfaceAtPoints:
        xyz = np.asarray(adjusted.unknowns.points)[which]
        chosen[:] = _faces(xyz[:, :2], patches, margin)
        if not (chosen >= 0).any() and not len(middles):
            raise BlockError(
                f"none of {len(which)} tie points lies on one of the cloud's {len(patches)} roof faces: measure "
                "points on roofs, or use heights for control (lidar_control)"
            )
        foot, normal, sigma = np.full((len(which), 3), np.nan), np.full((len(which), 3), np.nan), np.ones(len(which))
        for k in np.unique(chosen[chosen >= 0]):
            members = chosen == k
            foot[members], normal[members], of_plane = plane_feet(patches[k].plane, xyz[members])
            # The error of a plane is common to its points.
            sigma[members] = of_plane * np.sqrt(members.sum())
        # Exclude points in yards between the wings of a house, inside the outline of its roof.
        distance = np.einsum("nk,nk->n", normal, xyz - foot)
        chosen[~(np.abs(distance) < _STOREY)] = -1
        return SurfaceAtPoints(which, foot, normal, sigma, chosen >= 0)

    def build(adjusted: Adjustment, cov: Covariance, surface: SurfaceAtPoints, used: Bool[np.ndarray, "rows"]) -> Block:
        n, observed = int(used.sum()), np.concatenate([which[used], middles])
        others = of_heights.take(~np.isin(of_heights.who, observed))
        held = dataclasses.replace(block, control=ControlCoordinates.joined(block.control, centres, others))
        rows = SurfaceRows(
            which[used],
            np.zeros(n, int),
            surface.foot[used],
            surface.normal[used],
            np.zeros((n, 3)),
            surface.sigma[used],
        )
        return at_result(dataclasses.replace(held, surfaces=rows), adjusted.unknowns)

    result = iterate_to_convergence(first, look, build, max_rounds, report, "surfaces")
    return RoofControl(
        at_result(result.adjusted.block, result.adjusted.unknowns), result.adjusted, which[result.used],
        result.seen.apart(result.adjusted)[result.used], len(np.unique(chosen[result.used])), result.rounds,
        result.converged,
    )  # fmt: skip


def _patches(cloud: Cloud, places: Float[np.ndarray, "n 3"], settings: HeightSettings) -> list[Patch]:
    """Return roof faces near the positions `places`; `Patch.index` refers to the points of `cloud`."""
    classified = cloud.classification is not None and bool(np.any(cloud.classification > 1))
    roofs = np.flatnonzero(cloud.classification == BUILDING) if classified else np.arange(len(cloud))
    if len(roofs):
        away, _ = scipy.spatial.KDTree(places[:, :2]).query(cloud.xyz[roofs, :2], distance_upper_bound=_NEAR)
        roofs = roofs[np.isfinite(away)]
    if len(roofs) < _LEAST:
        raise BlockError(
            f"within {_NEAR:g} m of the points the cloud has {len(roofs)} laser points of roofs (class {BUILDING}): "
            "classify the cloud, or use heights for control (lidar_control)"
        )
    patches = planar_patches(cloud.xyz[roofs], settings.sigma_xy_m, settings.sigma_z_m, _LEAST)
    return [eqx.tree_at(lambda p: p.index, patch, roofs[patch.index]) for patch in patches]


def _faces(xy: Float[np.ndarray, "n 2"], patches: list[Patch], margin: float) -> Int[np.ndarray, "n"]:
    """Return the patch that contains each position, at least `margin` (m) inside its outline; -1 for none."""
    face = np.full(len(xy), -1)
    for k, patch in reversed(list(enumerate(patches))):
        corners = patch.outline[:, :2]
        along = np.roll(corners, -1, axis=0) - corners
        inward = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
        inside = np.einsum("nek,ek->ne", xy[:, None] - corners, inward).min(axis=1)
        face[inside >= margin] = k
    return face


def _centroid_rows(
    block: Block, points: Int[np.ndarray, "n"], places: Float[np.ndarray, "all 3"], patches: list[Patch], cloud: Cloud
) -> ControlCoordinates:
    """Return control in X, Y and Z of points at the centre of roof faces."""
    parts = [ControlCoordinates.none()]
    for point, face in zip(points, _faces(places[points, :2], patches, 0.0), strict=True):
        if point in block.control.who:
            raise InputError(f"point {block.points[point]} is already control: omit it from the centroids")
        if face < 0:
            raise BlockError(
                f"point {block.points[point]} is to be the centroid of a roof, but the cloud has no roof face at X "
                f"{places[point, 0]:.1f} m, Y {places[point, 1]:.1f} m: omit it"
            )
        centre, covariance = roof_centroid(cloud.xyz[patches[face].index])
        parts.append(ControlCoordinates(np.full(3, point), np.arange(3), centre, np.sqrt(np.diagonal(covariance))))
    return ControlCoordinates.joined(*parts)
