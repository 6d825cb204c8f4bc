"""Blocks and observations with known truth."""

from jaxphoto.simulation.flight_plan import FlightPlan, Footprint, Strip, Swaths, footprint
from jaxphoto.simulation.recipe import (
    ROLES,
    Approximation,
    Assumed,
    Bias,
    Choice,
    Jitter,
    Points,
    Recipe,
    Sigmas,
    Targets,
)
from jaxphoto.simulation.remeasure import image_coordinates, remeasure
from jaxphoto.simulation.simulate import Simulation, simulate
from jaxphoto.simulation.terrain import ROLLING, RandomWaves, Terrain, Wave
from jaxphoto.simulation.visibility import Rays, photograph

__all__ = [
    "ROLES", "ROLLING", "Approximation", "Assumed", "Bias", "Choice", "FlightPlan", "Footprint", "Jitter", "Points",
    "RandomWaves", "Rays", "Recipe", "Sigmas", "Simulation", "Strip", "Swaths", "Targets", "Terrain", "Wave",
    "footprint", "image_coordinates", "photograph", "remeasure", "simulate",
]  # fmt: skip
