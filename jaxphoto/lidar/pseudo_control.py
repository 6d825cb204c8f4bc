"""Pseudo control points: image features with heights from surrounding laser points.

For a feature at (x, y) in an image of known orientation (paper 001, equations (1)-(3); docs/lidar_heights.md):

1. Follow the ray downwards, cell by cell, to the first laser point at the height of the ray: the visible surface
   (`sight`).
2. Project the laser points around that position into the image. If they lie on two levels, as at a building, select the
   visible level. Repeat both at the new height, `_ROUNDS` times.
3. With d_i the distances in the image of the nearest points, compute Z = sum w_i Z_i, w_i = d_i^-p / sum d_j^-p.
4. Compute X and Y from the ray at that Z.

The choice of the nearest points has no derivative. Weights and ray are differentiable with respect to every parameter
of interior and exterior orientation.

Standard deviation. Let t = d(X, Y)/dZ of the ray, q_i the horizontal offset of a laser point from the ray *at the
height of the point*, and g the slope of the ground. Seen along the ray, the surface is

    Z = Z_0 + h . q,    h = g / (1 - g . t)

and the error of a laser point is (1 + h . t) e_Z - h . e_XY: as a function of q it is a surface of slope h, measured
with errors (1 + h . t) sigma_Z and sigma_XY. `heights` propagates these errors, and the bias of weights that do
not reproduce a slope. The result is the accuracy of the surface height at the intersection, without errors of the ray.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Integer

from jaxphoto.arrays import ArrayLike, as_jax_array, to_numpy
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation
from jaxphoto.cloud import Cloud
from jaxphoto.collinearity import ExteriorOrientation, camera_coordinates, image_ray, project, project_ideal
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import Corrections, apparent_point, ground_point
from jaxphoto.georeferencing.corrections import NO_CORRECTIONS
from jaxphoto.lidar.grid import Grid, around, index_cloud
from jaxphoto.lidar.heights import (
    HeightFlag,
    HeightSettings,
    LidarNoise,
    Neighbours,
    excess,
    fit_surface,
    height_sigma,
    inverse_distance_weights,
    noise_variance,
)
from jaxphoto.lidar.sight import Skyline, empty_about, first_met, levels, skyline, surrounded, window_reach
from jaxphoto.observations import ControlCoordinates
from jaxphoto.unknowns import Unknowns

# Ratio of candidates to points used: sufficient for a slope, even if half of them are hidden.
_CANDIDATES = 3
# Number of iterations. The first position has an error of half a cell; each iteration multiplies it by slope * run.
_ROUNDS = 5
# Ratio of residuals to the lidar's noise: quantile for one false alarm in 1000, and limit above which the points do not
# define a surface.
_HARDLY, _ROUGH = 3.09, 3.0
# Number of features processed at a time (fits the CPU cache); minimum batch size.
_AT_ONCE, _FEW = 512, 64


class PseudoControl(eqx.Module):
    """Intersections of feature rays with a cloud, one per feature; NaN where refused or undetermined."""

    xyz: Float[ArrayLike, "*n 3"]
    """X, Y, Z (m); X and Y are only as accurate as the orientation (docs/lidar_heights.md)."""
    sigma_z: Float[ArrayLike, "*n"]
    """Standard deviation of Z (m): 95 % of the errors are within 1.96 of it."""
    flag: Integer[ArrayLike, "*n"]
    """Bitwise sum of `HeightFlag`; HOLE also if a ray does not intersect the cloud."""
    gradient: Float[ArrayLike, "*n 2"]
    """Gradient of the surface (dZ/dX, dZ/dY)."""
    roughness: Float[ArrayLike, "*n"]
    """Standard deviation (m) of the laser points about the plane through them."""


class _Ray(NamedTuple):
    """Ray of a feature: (X, Y) = origin + run (Z - Z of the origin)."""

    origin: Float[Array, "3"]
    direction: Float[Array, "3"]

    @property
    def run(self) -> Float[Array, "2"]:
        """Return d(X, Y)/dZ."""
        return self.direction[:2] / jnp.where(self.direction[2] < 0, self.direction[2], -1.0)

    def at(self, z: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
        """Return X and Y (m) at heights."""
        return self.origin[:2] + self.run * (z - self.origin[2])[..., None]


def pseudo_control_points(
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    xy: Float[ArrayLike, "n 2"],
    cloud: Cloud | Grid,
    settings: HeightSettings | None = None,
    *,
    corrections: Corrections = NO_CORRECTIONS,
) -> PseudoControl:
    """Compute the pseudo control points of features measured at `xy` (mm) with one camera, in a cloud.

    Pass a `Grid` to avoid re-indexing the cloud. `exterior`: one image, or a leading axis over the features. The
    `settings.points` nearest laser points are weighted by d^-`settings.power` (paper 001). One compiled program is used
    for all features.

    `xyz` is differentiable with respect to `interior`, `exterior` and `xy`, exactly except where the set of nearest
    points changes; `sigma_z` and the other properties are not. Raises InputError for an empty `xy`. Source: paper 001,
    section 3.1.
    """
    settings = HeightSettings() if settings is None else settings
    grid, n = cloud if isinstance(cloud, Grid) else index_cloud(cloud), len(xy)
    if not n:
        raise InputError("no features: give one or more image coordinates")
    rows = np.arange(_room(n)) % n
    one = exterior.position.ndim == 1
    found = call_compiled(
        _pseudo_control, jax.tree.map(to_numpy, interior),
        jax.tree.map(lambda v: to_numpy(v) if one else to_numpy(v)[rows], exterior), to_numpy(xy)[rows], grid,
        skyline(grid), jax.tree.map(as_jax_array, settings), settings.points,
        window_reach(grid, _CANDIDATES * settings.points), corrections,
    )  # fmt: skip
    return jax.tree.map(lambda v: to_numpy(v)[:n], found)


@eqx.filter_jit
def _pseudo_control(
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    xy: Float[Array, "n 2"],
    grid: Grid,
    sky: Skyline,
    settings: Any,
    points: int,
    reach: int,
    corrections: Corrections,
) -> PseudoControl:
    """Compute the pseudo control points; `settings` are a `HeightSettings` of arrays: changes need no recompilation."""
    one = exterior.position.ndim == 1
    cloud, leafy = jnp.asarray(grid.xyz), jnp.asarray(grid.leafy)

    def choose(interior, exterior, xy):
        """Return the laser points around the ray of a feature (index, mask of seen ones, True near a step), nearest in
        the image first; and True if the ray intersects the cloud.
        """
        ideal = interior.ideal_from_measured(xy)
        ray = _Ray(*image_ray(interior, exterior, xy))
        place, intersected = first_met(ray.origin, ray.direction, sky, grid)

        def squared_distance(point):
            aim = apparent_point(exterior.position, point, corrections)
            offset = project_ideal(interior, exterior, aim) - ideal
            return jnp.where(interior.projection.sees(*camera_coordinates(exterior, aim)), offset @ offset, jnp.inf)

        def again(_, state):
            place, (_, _, broken) = state
            index, there = around(grid, place, reach)
            squared = jnp.where(there, jax.vmap(squared_distance)(cloud[index]), jnp.inf)
            nearness, first = jax.lax.top_k(-squared, min(_CANDIDATES * points, len(squared)))
            index, there = index[first], jnp.isfinite(nearness)
            z = cloud[index, 2]
            seen, near_step = levels(cloud[index, :2] - ray.at(z), z, there, ray.run, points, settings.sigma_z_m)
            near = seen & (jnp.cumsum(seen) <= points)
            mean = jnp.sum(jnp.where(near, z, 0)) / jnp.maximum(near.sum(), 1)
            # Keep `broken` of earlier iterations: the image may show a height discontinuity that the ray passes.
            return jnp.where(near.any(), ray.at(mean), place), (index, seen, near_step | broken)

        some = around(grid, place, reach)[0][: _CANDIDATES * points]
        none = some, jnp.zeros(len(some), bool), jnp.array(False)
        return *jax.lax.fori_loop(0, _ROUNDS, again, (place, none))[1], intersected

    def of_feature(data):
        image, at = (exterior, data) if one else data
        index, seen, broken, intersected = choose(*jax.lax.stop_gradient((interior, image, at)))
        xyz = cloud[index]
        ray = _Ray(*image_ray(interior, image, at))
        base = jnp.sum(jnp.where(seen, xyz[:, 2], 0)) / jnp.maximum(seen.sum(), 1)
        q = xyz[:, :2] - ray.at(xyz[:, 2])
        distance = jax.lax.stop_gradient(jnp.hypot(q[:, 0], q[:, 1]))
        around_ray = Neighbours(q, xyz[:, 2] - base, distance, seen)
        shown = jax.vmap(lambda p: project(interior, image, apparent_point(image.position, p, corrections)))(xyz)
        squared = jnp.sum((shown - at) ** 2, axis=1)
        distances = jax.lax.stop_gradient(jnp.where(seen, squared, jnp.inf))
        nearest = seen & (jnp.sum(distances < distances[:, None], axis=1) < points)
        weight = inverse_distance_weights(squared, nearest, settings.power)
        point, ahead = ground_point(interior, image, at, base + weight @ around_ray.z, corrections)

        lost = ~(intersected & ahead & seen.any())
        sigma, flag, gradient, roughness = jax.lax.stop_gradient(
            _described(around_ray, weight, ray, broken, settings, points)
        )
        fraction = jnp.sum(jnp.where(weight != 0, leafy[index], False)) / jnp.sum(weight != 0)
        flag |= ((fraction > 0) & (fraction >= settings.leafy_share)) * int(HeightFlag.VEGETATION)
        flag = jnp.where(lost, int(HeightFlag.HOLE), flag)
        refused = lost | (flag & settings.refuse.astype(int) != 0)
        point, sigma = (jnp.where(refused, jnp.nan, value) for value in (point, sigma))
        return PseudoControl(point, sigma, flag, gradient, roughness)

    data = xy if one else (exterior, xy)
    portions = jax.tree.map(lambda v: v.reshape(-1, min(_AT_ONCE, len(v)), *v.shape[1:]), data)
    results = jax.lax.map(jax.vmap(of_feature), portions)
    return jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), results)


def _described(
    near: Neighbours,
    weight: Float[Array, "m"],
    ray: _Ray,
    broken: Bool[Array, ""],
    settings: HeightSettings,
    points: int,
) -> tuple[Float[Array, ""], Int[Array, ""], Float[Array, "2"], Float[Array, ""]]:
    """Return standard deviation, flags, gradient and roughness."""
    fit = fit_surface(near, 1.0 * near.there, quadratic=False)
    slope = fit.coefficients[1:3]
    noise = LidarNoise(jnp.abs(1 + slope @ ray.run) * settings.sigma_z_m, settings.sigma_xy_m)
    expected = noise_variance(fit, noise)
    sigma = jnp.hypot(height_sigma(near, weight, fit, noise), settings.sigma_systematic_m)
    rough = (excess(fit, expected, _HARDLY) > 1) & (fit.variance > _ROUGH**2 * expected)
    hole = (near.there.sum() < points) | empty_about(near.distance, near.there)
    edge = ~surrounded(near.xy, near.there) | ~fit.interpolates
    flags = ((hole, HeightFlag.HOLE), (edge, HeightFlag.EDGE), (rough & ~broken, HeightFlag.VEGETATION))
    flag = sum((which * int(name) for which, name in flags), broken * int(HeightFlag.BREAKLINE))
    return sigma, flag, slope / (1 + slope @ ray.run), jnp.sqrt(fit.variance)


def _room(n: int) -> int:
    """Round up `n` to 64, or to multiples of `_AT_ONCE`: four sizes between two powers of two."""
    if n <= _FEW:
        return _FEW
    step = max(_AT_ONCE, 1 << n.bit_length() - 3)
    return -(-n // step) * step


# Pseudo control points of a whole block: heights for its measured image points.
#
# Each image that contains a point gives a height for it. These heights share laser points, so their mean is hardly more
# accurate than one of them. The image with the steepest ray is the best: an orientation error has the smallest effect
# on the position, and occlusions are rare.


class BlockControl(eqx.Module):
    """Pseudo control of a block, one entry per point."""

    point: Int[np.ndarray, "n"]
    """Indices of the block's points."""
    image: Int[np.ndarray, "n"]
    """Index of the image used for each point."""
    control: PseudoControl

    def rows(self) -> ControlCoordinates:
        """Return vertical control: Z and its standard deviation, for the determined points."""
        good = np.flatnonzero(np.isfinite(self.control.sigma_z))
        z, sigma = self.control.xyz[good, 2], self.control.sigma_z[good]
        return ControlCoordinates(self.point[good], np.full(len(good), 2), z, sigma)


def pseudo_control_of_block(
    block: Block,
    unknowns: Unknowns,
    grid: Grid,
    points: Int[np.ndarray, "chosen"] | None = None,
    settings: HeightSettings | None = None,
) -> BlockControl:
    """Compute heights from the cloud of `grid`, in the block's frame, for measured `points` (indices; default: all).

    Uses interior and exterior orientation of `unknowns`: repeat after they change. Of the images that determine the
    height of a point, the one with the steepest ray is used. Raises BlockError if no image measured any of the points.
    """
    rows = block.image_points
    chosen = np.isin(rows.point, points) if points is not None else np.ones(len(rows.point), bool)
    measured = np.flatnonzero(chosen)
    if not len(measured):
        raise BlockError("none of the points for pseudo control is measured in an image; choose others")
    image, point, xy = rows.image[measured], rows.point[measured], to_numpy(rows.xy)[measured]
    exterior = jax.tree.map(lambda v: to_numpy(v)[image], unknowns.exterior)
    camera = np.array(block.image_camera, object)[image]
    found: list[tuple[np.ndarray, PseudoControl, np.ndarray]] = []
    for name in dict.fromkeys(camera):
        of = np.flatnonzero(camera == name)
        one, taken = jax.tree.map(lambda v, of=of: v[of], exterior), xy[of]
        interior = jax.tree.map(to_numpy, unknowns.interior[name])
        control = pseudo_control_points(interior, one, taken, grid, settings, corrections=block.corrections)
        steep = call_compiled(_falls, interior, one, taken)
        found.append((of, jax.tree.map(np.asarray, control), np.asarray(steep)))
    back = np.argsort(np.concatenate([of for of, _, _ in found]))
    control = jax.tree.map(lambda *parts: np.concatenate(parts)[back], *(part for _, part, _ in found))
    fall = np.concatenate([steep for _, _, steep in found])[back]
    # Sort by point, valid before refused heights, steepest ray first; then take the first row of each point.
    order = np.lexsort((fall, np.isnan(control.sigma_z), point))
    first = order[np.unique(point[order], return_index=True)[1]]
    return BlockControl(point[first], image[first], jax.tree.map(lambda v: v[first], control))


@eqx.filter_jit
def _falls(interior, exterior: ExteriorOrientation, xy: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Return the third components of the rays; -1 is vertically down."""
    return jax.vmap(lambda image, at: image_ray(interior, image, at)[1][2])(exterior, xy)
