"""Strips and control points as a design: where they lie is what a search may change.

A `StripDesign` holds the design variables, a `StripPlan` what stays and how a `Layout` is made of both. Headings are
clockwise from north, lengths in metres, the object frame east-north-up (docs/conventions.md).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.arrays import Numbers
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import NOMINAL
from jaxphoto.rotation import matrix_from_roll_pitch_yaw
from jaxphoto.sensitivity.network.layout import Layout
from jaxphoto.simulation import FlightPlan


class StripDesign(eqx.Module):
    """Variables of a flight of straight strips over some control points; two of them are its bounds.

    `heading` (rad) and `height` (m, Z of the strip); the middle of the strip is `along` ahead and `across` to the right
    of the origin (m), as seen by one who flies it; `roll` and `pitch` (rad) tilt all its images. `control` is X, Y (m)
    of each control point.
    """

    heading: Float[Numbers, "strips"]
    height: Float[Numbers, "strips"]
    across: Float[Numbers, "strips"]
    along: Float[Numbers, "strips"]
    roll: Float[Numbers, "strips"]
    pitch: Float[Numbers, "strips"]
    control: Float[Numbers, "control 2"]


class StripPlan(eqx.Module):
    """What a search does not change of a flight of strips; called with a `StripDesign` it gives the `Layout`.

    `images` are those of each strip, `base` (m) lies between them. `turn` (roll, pitch, yaw in rad) and `shift` (m)
    say, image by image, how the flight leaves its plan. Sigmas in mm on the image and in m, infinite for what is not
    observed. The control points are put onto the ground between its `points` (`smooth_height` with `reach`) and follow
    these in the layout.
    """

    interior: InteriorOrientation
    points: Float[Numbers, "points 3"]
    turn: Float[Numbers, "images 3"]
    shift: Float[Numbers, "images 3"]
    base: float
    reach: float
    image_sigma: float
    control_sigma: float
    station_sigma: float
    images: tuple[int, ...] = eqx.field(static=True)
    sensor: Sensor = eqx.field(static=True)
    free: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, design: StripDesign) -> Layout:
        """The layout of one design."""
        control, d = jnp.asarray(design.control), design
        ground = jnp.asarray(self.points)
        placed = jnp.column_stack([control, smooth_height(ground, control, self.reach)])
        weight = np.repeat([0.0, 1.0], [len(ground), len(control)])[:, None] / self.control_sigma**2
        exterior = strip_images(
            self.images, self.base, d.heading, d.height, d.along, d.across, d.roll, d.pitch, self.turn, self.shift
        )
        return Layout(
            self.interior,
            exterior,
            jnp.concatenate([ground, placed]),
            image_weight=1 / self.image_sigma**2,
            control_weight=weight,
            station_weight=1 / self.station_sigma**2,
            sensor=self.sensor,
            free=self.free,
        )


def planned_design(plan: FlightPlan, control: Float[Numbers, "control 2"]) -> StripDesign:
    """The strips of a flight plan over ground of mean height zero, without tilts, and control points at X, Y (m)."""
    numbers = [(np.deg2rad(s.heading_deg), s.height_m, s.across_m, s.along_m, 0.0, 0.0) for s in plan.strips]
    heading, height, across, along, roll, pitch = np.array(numbers).T
    return StripDesign(heading, height, across, along, roll, pitch, np.asarray(control, float))


def strip_images(
    images: Sequence[int],
    base: Float[Numbers, "strips"] | float,
    heading: Float[Numbers, "strips"],
    height: Float[Numbers, "strips"] | float,
    along: Float[Numbers, "strips"] | float = 0.0,
    across: Float[Numbers, "strips"] | float = 0.0,
    roll: Float[Numbers, "strips"] | float = 0.0,
    pitch: Float[Numbers, "strips"] | float = 0.0,
    turn: Float[Numbers, "images 3"] | float = 0.0,
    shift: Float[Numbers, "images 3"] | float = 0.0,
) -> ExteriorOrientation:
    """Exterior orientations of straight strips of so many `images` each, the camera's x axis forward.

    `base` (m) lies between exposures, `heading` (rad) is clockwise from north, `height` (m) the Z of the strip; its
    middle is `along` ahead and `across` to the right of the origin (m), as seen by one who flies it. `roll` and
    `pitch` (rad) tilt every image of a strip. `turn` (roll, pitch, yaw in rad) and `shift` (m) are added image by
    image: how the flight leaves its plan. As `simulation.Strip`, and differentiable.
    """
    n = len(images)
    of = np.repeat(np.arange(n), images)
    place = np.concatenate([np.arange(m) - (m - 1) / 2 for m in images])
    numbers = (base, heading, height, along, across, roll, pitch)
    base, heading, height, along, across, roll, pitch = (
        jnp.broadcast_to(jnp.asarray(v, float), (n,))[of] for v in numbers
    )
    s, c, ahead = jnp.sin(heading), jnp.cos(heading), along + base * place
    position = jnp.stack([ahead * s + across * c, ahead * c - across * s, height], axis=1)
    angles = jnp.stack([roll, pitch, heading], axis=1) + turn
    matrix = jax.vmap(lambda a: (matrix_from_roll_pitch_yaw(a) @ NOMINAL["forward"]).T)(angles)
    return ExteriorOrientation(position + shift, matrix)


def smooth_height(points: Float[Array, "points 3"], xy: Float[Array, "n 2"], reach: float) -> Float[Array, "n"]:
    """Z (m) of the ground at `xy` (m), from that of `points` around: their mean, weighted by exp(-d^2 / (2 reach^2)).

    A point whose place is a design variable is put onto the ground by it; `reach` (m) is about the distance between
    points.
    """
    square = jnp.sum((xy[:, None] - points[None, :, :2]) ** 2, axis=2)
    return jax.nn.softmax(-square / (2 * reach**2), axis=1) @ points[:, 2]
