"""Simulation of a rolling shutter: camera motion while rows are exposed, and the model of the block."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import ImageMotion, RollingShutter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import Mount, body_from_camera
from jaxphoto.simulation.flight import Flight
from jaxphoto.simulation.recipe import Recipe
from jaxphoto.simulation.streams import stream
from jaxphoto.unknowns import FIXED, Unknowns, Weighted


def camera_motions(exterior: ExteriorOrientation, velocity, rate, mounts: list[Mount]) -> Float[np.ndarray, "images 6"]:
    """Return velocity (m/s) and rotation rate (rad/s) in the axes of the camera.

    From a velocity in the object frame and a rate about the body's right, forward and up axes.
    """
    turned = np.einsum("nij,nj->ni", np.asarray(exterior.camera_from_object), velocity)
    camera = np.stack([np.asarray(body_from_camera(m.boresight, m.nominal)).T for m in mounts])
    return np.hstack([turned, np.einsum("nij,nj->ni", camera, rate)])


def with_shutters(
    recipe: Recipe, flight: Flight, motions: np.ndarray, seed: int, start: Unknowns, priors: Unknowns, truth: Unknowns
) -> tuple[Unknowns, Unknowns, Unknowns]:
    """Return start, priors and truth with the shutters and the motions of images whose camera the block models with
    one.

    The block receives each motion with the error that it states, or exactly if it is fixed.
    """
    if not recipe.shutters:
        return start, priors, truth
    of = [recipe.shutters.get(camera) for camera in flight.cameras]
    true = {name: _motion(m) for name, m, own in zip(flight.images, motions, of, strict=True) if own}
    error = stream(seed, "noise of motions").standard_normal(motions.shape)
    told, known = {}, {}
    for name, m, e, own in zip(flight.images, motions, error, of, strict=True):
        if own is None or own.model is None:
            continue
        sigma = np.repeat([own.velocity_m_per_s, np.deg2rad(own.rate_deg_per_s)], 3)
        told[name] = _motion(m + sigma * e)
        known[name] = ImageMotion(
            Weighted(told[name].velocity, sigma[:3]) if own.velocity_m_per_s else FIXED,  # type: ignore[arg-type]
            Weighted(told[name].rate, sigma[3:]) if own.rate_deg_per_s else FIXED,  # type: ignore[arg-type]
        )
    models = {name: own.model for name, own in recipe.shutters.items() if own.model}
    kinds = RollingShutter.kind, ImageMotion.kind

    def more(shutters: dict, images: dict) -> dict:
        return dict(zip(kinds, (shutters, images), strict=True)) if shutters else {}

    return (
        dataclasses.replace(start, more=more({name: model[0] for name, model in models.items()}, told)),
        dataclasses.replace(priors, more=more({name: model[1] for name, model in models.items()}, known)),
        dataclasses.replace(truth, more=more({name: own.truth for name, own in recipe.shutters.items()}, true)),
    )


def _motion(numbers: np.ndarray) -> ImageMotion:
    return ImageMotion(numbers[:3], numbers[3:])  # type: ignore[arg-type]
