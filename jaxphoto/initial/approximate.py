"""Approximate values of a whole block by alternating resection and intersection.

1. Orient images with observed position and attitude directly.
2. Intersect points that have enough rays from oriented images.
3. Resect images that see at least four known points, those with the most first; then repeat from 2. Use points with an
   intersection angle of at least 1 degree first, then smaller angles.

If all approximate values are given, only check that every point lies in front of its cameras.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block, Start, direct_exterior, sensor_rows
from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import BlockError, InputError, counted
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.initial.rays import camera_rays, directions_of, ideal_coordinates, turn_to_object
from jaxphoto.initial.resection import resect_ideal
from jaxphoto.small_matrices import cholesky_3x3, unwhiten, whiten
from jaxphoto.unknowns import Unknowns

_RESECTED = 4  # minimum number of known points
_ANGLES = np.deg2rad([1.0, 0.02])  # minimum intersection angles: desired, acceptable
# Maximum fraction of points behind a camera that are treated as blunders; above it, the frame is wrong.
_BLUNDERS = 0.05
# Weight of a surveyed coordinate relative to a ray.
_SURVEYED = 100.0
_CURE = "give their X_m, Y_m, Z_m, omega_deg, phi_deg, kappa_deg in images.csv, or measure more control points in them"


class PointsBehind(BlockError):
    """Points lie behind cameras that measured them: approximate orientations or points are wrong."""


def approximate(block: Block) -> Unknowns:
    """Complete `block.start`: orient every unknown image and intersect every unknown point.

    Images are oriented by their observed positions and attitudes, or resected from known points. Known values of
    `block.start` are not changed.

    Raises BlockError for images that see fewer than four known points, points with nearly parallel rays, and points
    behind a camera that measured them.
    """
    state = _State(block)
    state.complete()
    state.check()
    return state.start().unknowns


def completed(block: Block) -> Start:
    """Complete `block.start` as far as possible: images and points that cannot be computed stay unknown."""
    state = _State(block)
    state.complete()
    return state.start()


def intersected(block: Block) -> Unknowns:
    """Complete `block.start` inside a JAX transformation, without resection and checks of values.

    Points minimise the weighted sum of squared distances from their rays and control coordinates. Raises InputError for
    an image without orientation and without observed position and attitude.
    """
    start, image, point = block.start.unknowns, *map(np.asarray, (block.image_points.image, block.image_points.point))
    sensors, known = sensor_rows(block, start), np.array(block.start.image_known)
    new = ~known[sensors.image]
    direct = sensors.image[new]
    known[direct] = True
    if not known.all():
        raise InputError(
            "no image is resected inside a JAX transformation, and images have no approximate orientation "
            f"({_few(block.images, np.flatnonzero(~known))}): compute it outside, start = "
            "jaxphoto.adjust(block).unknowns, and give adjust(block, start)"
        )
    exterior = start.exterior
    if len(direct):
        observed = direct_exterior(sensors)
        exterior = jax.tree.map(lambda old, v: jnp.asarray(old).at[direct].set(v[new]), exterior, observed)
    rays = jnp.zeros((len(image), 3))
    for name, interior in start.interior.items():
        rows = np.flatnonzero(_of_camera(block, name)[image])
        rays = rays.at[rows].set(directions_of(interior, block.image_points.xy[rows]))
    along = jnp.einsum("nij,ni->nj", exterior.camera_from_object[image], rays)
    across = jnp.eye(3) - along[:, :, None] * along[:, None] / jnp.sum(along**2, axis=1)[:, None, None]
    normal = jnp.zeros((len(block.points), 3, 3)).at[point].add(across)
    right = jnp.zeros((len(block.points), 3)).at[point].add(jnp.einsum("nij,nj->ni", across, exterior.position[image]))
    for table in (block.control, block.fixed):
        normal = normal.at[table.who, table.axis, table.axis].add(_SURVEYED)
        right = right.at[table.who, table.axis].add(_SURVEYED * table.value)
    factor = cholesky_3x3(jnp.moveaxis(normal, 0, -1))
    points = jnp.stack(unwhiten(whiten(right.T, factor), factor), axis=1)
    return dataclasses.replace(start, exterior=exterior, points=points)


def in_front(block: Block, unknowns: Unknowns) -> Bool[np.ndarray, "rows"]:
    """Return True for rows of `block.image_points` whose point is in front of its camera under `unknowns`."""
    u = unknowns
    return _in_front(block, u.interior, *map(to_numpy, (u.exterior.position, u.exterior.camera_from_object, u.points)))


def looking_away(block: Block, seen: Bool[np.ndarray, "rows"]) -> Int[np.ndarray, "some_images"]:
    """Return the images with more than half of their points behind them; `seen` is the result of `in_front`.

    Collinearity does not distinguish front from back: an image that views the scene from the opposite side fits as
    well.
    """
    image, n = np.asarray(block.image_points.image), len(block.images)
    return np.flatnonzero(np.bincount(image[~seen], minlength=n) > np.bincount(image, minlength=n) / 2)


class _State:
    """Values known so far, updated in place."""

    def __init__(self, block: Block) -> None:
        start = block.start.unknowns
        self.block = block
        self.image, self.point = np.asarray(block.image_points.image), np.asarray(block.image_points.point)
        self.positions = np.array(start.exterior.position, float).reshape(-1, 3)
        self.matrices = np.array(start.exterior.camera_from_object, float).reshape(-1, 3, 3)
        self.points = np.array(start.points, float).reshape(-1, 3)
        self.image_known = np.array(block.start.image_known, bool)
        self.point_known = np.array(block.start.point_known, bool)
        self.resection_error: BlockError | None = None
        self.resected = False

    def complete(self) -> None:
        if self.image_known.all() and self.point_known.all():
            return
        given = self.point_known.copy()
        self._orient_directly()
        self._compute_rays()
        for min_angle in _ANGLES:
            while True:
                self._intersect(~self.point_known, min_angle)
                if not self._resect_best():
                    break
        if self.resected:
            # Re-intersect with all rays: the first points were intersected from few images.
            self._intersect(~given, _ANGLES[-1])
        self._bring_in_front(given)

    def start(self) -> Start:
        start = self.block.start
        if start.image_known.all() and start.point_known.all():
            return start
        places = lambda u: (u.exterior.position, u.exterior.camera_from_object, u.points)  # noqa: E731
        values = jax.device_put((self.positions, self.matrices, self.points))
        return Start(eqx.tree_at(places, start.unknowns, values), self.image_known, self.point_known)

    def check(self) -> None:
        """Raise BlockError if an image or a point is unknown, or a point lies behind a camera."""
        block = self.block
        if not self.image_known.all():
            left = np.flatnonzero(~self.image_known)
            seen = np.bincount(self.image[self.point_known[self.point]], minlength=len(self.image_known))
            if self.resection_error is not None and seen[left].max() >= _RESECTED:
                raise self.resection_error
            raise BlockError(
                f"{len(left)} of {len(self.image_known)} images have no approximate orientation and see fewer than 4 "
                f"known points, so they cannot be resected ({_few(block.images, left)}): {_CURE}"
            )
        if not self.point_known.all():
            first, *others = np.flatnonzero(~self.point_known)
            rays = np.bincount(self.point, minlength=len(self.points))[first]
            more = f"; {len(others)} more points likewise ({_few(block.points, others)})" if others else ""
            if rays < 2:
                raise BlockError(
                    f"point {block.points[first]} is measured in {rays} image(s) and has no known coordinates, so it "
                    f"has no position{more}: measure it in a second image, give its coordinates, or remove it"
                )
            raise BlockError(
                f"the rays of point {block.points[first]} from {rays} images are nearly parallel and have no "
                f"intersection{more}: measure it from another position, give its coordinates, or remove it"
            )
        interior = block.start.unknowns.interior
        bad = np.flatnonzero(~_in_front(block, interior, self.positions, self.matrices, self.points))
        if len(bad):
            image, point = self.image[bad[0]], self.point[bad[0]]
            surveyed = np.concatenate([block.control.who, block.fixed.who])
            if np.isin(self.point[bad], surveyed).all() and not np.isin(self.point, surveyed).all():
                raise PointsBehind(
                    f"{counted(len(np.unique(self.point[bad])), 'control point')} and no other point lie behind the "
                    f"images that measured them, such as {block.points[point]} and {block.images[image]}: check their "
                    "coordinates, the units and the height reference"
                )
            raise PointsBehind(
                f"point {block.points[point]} lies behind image {block.images[image]}, which measured it ({len(bad)} "
                f"of {len(self.image)} such image points): check the approximate angles and their units, the "
                "position of the image, the unit of its image coordinates, and the frame of the point"
            )

    def _orient_directly(self) -> None:
        """Orient images by step 1: X = GNSS - R l - shift - drift t, attitude through the boresight."""
        rows = sensor_rows(self.block, self.block.start.unknowns)
        new = ~self.image_known[rows.image]
        if new.any():
            exterior, images = direct_exterior(rows), rows.image[new]
            self.positions[images] = np.asarray(exterior.position)[new]
            self.matrices[images] = np.asarray(exterior.camera_from_object)[new]
            self.image_known[images] = True

    def _compute_rays(self) -> None:
        """Compute ideal coordinates and camera rays of all rows."""
        xy = np.asarray(self.block.image_points.xy, float)
        self.ideal, self.rays = np.zeros_like(xy), np.zeros((len(xy), 3))
        for name, interior in self.block.start.unknowns.interior.items():
            rows = _of_camera(self.block, name)[self.image]
            if rows.any():
                self.ideal[rows], self.rays[rows] = (f(interior, xy[rows]) for f in (ideal_coordinates, camera_rays))

    def _intersect(self, wanted, min_angle: float) -> None:
        """Intersect the `wanted` points (step 2)."""
        if not wanted.any():
            return
        rows = np.flatnonzero(self.image_known[self.image] & wanted[self.point])
        image, point = self.image[rows], self.point[rows]
        directions = turn_to_object(self.matrices, image, self.rays[rows])
        tables = []
        for table in (self.block.control, self.block.fixed):
            use = wanted[np.asarray(table.who, int)]
            tables.append([np.asarray(v)[use] for v in (table.who, table.axis, table.value)])
        who, axis, value = (np.concatenate(parts) for parts in zip(*tables, strict=True))
        points, good = intersect_points(
            self.positions[image], directions, point, len(self.points), (who, axis, value), min_angle
        )
        who, axis, value = tables[1]
        points[who, axis] = value
        good &= wanted
        self.points[good], self.point_known[good] = points[good], True

    def _resect_best(self) -> bool:
        """Resect images with at least half as many known points as the best (step 3); return True if any succeeded."""
        # For a fisheye use only rays that intersect the perspective plane.
        useful = self.point_known[self.point] & ~self.image_known[self.image] & np.isfinite(self.ideal).all(axis=1)
        count = np.bincount(self.image[useful], minlength=len(self.image_known))
        progress = False
        for i in np.argsort(-count, kind="stable"):
            if count[i] < max(_RESECTED, count.max() / 2) and (progress or count[i] < _RESECTED):
                break
            rows = np.flatnonzero(useful & (self.image == i))
            interior, name = self.block.start.unknowns.interior[self.block.image_camera[i]], self.block.images[i]
            try:
                exterior = resect_ideal(float(interior.c), self.ideal[rows], self.points[self.point[rows]], name)
            except BlockError as error:
                self.resection_error = error
                continue
            self.positions[i], self.matrices[i] = exterior.position, exterior.camera_from_object
            self.image_known[i] = self.resected = progress = True
        return progress

    def _bring_in_front(self, given) -> None:
        """Move points behind a camera that measured them (blunders) to the typical depth of its other points.

        After adjustment from there, the residuals identify the erroneous ray.
        """
        known = self.image_known[self.image] & self.point_known[self.point]
        interior = self.block.start.unknowns.interior
        seen = _in_front(self.block, interior, self.positions, self.matrices, self.points)
        bad = np.unique(self.point[known & ~seen])
        bad = bad[~given[bad]]
        if not len(bad) or len(bad) > max(1, _BLUNDERS * len(self.points)):
            return
        wrong = known & np.isin(self.point, bad)
        depth = np.linalg.norm(self.points[self.point] - self.positions[self.image], axis=1)
        usual = np.full(len(self.positions), np.median(depth[known & seen]))
        for i in np.unique(self.image[wrong]):
            if (others := known & ~wrong & (self.image == i)).any():
                usual[i] = np.median(depth[others])
        image, point = self.image[wrong], self.point[wrong]
        along = turn_to_object(self.matrices, image, self.rays[wrong])
        ends = self.positions[image] + usual[image, None] * along / np.linalg.norm(along, axis=1, keepdims=True)
        for p in bad:
            self.points[p] = ends[point == p].mean(axis=0)


def _in_front(
    block: Block, interior: dict[str, InteriorOrientation], positions, matrices, points
) -> Bool[np.ndarray, "rows"]:
    image, point = np.asarray(block.image_points.image), np.asarray(block.image_points.point)
    to_point = points.take(point, 0) - positions.take(image, 0)
    in_front = np.einsum("ni,ni->n", matrices[:, 2].take(image, 0), to_point) < 0
    for name, camera in interior.items():
        if camera.projection.widest_deg > 90:
            # Points of a wide-angle camera may lie behind its image plane, but not opposite to their measured rays.
            rows = _of_camera(block, name)[image]
            rays = camera_rays(camera, np.asarray(block.image_points.xy, float)[rows])
            in_front[rows] = np.einsum("ni,ni->n", turn_to_object(matrices, image[rows], rays), to_point[rows]) > 0
    return in_front


def _of_camera(block: Block, name: str) -> Bool[np.ndarray, " images"]:
    return np.array([camera == name for camera in block.image_camera], bool)


def _few(names, indices) -> str:
    return ", ".join(names[i] for i in indices[:5]) + (", ..." if len(indices) > 5 else "")
