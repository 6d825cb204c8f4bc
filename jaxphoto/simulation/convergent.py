"""Convergent images: a flight without motion."""

import numpy as np

from jaxphoto.block import Motion
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.simulation.convergent_plan import ConvergentPlan
from jaxphoto.simulation.flight import Flight, turned
from jaxphoto.simulation.recipe import Jitter, triple
from jaxphoto.simulation.streams import stream


def take_images(plan: ConvergentPlan, jitter: Jitter, mean_height: float, seed: int) -> Flight:
    """Take the images of `plan`, with jitter; the centre of the field is at the height `mean_height` (m)."""
    stations, rng = plan.stations, stream(seed, "flight")
    n = len(stations)
    middle = np.array([0.0, 0.0, mean_height])
    position = middle + np.stack([s.position for s in stations])
    position = position + rng.standard_normal((n, 3)) * triple(jitter.position_m)
    deviation = np.deg2rad([jitter.angle_deg, jitter.angle_deg, jitter.crab_deg])
    planned = ExteriorOrientation(position, np.stack([s.camera_from_object for s in stations]))  # type: ignore[arg-type]
    return Flight(
        tuple(s.name for s in stations),
        tuple(s.camera for s in stations),
        ("",) * n,
        np.zeros(n),
        ExteriorOrientation(position, turned(planned, rng.standard_normal((n, 3)) * deviation)),  # type: ignore[arg-type]
        Motion(np.zeros((n, 3)), np.deg2rad(jitter.rate_deg_per_s) * rng.standard_normal((n, 3))),
    )
