"""Layouts of planned networks: positions of cameras and ground points, with weights.

A `Layout` contains the input of a covariance, without measurements. A design is any tree of numeric values (headings,
heights, the position of a control point, fractions of a budget), which a pure function of the user maps to a `Layout`.
For straight strips and control points, `StripDesign` contains the design variables and `StripPlan` the constants. To
verify a layout independently, `block_from_layout` builds a block with observations for `jaxphoto.adjust` and
`jaxphoto.covariance`. Headings are clockwise from north, lengths in metres, the object frame east-north-up
(docs/conventions.md).
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment.datum import close_datum
from jaxphoto.adjustment.model.block_values import values_of
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.arrays import ArrayLike, to_numpy
from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import InteriorOrientation, Perspective, Sensor, parameter_names, set_parameter, table_name
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import NOMINAL, Mount, body_from_camera
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints
from jaxphoto.rotation import matrix_from_roll_pitch_yaw, roll_pitch_yaw_from_matrix
from jaxphoto.simulation import FlightPlan, photograph
from jaxphoto.unknowns import FREE, Unknowns, default_priors


def _table_names(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(map(table_name, names))


class Layout(eqx.Module):
    """Images of one camera over ground points, with the weights of all planned observations.

    A weight is 1 / sigma^2, zero for no observation. It may be traced, so that a budget can be optimised. Weights with
    fewer axes are broadcast. The interior parameters in `free` (names as in block.toml) are unknown, the others fixed.
    All exterior orientations and points are unknown.
    """

    interior: InteriorOrientation
    exterior: ExteriorOrientation
    points: Float[Array, "points 3"]
    """Ground points (m), including control points."""
    image_weight: Float[ArrayLike, "..."] | float
    """Weight of both image coordinates, by image (1 / mm^2)."""
    control_weight: Float[ArrayLike, "..."] | float = 0.0
    """Weight of X, Y, Z by point (1 / m^2)."""
    station_weight: Float[ArrayLike, "..."] | float = 0.0
    """Weight of X, Y, Z of the projection centre by image (1 / m^2)."""
    attitude_weight: Float[ArrayLike, "..."] | float = 0.0
    """Weight of roll, pitch, yaw by image (1 / rad^2). The camera's x axis points forward."""
    sensor: Sensor = eqx.field(static=True, kw_only=True)
    free: tuple[str, ...] = eqx.field(static=True, default=("c_mm", "xp_mm", "yp_mm"), converter=_table_names)
    edge_mm: float = eqx.field(static=True, default=1.0)
    """Width of the edge of the format, half of it inside the format. The weight of an image point decreases smoothly to
    zero across the edge, so a layout is differentiable where points enter an image.
    """

    def __check_init__(self) -> None:
        names = parameter_names(self.interior)
        if unknown := [name for name in self.free if name not in names]:
            raise InputError(f"unknown parameter {unknown[0]} of this camera: choose among {', '.join(names)}")
        if not self.edge_mm > 0:
            raise InputError(f"edge_mm, the width of the edge of the format, must be positive, got {self.edge_mm}")

    @property
    def by_image(self) -> tuple[Float[Array, "images"], Float[Array, "images 3"], Float[Array, "images 3"]]:
        """Return the weights of image coordinates, stations and attitudes for every image."""
        n = len(self.exterior.position)
        weights = (self.image_weight, (n,)), (self.station_weight, (n, 3)), (self.attitude_weight, (n, 3))
        image, station, attitude = (jnp.broadcast_to(jnp.asarray(w, float), shape) for w, shape in weights)
        return image, station, attitude

    @property
    def by_point(self) -> Float[Array, "points 3"]:
        """Return the weights of control coordinates for every point."""
        return jnp.broadcast_to(jnp.asarray(self.control_weight, float), self.points.shape)


class StripDesign(eqx.Module):
    """Design variables of a flight of straight strips over control points. Two designs are the bounds of a search.

    `heading` (rad); `height` (m): Z of the strip. The centre of the strip is `along` ahead and `across` to the right of
    the origin (m), in flight direction. `roll` and `pitch` (rad) tilt all images of a strip. `control`: X, Y (m) of
    each control point.
    """

    heading: Float[ArrayLike, "strips"]
    height: Float[ArrayLike, "strips"]
    across: Float[ArrayLike, "strips"]
    along: Float[ArrayLike, "strips"]
    roll: Float[ArrayLike, "strips"]
    pitch: Float[ArrayLike, "strips"]
    control: Float[ArrayLike, "control 2"]


class StripPlan(eqx.Module):
    """Constants of a flight of strips. Calling it with a `StripDesign` returns the `Layout`.

    `images`: number of images per strip; `base` (m): distance between them. `turn` (roll, pitch, yaw in rad) and
    `shift` (m): deviations of each image from the plan. Sigmas are in mm on the image and in m, infinite for no
    observation. The ground through `points` (`smooth_height` with `reach`) gives the heights of the control points,
    which follow `points` in the layout.
    """

    interior: InteriorOrientation
    points: Float[ArrayLike, "points 3"]
    turn: Float[ArrayLike, "images 3"]
    shift: Float[ArrayLike, "images 3"]
    base: float
    reach: float
    image_sigma: float
    control_sigma: float
    station_sigma: float
    images: tuple[int, ...] = eqx.field(static=True)
    sensor: Sensor = eqx.field(static=True)
    free: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, design: StripDesign) -> Layout:
        """Return the layout of one design."""
        control, d = jnp.asarray(design.control), design
        ground = jnp.asarray(self.points)
        control_points = jnp.column_stack([control, smooth_height(ground, control, self.reach)])
        weight = np.repeat([0.0, 1.0], [len(ground), len(control)])[:, None] / self.control_sigma**2
        exterior = strip_images(
            self.images, self.base, d.heading, d.height, d.along, d.across, d.roll, d.pitch, self.turn, self.shift
        )
        return Layout(
            self.interior,
            exterior,
            jnp.concatenate([ground, control_points]),
            image_weight=1 / self.image_sigma**2,
            control_weight=weight,
            station_weight=1 / self.station_sigma**2,
            sensor=self.sensor,
            free=self.free,
        )


def design_from_plan(plan: FlightPlan, control: Float[ArrayLike, "control 2"]) -> StripDesign:
    """Return the design of a flight plan: strips without tilts over ground of mean height zero, and control points."""
    numbers = [(np.deg2rad(s.heading_deg), s.height_m, s.across_m, s.along_m, 0.0, 0.0) for s in plan.strips]
    heading, height, across, along, roll, pitch = np.array(numbers).T
    return StripDesign(heading, height, across, along, roll, pitch, np.asarray(control, float))


def strip_images(
    images: Sequence[int],
    base: Float[ArrayLike, "strips"] | float,
    heading: Float[ArrayLike, "strips"],
    height: Float[ArrayLike, "strips"] | float,
    along: Float[ArrayLike, "strips"] | float = 0.0,
    across: Float[ArrayLike, "strips"] | float = 0.0,
    roll: Float[ArrayLike, "strips"] | float = 0.0,
    pitch: Float[ArrayLike, "strips"] | float = 0.0,
    turn: Float[ArrayLike, "images 3"] | float = 0.0,
    shift: Float[ArrayLike, "images 3"] | float = 0.0,
) -> ExteriorOrientation:
    """Return the exterior orientations of straight strips with `images` images each, the camera's x axis forward.

    `base` (m): distance between exposures. `heading` (rad): clockwise from north. `height` (m): Z of the strip. The
    centre of the strip is `along` ahead and `across` to the right of the origin (m), in flight direction. `roll` and
    `pitch` (rad) tilt every image of a strip. `turn` (roll, pitch, yaw in rad) and `shift` (m) are added image by
    image. Differentiable version of `simulation.Strip`.
    """
    n = len(images)
    strip = np.repeat(np.arange(n), images)
    position_in_strip = np.concatenate([np.arange(m) - (m - 1) / 2 for m in images])
    values = (base, heading, height, along, across, roll, pitch)
    base, heading, height, along, across, roll, pitch = (
        jnp.broadcast_to(jnp.asarray(v, float), (n,))[strip] for v in values
    )
    s, c, ahead = jnp.sin(heading), jnp.cos(heading), along + base * position_in_strip
    position = jnp.stack([ahead * s + across * c, ahead * c - across * s, height], axis=1)
    angles = jnp.stack([roll, pitch, heading], axis=1) + turn
    matrix = jax.vmap(lambda a: (matrix_from_roll_pitch_yaw(a) @ NOMINAL["forward"]).T)(angles)
    return ExteriorOrientation(position + shift, matrix)


def smooth_height(points: Float[Array, "points 3"], xy: Float[Array, "n 2"], reach: float) -> Float[Array, "n"]:
    """Interpolate Z (m) of the ground at `xy` (m): mean of `points`, weighted by exp(-d^2 / (2 reach^2)).

    Choose `reach` (m) close to the distance between points. Use it for points whose X, Y are design variables.
    """
    square = jnp.sum((xy[:, None] - points[None, :, :2]) ** 2, axis=2)
    return jax.nn.softmax(-square / (2 * reach**2), axis=1) @ points[:, 2]


CAMERA, MOUNT = "camera", "body"


class LayoutBlock(NamedTuple):
    """Block with noise-free observations (`simulation.remeasure` adds noise), and its true parameters."""

    block: Block
    truth: Unknowns
    point: np.ndarray
    """Layout indices of the points in the block: points in at least two images, and control points in at least one."""


def block_from_layout(layout: Layout) -> LayoutBlock:
    """Build the block of `layout`: every image measures the true position of the points inside its format.

    Weights become standard deviations; coordinates of zero weight are not observed. Raises BlockError for an image with
    fewer than three points.
    """
    layout = jax.tree.map(to_numpy, layout)
    n = len(layout.exterior.position)
    rays = photograph(
        {CAMERA: layout.interior}, {CAMERA: layout.sensor}, (CAMERA,) * n, layout.exterior, np.asarray(layout.points)
    )
    image_weight, station, attitude = (np.asarray(w) for w in layout.by_image)
    control = np.asarray(layout.by_point)
    rays = rays.take(image_weight[rays.image] > 0)
    rays_per_point, number = rays.per_point(len(control)), np.full(len(control), -1)
    point = np.flatnonzero((rays_per_point >= 2) | ((rays_per_point == 1) & (control > 0).all(axis=1)))
    number[point] = np.arange(len(point))
    rays = rays.take(number[rays.point] >= 0)
    for k in np.flatnonzero(np.bincount(rays.image, minlength=n) < 3):
        raise BlockError(
            f"image {k + 1} of the layout sees fewer than three usable points and cannot be oriented: narrow the "
            "bounds of the design or add ground points"
        )
    sigma = np.repeat(1 / np.sqrt(image_weight[rays.image])[:, None], 2, axis=1)
    with_attitude = np.flatnonzero((attitude > 0).all(axis=1))
    angles = np.asarray(call_compiled(_roll_pitch_yaw, layout.exterior.camera_from_object))
    zero = jnp.zeros(3)
    truth = Unknowns(
        {CAMERA: layout.interior}, layout.exterior, np.asarray(layout.points)[point], {MOUNT: Mount(zero, zero)}, {}
    )  # type: ignore[arg-type]
    priors = default_priors(truth)
    for name in layout.free:
        priors = eqx.tree_at(lambda p: p.interior[CAMERA], priors, set_parameter(priors.interior[CAMERA], name, FREE))
    block = Block(
        title="planned layout",
        images=tuple(f"{k + 1}" for k in range(n)),
        points=tuple(f"{k + 1}" for k in point),
        sensors={CAMERA: layout.sensor},
        image_camera=(CAMERA,) * n,
        image_mount=(MOUNT,) * n,
        image_strip=("",) * n,
        image_time=np.zeros(n),
        image_points=ImagePoints(rays.image, number[rays.point], rays.xy, sigma),
        control=ControlCoordinates(*_rows(control[point], np.asarray(truth.points))),
        fixed=ControlCoordinates.none(),
        check=ControlCoordinates.none(),
        stations=CameraPositions(*_rows(station, np.asarray(layout.exterior.position))),
        attitudes=Attitudes(with_attitude, angles[with_attitude], 1 / np.sqrt(attitude[with_attitude])),
        distances=Distances.none(),
        datum=Datum(),
        start=Start(truth, np.ones(n, bool), np.ones(len(point), bool)),
        priors=priors,
    )
    return LayoutBlock(block, truth, point)


def check_layout(layout: Layout) -> None:
    """Raise DatumError if position, orientation or scale of `layout` is undetermined, as in `jaxphoto.adjust`.

    Raises BlockError for an image with too few points, and for a fisheye camera.
    """
    if not isinstance(layout.interior.projection, Perspective):
        raise BlockError(
            f"layouts need a perspective camera, and this one is {layout.interior.projection.name}: simulate and "
            "adjust blocks instead (designs, monte_carlo)"
        )
    block, truth, _ = block_from_layout(layout)
    structure = structure_of(block, block.priors)
    close_datum(block, values_of(block, truth, block.priors, structure), structure)


def _rows(weight: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return index, axis, value and sigma of every coordinate with a nonzero weight."""
    index, axis = np.nonzero(weight > 0)
    return index, axis, np.asarray(value)[index, axis], 1 / np.sqrt(weight[index, axis])


@eqx.filter_jit
def _roll_pitch_yaw(camera_from_object: Float[Array, "images 3 3"]) -> Float[Array, "images 3"]:
    """Return roll, pitch, yaw of the body frame in which the camera's x axis points forward."""
    level = body_from_camera(jnp.zeros(3), jnp.asarray(NOMINAL["forward"]))
    return jax.vmap(lambda matrix: roll_pitch_yaw_from_matrix(matrix.T @ level.T))(camera_from_object)
