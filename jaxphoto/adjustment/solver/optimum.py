"""Optimum of a block by Levenberg-Marquardt, and scales of its unknowns."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment.layout.padded import PaddedStructure, PaddedValues
from jaxphoto.adjustment.layout.sharding import BATCHES, EVERYWHERE, along_points, sharded
from jaxphoto.adjustment.model.camera_groups import CameraGroup, interior_of
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.model.parameter_tables import ParameterTable
from jaxphoto.adjustment.solver.levenberg_marquardt import (
    TOLERANCE,
    FactoredSystem,
    IterationHistory,
    LevenbergMarquardt,
    SolveMode,
    as_vector,
)
from jaxphoto.adjustment.solver.normal import Linearised, Reduced
from jaxphoto.camera import InteriorOrientation
from jaxphoto.camera.camera_rates import HOUR_S
from jaxphoto.collinearity import ExteriorOrientation, image_residual
from jaxphoto.georeferencing import Exposure
from jaxphoto.parameters import filled


class Optimum(NamedTuple):
    """End of the iteration, number of steps, convergence, iteration history.

    In a tangent only the increments have a derivative; the others are None.
    """

    increments: Increments
    steps: Int[Array, ""] | None
    converged: Bool[Array, ""] | None
    history: IterationHistory | None


def unit_scale(structure: PaddedStructure) -> Increments:
    """Return the scale of increments in metres, radians and the parameters' own units; zero for fixed unknowns."""
    s = structure
    return Increments(jnp.asarray(s.eop_free), jnp.ones(s.n_shared), jnp.asarray(s.point_free))


def iterate(
    values: PaddedValues, structure: PaddedStructure, task: SolveMode
) -> tuple[Optimum, FactoredSystem, Increments]:
    """Return the optimum, the last system and the scale of its unknowns; or the undamped system at the start."""
    scale = typical_scale(values, structure)
    at_points = along_points(2)
    of_unknowns = Increments(EVERYWHERE, EVERYWHERE, at_points)
    system = FactoredSystem(
        Reduced(EVERYWHERE, EVERYWHERE, EVERYWHERE, BATCHES, BATCHES, at_points, of_unknowns, EVERYWHERE),
        EVERYWHERE,
    )
    out = (Optimum(of_unknowns, EVERYWHERE, EVERYWHERE, EVERYWHERE), system)
    optimum, system = sharded(_iterate, structure, out)(values, scale, structure, task)
    return optimum._replace(increments=jax.tree.map(jnp.multiply, optimum.increments, scale)), system, scale


def _iterate(
    values: PaddedValues, scale: Increments, structure: PaddedStructure, task: SolveMode
) -> tuple[Optimum, FactoredSystem]:
    """Iterate on the data of one device; increments are scaled."""
    solver = LevenbergMarquardt(structure, values, scale, TOLERANCE, task)

    def residuals(y: Any, args: Any) -> Any:
        # The solver computes its own Jacobian: hide the residuals from optimistix's linearisation.
        return jax.lax.stop_gradient(Linearised(solver.increments(y), *args).residual_rows())

    solution: optx.Solution = optx.least_squares(
        residuals,
        solver,
        jnp.zeros_like(as_vector(scale)),
        args=(scale, values, structure),
        # The task limits the number of steps.
        max_steps=None,
        throw=False,
    )
    increments, state = solver.increments(solution.value), solution.state
    converged = (solution.result == optx.RESULTS.successful) & jnp.all(jnp.isfinite(increments.eop))
    return Optimum(increments, state.steps, converged, IterationHistory(*state.history.T)), state.system


def weigh_datum(values: PaddedValues, structure: PaddedStructure) -> PaddedValues:
    """Scale the datum constraints to unit length in scaled increments.

    Their weight does not change the optimum, because no observation contradicts them. This weight keeps N well
    conditioned.
    """
    if not values.datum_eop.shape[0]:
        return values
    scale = typical_scale(values, structure)
    square = jnp.sum((values.datum_eop * scale.eop) ** 2, (1, 2)) + jnp.sum(
        (values.datum_points * scale.points) ** 2, (1, 2)
    )
    weight = (1 / jnp.sqrt(square))[:, None, None]
    where = lambda v: (v.datum_eop, v.datum_points)  # noqa: E731
    return eqx.tree_at(where, values, (values.datum_eop * weight, values.datum_points * weight))


def typical_scale(values: PaddedValues, structure: PaddedStructure) -> Increments:
    """Return the change of each unknown that moves an image point by about its standard deviation; zero if fixed.

    With these scales the norms of the Jacobian's columns agree within a factor of some tens, which suffices for the
    factorisation: unknowns range from 1e-7 (k2) to 1e3 m.
    """
    s, v = structure, jax.tree.map(jax.lax.stop_gradient, values)
    # The first ray of each chunk represents sigmas and distances.
    weight = 1 / v.sigma_xy[..., 0]
    filled = weight > 0
    sigma = jnp.sum(filled) / jnp.sum(weight)
    # Empty slots are zero.
    corner = jnp.max(jnp.abs(v.xy), axis=(0, 2, 3))
    vector = jnp.ones(v.shared.shape)
    for group in s.groups:
        m = group.treedef.num_leaves
        first = v.shared[group.offset : group.offset + m]
        typical = _typical_of_camera(partial(_camera_of, group), first, sigma, corner)
        stop = group.offset + m * len(group.names)
        vector = vector.at[group.offset : stop].set(jnp.tile(typical, len(group.names)))
    sigma, ground, angle = _typical_of_places(s, v, filled, sigma)
    eop = jnp.stack([ground, ground, ground, angle, angle, angle])
    # Scale per unit; the unit is the suffix of the declared parameter's name.
    by_unit = {
        "m": ground,
        "rad": angle,
        "mm": sigma,
        "s": ground / jnp.maximum(jnp.max(jnp.abs(v.velocity)), 1.0),
    }
    by_unit |= {"ms": 1e3 * by_unit["s"], "ppm": 1e6 * angle}
    seconds = jnp.maximum(jnp.max(jnp.abs(v.time)), 1.0)
    by_unit |= {f"{unit}_per_s": by_unit[unit] / seconds for unit in ("m", "rad", "mm")}
    by_unit["mm_per_h"] = by_unit["mm"] * HOUR_S / jnp.maximum(jnp.max(jnp.abs(v.flight_time)), 1.0)
    by_unit["mm_per_K"] = by_unit["mm"] / jnp.maximum(jnp.max(jnp.abs(v.temperature)), 1.0)
    if s.tables:
        declared: list[Array] = []
        for t in s.tables:
            felt = t.modifies_interior and not set(t.units) <= set(by_unit)
            other = _typical_of_bending(s, v, t, sigma, corner) if felt else jnp.ones(t.size)
            declared += [by_unit.get(unit, other[k]) for k, unit in enumerate(t.units)] * len(t.owners)
        vector = vector.at[s.n_cameras :].set(jnp.stack(declared))
    return Increments(eop[:, None] * s.eop_free, vector[s.free], ground * s.point_free)


def _camera_of(group: CameraGroup, numbers: Array) -> InteriorOrientation:
    return interior_of(group, list(numbers))


def _typical_of_camera(
    interior_at: Callable[[Array], InteriorOrientation], at: Float[Array, "n"], sigma: Array, corner: Float[Array, "2"]
) -> Float[Array, "n"]:
    """Return the change of each camera parameter that moves the image of a point by `sigma` (mm); 1 if none does."""
    # Use a point near the axis (moved by c), and measured coordinates in the corner (moved by the coefficients). They
    # are far apart, so their difference must not be scaled by the distortion.
    aim, centre = jnp.array([0.1, 0.1, -1.0]), ExteriorOrientation(jnp.zeros(3), jnp.eye(3))
    camera_at = lambda p: dataclasses.replace(interior_at(p), residuals="model")  # noqa: E731
    by_number = jax.jacfwd(lambda p: image_residual(camera_at(p), centre, aim, corner))(at)
    typical = sigma / jnp.maximum(jnp.max(jnp.abs(by_number), axis=0), 1e-30)
    return jnp.where(jnp.isfinite(typical), typical, 1.0)


def _typical_of_bending(
    s: PaddedStructure, v: PaddedValues, t: ParameterTable, sigma: Array, corner: Float[Array, "2"]
) -> Float[Array, "n"]:
    """Return the typical change of parameters that modify cameras, far from mid-flight and from the reference
    temperature.
    """
    farthest, of_groups = jnp.argmax(jnp.abs(v.flight_time)), []
    exposure = Exposure(*(jnp.asarray(a)[..., farthest] for a in v.exposures))
    exposure = dataclasses.replace(exposure, temperature=jnp.max(jnp.abs(v.temperature)))
    for group in s.groups:
        camera = _camera_of(group, v.shared[group.offset : group.offset + group.treedef.num_leaves])
        bent = lambda p, camera=camera: filled(t.form, p).interior(camera, exposure)  # noqa: E731
        of_groups.append(_typical_of_camera(bent, jnp.zeros(t.size), sigma, corner))
    return jnp.min(jnp.stack(of_groups), axis=0)


# Typical standard deviations for laser strips without images: of a laser point (m), and of the attitude (rad).
_LASER_M, _LASER_RAD = 0.01, 1e-5


def _typical_of_places(s: PaddedStructure, v: PaddedValues, filled: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Return the typical sigma of an image point (mm), its size on the ground (m), and as an angle (rad)."""
    if not s.groups:
        return jnp.ones(()), jnp.array(_LASER_M), jnp.array(_LASER_RAD)
    c = v.shared[s.groups[0].offset]
    point, image = s.rays.ray_point[..., 0], s.rays.chunk_image
    apart = v.points[:, point] - v.position[:, image]
    depth = jnp.sum(jnp.sqrt(jnp.sum(apart**2, axis=0)) * filled[:, 0]) / jnp.sum(filled[:, 0])
    return sigma, sigma * depth / c, sigma / c
