"""Approximate values of a whole block: images from points, points from images, until everything is known.

1. An image with an observed position and attitude is oriented directly.
2. Points with enough rays from known images are intersected.
3. Unknown images that see at least four known points are resected, those with the most known points first, and back to
   2. First only points whose rays meet at 1 degree or more serve; where nothing moves any more, narrower ones do.

Where everything is known beforehand, only the check that every point lies in front of its cameras runs, in NumPy.
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from jaxphoto.arrays import still
from jaxphoto.block import Block, Start, direct_exterior, sensor_rows
from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import BlockError, InputError
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.initial.rays import camera_rays, directions_of, ideal_coordinates, turn_to_object
from jaxphoto.initial.resection import resect_ideal
from jaxphoto.observations import ControlRows
from jaxphoto.small_matrices import cholesky_3x3, unwhiten, whiten
from jaxphoto.unknowns import Unknowns

_RESECTED = 4  # known points
_ANGLES = np.deg2rad([1.0, 0.02])  # between rays that make a point: wanted, and just bearable
# Part of the points that may be where no camera could see them: blunders. Of more, the frame is wrong.
_BLUNDERS = 0.05
# Weight of a surveyed coordinate beside a ray.
_SURVEYED = 100.0
_MEND = "give their X_m, Y_m, Z_m, omega_deg, phi_deg, kappa_deg in images.csv, or measure more control points in them"


class PointsBehind(BlockError):
    """Points lie behind cameras that measured them: approximate orientations or points are wrong."""


def approximate(block: Block) -> Unknowns:
    """`block.start` with every image and every point that was unknown found.

    Images are resected from known points or taken from observed positions and attitudes, points are intersected.
    What `block.start` says is known stays as it is.

    Raises BlockError, naming the first few and the mend, where images never see four known points, where the rays of a
    point do not meet at an angle, and where a point lies behind a camera that measured it.
    """
    state = _SoFar(block)
    state.complete()
    state.check()
    _check_in_front(block, state.positions, state.matrices, state.points)
    return state.start().unknowns


def completed(block: Block) -> Start:
    """As much of `approximate` as what is known allows: images and points beyond its reach stay unknown."""
    state = _SoFar(block)
    state.complete()
    return state.start()


def intersected(block: Block) -> Unknowns:
    """`approximate` of a block that a JAX transformation traces: without resection, and without a judgement of numbers.

    A point lies where the squares of its distances from its rays, and from its control coordinates, are least. Raises
    InputError where an image has neither an orientation nor an observed position and attitude.
    """
    start, image, point = block.start.unknowns, *map(np.asarray, (block.image_points.image, block.image_points.point))
    sensors, known = sensor_rows(block, start), np.array(block.start.image_known)
    new = ~known[sensors.image]
    who = sensors.image[new]
    known[who] = True
    if not known.all():
        raise InputError(
            "no image is resected inside a JAX transformation, and images have no approximate orientation "
            f"({_few(block.images, np.flatnonzero(~known))}): compute it outside, start = "
            "jaxphoto.adjust(block).unknowns, and give adjust(block, start)"
        )
    exterior = start.exterior
    if len(who):
        found = direct_exterior(sensors)
        exterior = jax.tree.map(lambda old, own: jnp.asarray(old).at[who].set(own[new]), exterior, found)
    rays = jnp.zeros((len(image), 3))
    for name, interior in start.interior.items():
        own = np.flatnonzero(np.array([camera == name for camera in block.image_camera])[image])
        rays = rays.at[own].set(directions_of(interior, block.image_points.xy[own]))
    along = jnp.einsum("nij,ni->nj", exterior.camera_from_object[image], rays)
    across = jnp.eye(3) - along[:, :, None] * along[:, None] / jnp.sum(along**2, axis=1)[:, None, None]
    at_point = jnp.zeros((len(block.points), 3, 3)).at[point].add(across)
    right = jnp.zeros((len(block.points), 3)).at[point].add(jnp.einsum("nij,nj->ni", across, exterior.position[image]))
    for rows in (block.control, block.fixed):
        at_point = at_point.at[rows.who, rows.axis, rows.axis].add(_SURVEYED)
        right = right.at[rows.who, rows.axis].add(_SURVEYED * rows.value)
    factor = cholesky_3x3(jnp.moveaxis(at_point, 0, -1))
    points = jnp.stack(unwhiten(whiten(right.T, factor), factor), axis=1)
    return dataclasses.replace(start, exterior=exterior, points=points)


class _SoFar:
    """What is known so far. A working table of one call, not a value: it is filled in place."""

    def __init__(self, block: Block) -> None:
        start = block.start.unknowns
        self.block = block
        self.image, self.point = np.asarray(block.image_points.image), np.asarray(block.image_points.point)
        self.positions = np.array(start.exterior.position, float).reshape(-1, 3)
        self.matrices = np.array(start.exterior.camera_from_object, float).reshape(-1, 3, 3)
        self.points = np.array(start.points, float).reshape(-1, 3)
        self.image_known = np.array(block.start.image_known, bool)
        self.point_known = np.array(block.start.point_known, bool)
        self.point_given = self.point_known.copy()
        self.refused: BlockError | None = None
        self.resected = False

    def complete(self) -> None:
        if self.image_known.all() and self.point_known.all():
            return
        self._orient_directly()
        self._image_space()
        for min_angle in _ANGLES:
            while True:
                self._intersect(~self.point_known, min_angle)
                if not self._resect_best():
                    break
        if self.resected:
            # Once more with all rays: the points met first were met by few.
            self._intersect(~self.point_given, _ANGLES[-1])
        self._bring_in_front()

    def check(self) -> None:
        if not self.image_known.all():
            raise self._images_left()
        if not self.point_known.all():
            raise self._points_left()

    def _bring_in_front(self) -> None:
        """Points found behind a camera that measured them, as blunders make it: to where their rays are as deep as
        others. Adjusted there, their residuals tell which ray is wrong.
        """
        known = self.image_known[self.image] & self.point_known[self.point]
        interior = self.block.start.unknowns.interior
        seen = _in_front(self.block, interior, self.positions, self.matrices, self.points)
        bad = np.unique(self.point[known & ~seen])
        bad = bad[~self.point_given[bad]]
        if not len(bad) or len(bad) > max(1, _BLUNDERS * len(self.points)):
            return
        wrong = known & np.isin(self.point, bad)
        depth = np.linalg.norm(self.points[self.point] - self.positions[self.image], axis=1)
        usual = np.full(len(self.positions), np.median(depth[known & seen]))
        for i in np.unique(self.image[wrong]):
            if (own := known & ~wrong & (self.image == i)).any():
                usual[i] = np.median(depth[own])
        image, point = self.image[wrong], self.point[wrong]
        along = turn_to_object(self.matrices, image, self.rays[wrong])
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        ends = self.positions[image] + usual[image, None] * along
        for p in bad:
            self.points[p] = ends[point == p].mean(axis=0)

    def start(self) -> Start:
        if self.block.start.image_known.all() and self.block.start.point_known.all():
            return self.block.start
        places = lambda u: (u.exterior.position, u.exterior.camera_from_object, u.points)  # noqa: E731
        found = (jnp.asarray(self.positions), jnp.asarray(self.matrices), jnp.asarray(self.points))
        return Start(eqx.tree_at(places, self.block.start.unknowns, found), self.image_known, self.point_known)

    def _orient_directly(self) -> None:
        """Step 1: X = GNSS - R l - shift - drift t, and the attitude through the boresight."""
        rows = sensor_rows(self.block, self.block.start.unknowns)
        new = ~self.image_known[rows.image]
        if not new.any():
            return
        exterior = direct_exterior(rows)
        who = rows.image[new]
        self.positions[who] = np.asarray(exterior.position)[new]
        self.matrices[who] = np.asarray(exterior.camera_from_object)[new]
        self.image_known[who] = True

    def _image_space(self) -> None:
        """Ideal coordinates and camera rays of all rows, camera by camera."""
        interior, xy = self.block.start.unknowns.interior, np.asarray(self.block.image_points.xy, float)
        names = sorted(set(self.block.image_camera))
        camera = np.array([names.index(c) for c in self.block.image_camera], int)[self.image]
        self.c = np.array([float(interior[name].c) for name in names])[camera]
        self.ideal, self.rays = np.zeros_like(xy), np.zeros((len(xy), 3))
        for k, name in enumerate(names):
            rows = camera == k
            if rows.any():
                self.ideal[rows] = ideal_coordinates(interior[name], xy[rows])
                self.rays[rows] = camera_rays(interior[name], xy[rows])
        self.rows_of_image = np.argsort(self.image, kind="stable")
        self.first_row = np.searchsorted(self.image[self.rows_of_image], np.arange(len(self.image_known) + 1))

    def _intersect(self, wanted, min_angle: float) -> None:
        """Step 2, of the points `wanted`."""
        if not wanted.any():
            return
        rows = np.flatnonzero(self.image_known[self.image] & wanted[self.point])
        image, point = self.image[rows], self.point[rows]
        directions = turn_to_object(self.matrices, image, self.rays[rows])
        rows_of = partial(_rows_of, wanted=wanted)
        control, fixed = rows_of(self.block.control), rows_of(self.block.fixed)
        who, axis, value = (np.concatenate(parts) for parts in zip(control, fixed, strict=True))
        found, good = intersect_points(
            self.positions[image], directions, point, len(self.points), (who, axis, value), min_angle
        )
        who, axis, value = fixed
        found[who, axis] = value
        good &= wanted
        self.points[good], self.point_known[good] = found[good], True

    def _resect_best(self) -> bool:
        """Step 3, of the images with at least half as many known points as the best; False where none could be."""
        # A fisheye is resected by those of its rays that meet the perspective plane.
        useful = self.point_known[self.point] & ~self.image_known[self.image] & np.isfinite(self.ideal).all(axis=1)
        count = np.bincount(self.image[useful], minlength=len(self.image_known))
        progress = False
        for i in np.argsort(-count, kind="stable"):
            if count[i] < max(_RESECTED, count.max() / 2) and (progress or count[i] < _RESECTED):
                break
            rows = self.rows_of_image[self.first_row[i] : self.first_row[i + 1]]
            rows = rows[useful[rows]]
            try:
                exterior = resect_ideal(
                    self.c[rows[0]], self.ideal[rows], self.points[self.point[rows]], self.block.images[i]
                )
            except BlockError as error:
                self.refused = error
                continue
            self.positions[i], self.matrices[i] = exterior.position, exterior.camera_from_object
            self.image_known[i] = self.resected = progress = True
        return progress

    def _images_left(self) -> BlockError:
        left = np.flatnonzero(~self.image_known)
        seen = np.bincount(self.image[self.point_known[self.point]], minlength=len(self.image_known))
        if self.refused is not None and seen[left].max() >= _RESECTED:
            return self.refused
        return BlockError(
            f"{len(left)} of {len(self.image_known)} images have no approximate orientation and see fewer than 4 known "
            f"points, so they cannot be resected ({_few(self.block.images, left)}): {_MEND}"
        )

    def _points_left(self) -> BlockError:
        left = np.flatnonzero(~self.point_known)
        rays = np.bincount(self.point, minlength=len(self.points))
        name = self.block.points[left[0]]
        more = f"; so it is with {len(left) - 1} more ({_few(self.block.points, left[1:])})" if len(left) > 1 else ""
        if rays[left[0]] < 2:
            return BlockError(
                f"point {name} is measured in {rays[left[0]]} image(s) and has no known coordinates, so it has no "
                f"position{more}: measure it in a second image, give its coordinates, or remove it"
            )
        return BlockError(
            f"the rays of point {name} from {rays[left[0]]} images are nearly parallel, so they do not meet in a "
            f"point{more}: measure it from another position, give its coordinates, or remove it"
        )


def _rows_of(rows: ControlRows, wanted):
    """(who, axis, value) of the rows of the points `wanted`."""
    who = np.asarray(rows.who, int)
    use = wanted[who]
    return who[use], np.asarray(rows.axis, int)[use], np.asarray(rows.value, float)[use]


def _check_in_front(block: Block, positions, matrices, points) -> None:
    image, point = np.asarray(block.image_points.image), np.asarray(block.image_points.point)
    bad = np.flatnonzero(~_in_front(block, block.start.unknowns.interior, positions, matrices, points))
    if len(bad):
        first = bad[0]
        raise PointsBehind(
            f"point {block.points[point[first]]} lies behind image {block.images[image[first]]}, which measured it "
            f"({len(bad)} of {len(image)} image points are so): check the approximate angles and their units, the "
            "position of the image, the unit of its image coordinates, and that the point's are in the same frame"
        )


def in_front(block: Block, unknowns: Unknowns) -> Bool[np.ndarray, "rows"]:
    """Whether the point of each row of `block.image_points` lies, by `unknowns`, where its camera could see it."""
    u = unknowns
    return _in_front(block, u.interior, *map(still, (u.exterior.position, u.exterior.camera_from_object, u.points)))


def looking_away(block: Block, seen: Bool[np.ndarray, "rows"]) -> Int[np.ndarray, "some_images"]:
    """Images that more than half of what they measured lies behind, where not `seen` (`in_front`).

    Collinearity does not know in front from behind: an image that is turned over fits, seen from the other side.
    """
    image, n = np.asarray(block.image_points.image), len(block.images)
    behind = np.bincount(image[~seen], minlength=n)
    return np.flatnonzero(behind > np.bincount(image, minlength=n) / 2)


def _in_front(
    block: Block, interior: dict[str, InteriorOrientation], positions, matrices, points
) -> Bool[np.ndarray, "rows"]:
    image, point = np.asarray(block.image_points.image), np.asarray(block.image_points.point)
    to_point = points.take(point, 0) - positions.take(image, 0)
    in_front = np.einsum("ni,ni->n", matrices[:, 2].take(image, 0), to_point) < 0
    for name, own in interior.items():
        if own.projection.widest_deg > 90:
            # What such a camera sees may lie behind its image plane, but not opposite to where it was measured.
            mine = np.array([camera == name for camera in block.image_camera])[image]
            rays = camera_rays(own, np.asarray(block.image_points.xy, float)[mine])
            in_front[mine] = np.einsum("ni,ni->n", turn_to_object(matrices, image[mine], rays), to_point[mine]) > 0
    return in_front


def _few(names, indices) -> str:
    shown = ", ".join(names[i] for i in indices[:5])
    return shown + (", ..." if len(indices) > 5 else "")
