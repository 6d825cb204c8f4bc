"""A planned layout as a block that is truly measured: whole image points or none, and noise of the weights given.

It is how a layout is checked by what knows nothing of it: `jaxphoto.adjust` and `jaxphoto.covariance`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment.datum import close_datum
from jaxphoto.adjustment.model.block_values import values_of
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.arrays import still
from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import Perspective, set_parameter
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import NOMINAL, Mount, body_from_camera
from jaxphoto.observations import Attitudes, ControlRows, Distances, ImageRows, StationRows
from jaxphoto.rotation import roll_pitch_yaw_from_matrix
from jaxphoto.sensitivity.network.layout import Layout
from jaxphoto.simulation import photograph
from jaxphoto.unknowns import FREE, Unknowns, default_priors

CAMERA, MOUNT = "camera", "body"


class Measured(NamedTuple):
    """A block whose observations have no noise yet (`simulation.remeasure` gives it some), and its truth."""

    block: Block
    truth: Unknowns
    point: np.ndarray
    """Which of the layout's points the block's are: those that two images see, and control that one sees."""


def measured_block(layout: Layout) -> Measured:
    """The block that `layout` gives if every image measures the points inside its format, as they truly are.

    Weights become standard deviations; what has none is not observed. Raises BlockError where an image sees fewer than
    three points.
    """
    layout = jax.tree.map(still, layout)
    n = len(layout.exterior.position)
    rays = photograph(
        {CAMERA: layout.interior}, {CAMERA: layout.sensor}, (CAMERA,) * n, layout.exterior, np.asarray(layout.points)
    )
    image_weight, station, attitude = (np.asarray(w) for w in layout.by_image)
    control = np.asarray(layout.by_point)
    rays = rays.take(image_weight[rays.image] > 0)
    seen, number = rays.per_point(len(control)), np.full(len(control), -1)
    point = np.flatnonzero((seen >= 2) | ((seen == 1) & (control > 0).all(axis=1)))
    number[point] = np.arange(len(point))
    rays = rays.take(number[rays.point] >= 0)
    for k in np.flatnonzero(np.bincount(rays.image, minlength=n) < 3):
        raise BlockError(
            f"image {k + 1} of the layout sees fewer than three points of use to it, and cannot be "
            "oriented; narrow the bounds of the design or give more ground points"
        )
    sigma = np.repeat(1 / np.sqrt(image_weight[rays.image])[:, None], 2, axis=1)
    turned = np.flatnonzero((attitude > 0).all(axis=1))
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
        image_points=ImageRows(rays.image, number[rays.point], rays.xy, sigma),
        control=ControlRows(*_rows(control[point], np.asarray(truth.points))),
        fixed=ControlRows.none(),
        check=ControlRows.none(),
        stations=StationRows(*_rows(station, np.asarray(layout.exterior.position))),
        attitudes=Attitudes(turned, angles[turned], 1 / np.sqrt(attitude[turned])),
        distances=Distances.none(),
        datum=Datum(),
        start=Start(truth, np.ones(n, bool), np.ones(len(point), bool)),
        priors=priors,
    )
    return Measured(block, truth, point)


def check_layout(layout: Layout) -> None:
    """Raise DatumError where `layout` leaves position, orientation or scale open, BlockError where an image
    sees too few points, or where the camera is a fisheye, whose images are not planned.

    It is the check of `jaxphoto.adjust`, and says what is open.
    """
    if not isinstance(layout.interior.projection, Perspective):
        raise BlockError(
            f"layouts are planned for perspective cameras, and this one is {layout.interior.projection.name}: adjust "
            "blocks of it instead (designs, monte_carlo)"
        )
    block, truth, _ = measured_block(layout)
    structure = structure_of(block, block.priors)
    close_datum(block, values_of(block, truth, block.priors, structure), structure)


def _rows(weight: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, ...]:
    """One row for every coordinate that has a weight."""
    who, axis = np.nonzero(weight > 0)
    return who, axis, np.asarray(value)[who, axis], 1 / np.sqrt(weight[who, axis])


@eqx.filter_jit
def _roll_pitch_yaw(camera_from_object: Float[Array, "images 3 3"]) -> Float[Array, "images 3"]:
    """Of the body in which the camera's x axis points forward."""
    level = body_from_camera(jnp.zeros(3), jnp.asarray(NOMINAL["forward"]))
    return jax.vmap(lambda matrix: roll_pitch_yaw_from_matrix(matrix.T @ level.T))(camera_from_object)
