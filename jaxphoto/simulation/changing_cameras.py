"""Simulation of changing cameras: their image points, and the model of the block.

A camera changes during the flight, with its temperature or from strip to strip; with a rolling shutter it moves while
rows are exposed.
"""

import dataclasses
from collections.abc import Mapping

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.camera import RowMotion, StripCamera
from jaxphoto.camera.camera_rates import HOUR_S
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.georeferencing import Exposure
from jaxphoto.observations import StripCameraSteps
from jaxphoto.parameters import AbstractParameters, dynamic_fields
from jaxphoto.simulation.chunks import in_chunks
from jaxphoto.simulation.flight import Flight
from jaxphoto.simulation.recipe import Recipe, SimulatedChange, triple
from jaxphoto.simulation.streams import stream
from jaxphoto.simulation.visibility import Rays
from jaxphoto.unknowns import Unknowns, Weighted

Changes = Mapping[str, Mapping[str, SimulatedChange]]
_CHUNK = 1024
_WALKING = dynamic_fields(StripCamera)


def drawn(recipe: Recipe, flight: Flight, clock: Float[np.ndarray, "images"], seed: int) -> Changes:
    """Return the changes of the recipe with their truth: deviations of each owner, and the walk between strips."""
    changes = {kind: deviated(owners, seed) for kind, owners in recipe.changes.items()}
    if recipe.walk is not None:
        strips, hours = _strip_hours(flight, clock)
        steps = np.sqrt(np.diff(hours, prepend=hours[:1]))[:, None] * triple(recipe.walk.truth)
        walked = np.cumsum(steps * stream(seed, "walk of cameras").standard_normal((len(strips), 3)), axis=0)
        cameras = changes[StripCamera.kind]
        for name, more in zip(strips, walked, strict=True):
            if name in cameras:
                own = cameras[name]
                moved = {f: np.asarray(getattr(own.truth, f)) + v for f, v in zip(_WALKING, more, strict=True)}
                cameras[name] = dataclasses.replace(own, truth=dataclasses.replace(own.truth, **moved))
    return changes


def deviated(owners: Mapping[str, SimulatedChange], seed: int) -> dict[str, SimulatedChange]:
    """Return the changes with the deviations of each owner in their truth."""
    found = {}
    for name, own in owners.items():
        rng, moved = stream(seed, f"{type(own.truth).kind} of {name}"), {}
        for field in dynamic_fields(type(own.truth)):
            value, prior = np.asarray(getattr(own.truth, field)), getattr(own.spread, field)
            # Every field draws, so that no other's deviation depends on it.
            z = rng.standard_normal(value.shape)
            if isinstance(prior, Weighted):
                joint = prior.covariance
                off = prior.sigma * z if joint is None else np.linalg.cholesky(np.asarray(joint)) @ z
                moved[field] = value + off
        found[name] = dataclasses.replace(own, truth=dataclasses.replace(own.truth, **moved))
    return found


def camera_steps(
    recipe: Recipe, flight: Flight, clock: Float[np.ndarray, "images"], start: Unknowns
) -> tuple[StripCameraSteps, ...]:
    """Return the block's random walk constraints between successive strips whose camera it models."""
    if recipe.walk is None or recipe.walk.stated is None:
        return ()
    known = list(start.more.get(StripCamera.kind, {}))
    hours = [hour for strip, hour in zip(*_strip_hours(flight, clock), strict=True) if strip in known]
    n = len(known) - 1
    sigma = np.sqrt(np.diff(hours))[:, None] * triple(recipe.walk.stated)
    return (StripCameraSteps(np.arange(n), np.arange(n) + 1, np.zeros((n, 3)), sigma),) if n > 0 else ()


def _strip_hours(flight: Flight, clock: Float[np.ndarray, "images"]) -> tuple[list[str], Float[np.ndarray, "strips"]]:
    """Return the strips in order, and their middles in hours."""
    strips, of = list(dict.fromkeys(flight.strips)), np.array(flight.strips)
    return strips, np.array([clock[of == strip].mean() for strip in strips]) / HOUR_S


class Circumstances(eqx.Module):
    """Time from the middle of the flight (s) of each image, and temperature above the reference (K)."""

    time: Float[np.ndarray, "images"]
    above: Float[np.ndarray, "images"]


def seen_by_changing(
    recipe: Recipe,
    flight: Flight,
    rays: Rays,
    points: Float[np.ndarray, "points 3"],
    motions: Float[np.ndarray, "images 6"],
    when: Circumstances,
    changes: Changes,
) -> Rays:
    """Return the rays as seen by changing cameras; unchanged for all others.

    `motions` are those of the images (`camera_motions`). A point at the edge of the format may end up slightly beyond
    it.
    """
    xy, own_of = rays.xy.copy(), [_of_images(owners, flight) for owners in changes.values()]
    changing = np.any([found for found, _ in own_of], axis=0) if own_of else np.zeros(len(flight.images), bool)
    cameras = np.array(flight.cameras)
    for name, camera in recipe.cameras.items():
        shutter = recipe.shutters.get(name)
        own = np.flatnonzero(((cameras == name) & (changing | (shutter is not None)))[rays.image])
        if not len(own):
            continue
        image = rays.image[own]
        readout_s = 1e-3 * float(shutter.truth.readout) if shutter else 0.0
        place = (flight.exterior.position, flight.exterior.camera_from_object)
        truth = jax.tree.map(np.float64, camera.truth)
        bending = [jax.tree.map(lambda v: v[image], stacked) for _, stacked in own_of]  # noqa: B023
        xy[own] = in_chunks(
            lambda *rows: _seen(truth, *rows),  # noqa: B023
            _CHUNK,
            bending,
            np.full(len(own), readout_s / recipe.sensors[name].height_mm),
            motions[image],
            when.time[image],
            when.above[image],
            *(np.asarray(v)[image] for v in place),
            points[rays.point[own]],
        )
    return rays._replace(xy=xy)


def _of_images(owners: Mapping[str, SimulatedChange], flight: Flight) -> tuple[np.ndarray, AbstractParameters]:
    """Return True for each image with a changing owner, and its change; zero where it has none."""
    any_of = next(iter(owners.values())).truth
    names = {"camera": flight.cameras, "strip": flight.strips}[any_of.owner]
    none = jax.tree.map(np.zeros_like, any_of)
    each = [owners[name].truth if name in owners else none for name in names]
    return np.isin(names, list(owners)), jax.tree.map(lambda *v: np.stack([np.asarray(x, float) for x in v]), *each)


@jax.jit
def _seen(interior, bending, time_per_mm, motion, in_flight, above, position, camera_from_object, point):
    def one(bending, time_per_mm, motion, in_flight, above, position, camera_from_object, point):
        # Changes of a camera depend on nothing else of an exposure.
        exposure, changed = Exposure(in_flight, motion[:3], motion[3:], temperature=above), interior
        for own in bending:
            changed = own.interior(changed, exposure)
        moving = dataclasses.replace(changed, rows=RowMotion(time_per_mm, *motion))
        return project(moving, ExteriorOrientation(position, camera_from_object), point)

    return jax.vmap(one)(bending, time_per_mm, motion, in_flight, above, position, camera_from_object, point)


def with_changes(
    changes: Changes, start: Unknowns, priors: Unknowns, truth: Unknowns
) -> tuple[Unknowns, Unknowns, Unknowns]:
    """Return start, priors and truth with the changes; the truth includes those that the block does not model."""

    def more(unknowns: Unknowns, own_of: Mapping[str, dict[str, AbstractParameters]]) -> Unknowns:
        return dataclasses.replace(unknowns, more=unknowns.more | {kind: own for kind, own in own_of.items() if own})

    known = {kind: {n: own.model for n, own in owners.items() if own.model} for kind, owners in changes.items()}
    return (
        more(start, {kind: {n: model[0] for n, model in owners.items()} for kind, owners in known.items()}),
        more(priors, {kind: {n: model[1] for n, model in owners.items()} for kind, owners in known.items()}),
        more(truth, {kind: {n: own.truth for n, own in owners.items()} for kind, owners in changes.items()}),
    )
