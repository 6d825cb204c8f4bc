"""Simulation of blocks and observations with known truth."""

from jaxphoto.simulation.plans import (
    ConvergentPlan,
    Field,
    FlightPlan,
    Footprint,
    ScanPlan,
    Station,
    Strip,
    Swaths,
    footprint,
)
from jaxphoto.simulation.points import Rays, photograph
from jaxphoto.simulation.recipe import (
    ROLES,
    Approximation,
    Assumed,
    CameraWalk,
    Choice,
    Cooling,
    Jitter,
    PointPlan,
    Recipe,
    Sigmas,
    SimulatedBias,
    SimulatedChange,
    SimulatedShutter,
    TargetPlan,
)
from jaxphoto.simulation.scene import (
    ROLLING,
    ROOFS,
    Building,
    Buildings,
    RandomWaves,
    Settlement,
    Terrain,
    Tree,
    Trees,
    Wave,
)
from jaxphoto.simulation.simulate import Simulation, image_coordinates, remeasure, simulate

__all__ = [
    "ROLES", "ROLLING", "ROOFS", "Approximation", "Assumed", "Building", "Buildings", "CameraWalk", "Choice",
    "ConvergentPlan", "Cooling", "Field", "FlightPlan", "Footprint", "Jitter", "PointPlan", "RandomWaves", "Rays",
    "Recipe", "ScanPlan", "Settlement", "Sigmas", "SimulatedBias", "SimulatedChange", "SimulatedShutter", "Simulation",
    "Station", "Strip", "Swaths", "TargetPlan", "Terrain", "Tree", "Trees", "Wave", "footprint", "image_coordinates",
    "photograph", "remeasure", "simulate",
]  # fmt: skip
