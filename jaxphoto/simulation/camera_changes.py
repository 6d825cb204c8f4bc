"""Simulation of changing cameras: their image points, and the model of the block.

A camera changes during the flight, with temperature or from strip to strip. With a rolling shutter it moves during
readout.
"""

import dataclasses
from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.camera import ImageMotion, RollingShutter, RowMotion, StripCamera
from jaxphoto.camera.camera_rates import HOUR_S
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.georeferencing import Exposure, Mount, body_from_camera
from jaxphoto.observations import StripCameraSteps
from jaxphoto.parameters import AbstractParameters, dynamic_fields
from jaxphoto.simulation.flight import Flight
from jaxphoto.simulation.points import Rays
from jaxphoto.simulation.recipe import Recipe, SimulatedChange, triple
from jaxphoto.simulation.sampling import in_chunks, stream
from jaxphoto.unknowns import FIXED, Unknowns, Weighted

Changes = Mapping[str, Mapping[str, SimulatedChange]]
_CHUNK = 1024
_WALKING = dynamic_fields(StripCamera)


def draw_changes(recipe: Recipe, flight: Flight, clock: Float[np.ndarray, "images"], seed: int) -> Changes:
    """Draw the true changes of the recipe: deviations of each owner, and the random walk between strips."""
    changes = {kind: draw_deviations(owners, seed) for kind, owners in recipe.changes.items()}
    if recipe.walk is not None:
        strips, hours = _strip_hours(flight, clock)
        steps = np.sqrt(np.diff(hours, prepend=hours[:1]))[:, None] * triple(recipe.walk.truth)
        walked = np.cumsum(steps * stream(seed, "walk of cameras").standard_normal((len(strips), 3)), axis=0)
        cameras = changes[StripCamera.kind]
        for name, more in zip(strips, walked, strict=True):
            if name in cameras:
                change = cameras[name]
                moved = {f: np.asarray(getattr(change.truth, f)) + v for f, v in zip(_WALKING, more, strict=True)}
                cameras[name] = dataclasses.replace(change, truth=dataclasses.replace(change.truth, **moved))
    return changes


def draw_deviations(owners: Mapping[str, SimulatedChange], seed: int) -> dict[str, SimulatedChange]:
    """Draw the deviations of each owner, and return the changes with their truth."""
    result = {}
    for name, change in owners.items():
        rng, moved = stream(seed, f"{type(change.truth).kind} of {name}"), {}
        for field in dynamic_fields(type(change.truth)):
            value, prior = np.asarray(getattr(change.truth, field)), getattr(change.spread, field)
            # Draw for every field, so that the deviations of a field do not depend on other fields.
            z = rng.standard_normal(value.shape)
            if isinstance(prior, Weighted):
                joint = prior.covariance
                deviation = prior.sigma * z if joint is None else np.linalg.cholesky(np.asarray(joint)) @ z
                moved[field] = value + deviation
        result[name] = dataclasses.replace(change, truth=dataclasses.replace(change.truth, **moved))
    return result


def camera_steps(
    recipe: Recipe, flight: Flight, clock: Float[np.ndarray, "images"], start: Unknowns
) -> tuple[StripCameraSteps, ...]:
    """Return the block's random walk constraints between successive strips whose camera it models."""
    if recipe.walk is None or recipe.walk.stated is None:
        return ()
    modelled = list(start.more.get(StripCamera.kind, {}))
    hours = [hour for strip, hour in zip(*_strip_hours(flight, clock), strict=True) if strip in modelled]
    n = len(modelled) - 1
    sigma = np.sqrt(np.diff(hours))[:, None] * triple(recipe.walk.stated)
    return (StripCameraSteps(np.arange(n), np.arange(n) + 1, np.zeros((n, 3)), sigma),) if n > 0 else ()


def _strip_hours(flight: Flight, clock: Float[np.ndarray, "images"]) -> tuple[list[str], Float[np.ndarray, "strips"]]:
    """Return the strips in order, and their mean times (h)."""
    strips, of = list(dict.fromkeys(flight.strips)), np.array(flight.strips)
    return strips, np.array([clock[of == strip].mean() for strip in strips]) / HOUR_S


def reproject_changing(
    recipe: Recipe,
    flight: Flight,
    rays: Rays,
    points: Float[np.ndarray, "points 3"],
    motions: Float[np.ndarray, "images 6"],
    time: Float[np.ndarray, "images"],
    above: Float[np.ndarray, "images"],
    changes: Changes,
) -> Rays:
    """Reproject the rays of images whose camera changes; return all other rays unchanged.

    `motions`: motion of the camera per image, from `camera_motions`; `time` from the middle of the flight (s);
    `above`: temperature above the reference (K). A point at the edge of the format may be moved
    slightly beyond it.
    """
    xy, own_of = rays.xy.copy(), [_of_images(owners, flight) for owners in changes.values()]
    changing = np.any([mask for mask, _ in own_of], axis=0) if own_of else np.zeros(len(flight.images), bool)
    cameras = np.array(flight.cameras)
    for name, camera in recipe.cameras.items():
        shutter = recipe.shutters.get(name)
        rows_of = np.flatnonzero(((cameras == name) & (changing | (shutter is not None)))[rays.image])
        if not len(rows_of):
            continue
        image = rays.image[rows_of]
        readout_s = 1e-3 * float(shutter.truth.readout) if shutter else 0.0
        place = (flight.exterior.position, flight.exterior.camera_from_object)
        truth = jax.tree.map(np.float64, camera.truth)
        bending = [jax.tree.map(lambda v: v[image], stacked) for _, stacked in own_of]  # noqa: B023
        xy[rows_of] = in_chunks(
            lambda *rows: _seen(truth, *rows),  # noqa: B023
            _CHUNK,
            bending,
            np.full(len(rows_of), readout_s / recipe.sensors[name].height_mm),
            motions[image],
            time[image],
            above[image],
            *(np.asarray(v)[image] for v in place),
            points[rays.point[rows_of]],
        )
    return rays._replace(xy=xy)


def _of_images(owners: Mapping[str, SimulatedChange], flight: Flight) -> tuple[np.ndarray, AbstractParameters]:
    """Return a mask of the images with a changing owner, and the change of each image (zero without one)."""
    any_of = next(iter(owners.values())).truth
    names = {"camera": flight.cameras, "strip": flight.strips}[any_of.owner]
    none = jax.tree.map(np.zeros_like, any_of)
    each = [owners[name].truth if name in owners else none for name in names]
    return np.isin(names, list(owners)), jax.tree.map(lambda *v: np.stack([np.asarray(x, float) for x in v]), *each)


@jax.jit
def _seen(interior, bending, time_per_mm, motion, in_flight, above, position, camera_from_object, point):
    def one(bending, time_per_mm, motion, in_flight, above, position, camera_from_object, point):
        # Of the exposure, camera changes depend only on these quantities.
        exposure, changed = Exposure(in_flight, motion[:3], motion[3:], temperature=above), interior
        for change in bending:
            changed = change.interior(changed, exposure)
        moving = dataclasses.replace(changed, rows=RowMotion(time_per_mm, *motion))
        return project(moving, ExteriorOrientation(position, camera_from_object), point)

    return jax.vmap(one)(bending, time_per_mm, motion, in_flight, above, position, camera_from_object, point)


def with_changes(
    changes: Changes, start: Unknowns, priors: Unknowns, truth: Unknowns
) -> tuple[Unknowns, Unknowns, Unknowns]:
    """Add the changes to start, priors and truth; the truth includes changes that the block does not model."""

    def more(unknowns: Unknowns, own_of: Mapping[str, dict[str, AbstractParameters]]) -> Unknowns:
        return dataclasses.replace(unknowns, more=unknowns.more | {kind: of for kind, of in own_of.items() if of})

    modelled = {
        kind: {n: change.model for n, change in owners.items() if change.model} for kind, owners in changes.items()
    }
    return (
        more(start, {kind: {n: model[0] for n, model in owners.items()} for kind, owners in modelled.items()}),
        more(priors, {kind: {n: model[1] for n, model in owners.items()} for kind, owners in modelled.items()}),
        more(truth, {kind: {n: change.truth for n, change in owners.items()} for kind, owners in changes.items()}),
    )


def camera_motions(exterior: ExteriorOrientation, velocity, rate, mounts: list[Mount]) -> Float[np.ndarray, "images 6"]:
    """Return velocity (m/s) and rotation rate (rad/s) in the axes of the camera.

    `velocity` is in the object frame, `rate` about the body's right, forward and up axes.
    """
    turned = np.einsum("nij,nj->ni", np.asarray(exterior.camera_from_object), velocity)
    camera = np.stack([np.asarray(body_from_camera(m.boresight, m.nominal)).T for m in mounts])
    return np.hstack([turned, np.einsum("nij,nj->ni", camera, rate)])


def with_shutters(
    recipe: Recipe, flight: Flight, motions: np.ndarray, seed: int, start: Unknowns, priors: Unknowns, truth: Unknowns
) -> tuple[Unknowns, Unknowns, Unknowns]:
    """Add rolling shutters and image motions to start, priors and truth, for cameras whose block model has a shutter.

    The block receives each motion with its stated error, or exactly if it is fixed.
    """
    if not recipe.shutters:
        return start, priors, truth
    of = [recipe.shutters.get(camera) for camera in flight.cameras]
    true = {name: _motion(m) for name, m, shutter in zip(flight.images, motions, of, strict=True) if shutter}
    error = stream(seed, "noise of motions").standard_normal(motions.shape)
    stated, prior = {}, {}
    for name, m, e, shutter in zip(flight.images, motions, error, of, strict=True):
        if shutter is None or shutter.model is None:
            continue
        sigma = np.repeat([shutter.velocity_m_per_s, np.deg2rad(shutter.rate_deg_per_s)], 3)
        stated[name] = _motion(m + sigma * e)
        prior[name] = ImageMotion(
            Weighted(stated[name].velocity, sigma[:3]) if shutter.velocity_m_per_s else FIXED,  # type: ignore[arg-type]
            Weighted(stated[name].rate, sigma[3:]) if shutter.rate_deg_per_s else FIXED,  # type: ignore[arg-type]
        )
    models = {name: shutter.model for name, shutter in recipe.shutters.items() if shutter.model}
    kinds = RollingShutter.kind, ImageMotion.kind

    def more(shutters: dict, images: dict) -> dict:
        return dict(zip(kinds, (shutters, images), strict=True)) if shutters else {}

    return (
        dataclasses.replace(start, more=more({name: model[0] for name, model in models.items()}, stated)),
        dataclasses.replace(priors, more=more({name: model[1] for name, model in models.items()}, prior)),
        dataclasses.replace(truth, more=more({name: shutter.truth for name, shutter in recipe.shutters.items()}, true)),
    )


def _motion(numbers: np.ndarray) -> ImageMotion:
    return ImageMotion(numbers[:3], numbers[3:])  # type: ignore[arg-type]
