"""Blocks and observations with known truth."""

from jaxphoto.simulation.convergent_plan import ConvergentPlan, Field, Station
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
    "ROLES", "ROLLING", "Approximation", "Assumed", "Bias", "Choice", "ConvergentPlan", "Field", "FlightPlan",
    "Footprint", "Jitter", "Points", "RandomWaves", "Rays", "Recipe", "Sigmas", "Simulation", "Station", "Strip",
    "Swaths", "Targets", "Terrain", "Wave", "footprint", "image_coordinates", "photograph", "remeasure", "simulate",
]  # fmt: skip
