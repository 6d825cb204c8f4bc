"""Projection of image coordinates to the ground (horizontal plane or surface).

Functions take one image and one point (monoplotting). Frames and units: docs/conventions.md, equations: docs/models.md.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names, set_parameter
from jaxphoto.collinearity import ExteriorOrientation, image_ray
from jaxphoto.georeferencing.corrections import NO_CORRECTIONS, Corrections, apparent_point
from jaxphoto.rotation import small_rotation
from jaxphoto.short_repr import pretty_repr

# Number of iterations. Refraction and curvature bend a ray by about 1e-4: each iteration gains four digits.
_ROUNDS = 4
_MAX_STEPS = 60


@pretty_repr
class Surface(eqx.Module):
    """Ground as a differentiable height Z (m) over X and Y (m), between the heights `low` and `high`."""

    height: Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, ""]]
    low: Float[Array, ""] | float
    high: Float[Array, ""] | float


Ground = Surface | Float[Array, ""] | float
"""Surface, or Z (m) of a horizontal plane."""


def ground_point(
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    xy: Float[Array, "2"],
    ground: Ground,
    corrections: Corrections = NO_CORRECTIONS,
) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """Intersect the ray of the measured image coordinate `xy` (mm) with the ground (m); False without intersection.

        X = X_s + s M' (x', y', -c)',    s = (Z - Z_s) / third component

    On a surface, Z = height(X, Y) is solved by safeguarded Newton iterations on the height and differentiated by the
    implicit function theorem. The surface must be continuous along the ray; if there are several intersections, as
    behind a ridge, any one of them is returned. The flag is False, and the point meaningless, if the ray is parallel to
    the plane, or if it intersects the ground behind the camera or not between `low` and `high`. Source: paper 001,
    equation (1), inverted.
    """
    origin, direction = image_ray(interior, exterior, xy)
    upright = direction[2] == 0
    # Use two `where`, because derivatives of a horizontal ray must not be NaN either.
    fall = jnp.where(upright, 1.0, direction[2])

    def at_height(height: Float[Array, ""]) -> Float[Array, "3"]:
        meet = lambda z: origin + direction * ((z - origin[2]) / fall)  # noqa: E731
        point = meet(height)
        for _ in range(_ROUNDS if corrections.refraction or corrections.curvature else 0):
            aim = apparent_point(origin, point, corrections)
            point = point + meet(aim[2]) - aim
        return point

    if isinstance(ground, Surface):
        # Restrict the search to the ray in front of the camera.
        low = jnp.where(fall > 0, jnp.maximum(ground.low, origin[2]), ground.low)
        high = jnp.where(fall < 0, jnp.minimum(ground.high, origin[2]), ground.high)
        height, met = _root(lambda z: z - ground.height(*at_height(z)[:2]), low, high)
    else:
        height, met = jnp.asarray(ground, float), jnp.array(True)
    return at_height(height), ~upright & ((height - origin[2]) / fall > 0) & met


def moved_exterior(exterior: ExteriorOrientation, step: Float[Array, "6"]) -> ExteriorOrientation:
    """Apply a shift (m) and a small rotation in the camera frame (rad) to the exterior orientation."""
    return ExteriorOrientation(
        exterior.position + step[:3], small_rotation(step[3:]) @ jnp.asarray(exterior.camera_from_object)
    )


def moved_interior(interior: InteriorOrientation, step: Float[Array, "k"]) -> InteriorOrientation:
    """Add `step` to the parameters of the interior orientation, in the order of `camera.parameter_names`."""
    for k, name in enumerate(parameter_names(interior)):
        interior = set_parameter(interior, name, get_parameter(interior, name) + step[k])
    return interior


def _root(f: Callable, low: Float[Array, ""], high: Float[Array, ""]) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Return the root z of f in [low, high], f(low) <= 0 <= f(high), and True if it exists; differentiable."""
    low, high = jax.lax.stop_gradient((low, high))
    enough = 1e-12 * (1 + jnp.maximum(jnp.abs(low), jnp.abs(high)))

    def newton(f, z):
        def unfinished(state):
            k, _, low, high, value, _ = state
            return (k < _MAX_STEPS) & (jnp.abs(value) > enough) & (high - low > enough)

        def step(state):
            k, z, low, high, value, slope = state
            low, high = jnp.where(value < 0, z, low), jnp.where(value < 0, high, z)
            new = z - value / slope
            new = jnp.where((new > low) & (new < high), new, 0.5 * (low + high))
            return k + 1, new, low, high, *jax.jvp(f, (new,), (jnp.ones(()),))

        return jax.lax.while_loop(unfinished, step, (0, z, low, high, *jax.jvp(f, (z,), (jnp.ones(()),))))[1]

    z = jax.lax.custom_root(f, 0.5 * (low + high), newton, lambda g, y: y / g(jnp.ones(())))
    return z, (low <= high) & (jnp.abs(f(z)) <= 1e3 * enough)
