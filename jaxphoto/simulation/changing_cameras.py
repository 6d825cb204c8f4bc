"""Cameras that are not the same in all images of a simulation: where they see points, and what the block knows of it.

A camera changes during the flight by its rates; while the rows of a rolling shutter are exposed it moves on.
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.camera import CameraRates, RowMotion
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.georeferencing import Exposure
from jaxphoto.parameters import AbstractParameters
from jaxphoto.simulation.chunks import in_chunks
from jaxphoto.simulation.flight import Flight
from jaxphoto.simulation.recipe import Recipe
from jaxphoto.simulation.visibility import Rays
from jaxphoto.unknowns import Unknowns

STEADY = CameraRates(0.0, 0.0, 0.0, 0.0)
_CHUNK = 1024


def seen_by_changing(
    recipe: Recipe,
    flight: Flight,
    rays: Rays,
    points: Float[np.ndarray, "points 3"],
    motions: Float[np.ndarray, "images 6"],
    clock: Float[np.ndarray, "images"],
) -> Rays:
    """The rays as cameras see them that change; those of all others as they are.

    `motions` are those of the images (`camera_motions`), `clock` is their time from the middle of the flight (s). A
    point at the edge of the format may be seen a little beyond it.
    """
    xy = rays.xy.copy()
    for name in recipe.rates | recipe.shutters:
        own = np.flatnonzero(np.array(flight.cameras)[rays.image] == name)
        if not len(own):
            continue
        image, rates, shutter = rays.image[own], recipe.rates.get(name), recipe.shutters.get(name)
        readout_s = 1e-3 * float(shutter.truth.readout) if shutter else 0.0
        place = (flight.exterior.position, flight.exterior.camera_from_object)
        camera = (recipe.cameras[name].truth, rates.truth if rates else STEADY)
        xy[own] = in_chunks(
            lambda *rows: _seen(*jax.tree.map(np.float64, camera), *rows),  # noqa: B023
            _CHUNK,
            np.full(len(own), readout_s / recipe.sensors[name].height_mm),
            motions[image],
            clock[image],
            *(np.asarray(v)[image] for v in place),
            points[rays.point[own]],
        )
    return rays._replace(xy=xy)


@jax.jit
def _seen(interior, rates, time_per_mm, motion, in_flight, position, camera_from_object, point):
    def one(time_per_mm, motion, in_flight, position, camera_from_object, point):
        # Rates ask nothing else of an exposure.
        changed = rates.interior(interior, Exposure(in_flight, motion[:3], motion[3:]))
        moving = dataclasses.replace(changed, rows=RowMotion(time_per_mm, *motion))
        return project(moving, ExteriorOrientation(position, camera_from_object), point)

    return jax.vmap(one)(time_per_mm, motion, in_flight, position, camera_from_object, point)


def with_rates(
    recipe: Recipe, start: Unknowns, priors: Unknowns, truth: Unknowns
) -> tuple[Unknowns, Unknowns, Unknowns]:
    """Start, priors and truth with the rates of the cameras; the truth has those that the block does not know, too."""
    known = {name: own.model for name, own in recipe.rates.items() if own.model}

    def more(unknowns: Unknowns, rates: dict[str, CameraRates]) -> Unknowns:
        own: dict[str, dict[str, AbstractParameters]] = {CameraRates.kind: dict(rates)} if rates else {}
        return dataclasses.replace(unknowns, more=unknowns.more | own)

    return (
        more(start, {name: model[0] for name, model in known.items()}),
        more(priors, {name: model[1] for name, model in known.items()}),
        more(truth, {name: own.truth for name, own in recipe.rates.items()}),
    )
