"""Simulation of blocks and observations with known truth."""

from jaxphoto.simulation.buildings import ROOFS, Building
from jaxphoto.simulation.convergent_plan import ConvergentPlan, Field, Station
from jaxphoto.simulation.flight_plan import FlightPlan, Footprint, Strip, Swaths, footprint
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
from jaxphoto.simulation.remeasure import image_coordinates, remeasure
from jaxphoto.simulation.scan_plan import ScanPlan
from jaxphoto.simulation.settlement import Buildings, Settlement, Trees
from jaxphoto.simulation.simulate import Simulation, simulate
from jaxphoto.simulation.terrain import ROLLING, RandomWaves, Terrain, Wave
from jaxphoto.simulation.trees import Tree
from jaxphoto.simulation.visibility import Rays, photograph

__all__ = [
    "ROLES",
    "ROLLING",
    "ROOFS",
    "Approximation",
    "Assumed",
    "Building",
    "Buildings",
    "CameraWalk",
    "Choice",
    "ConvergentPlan",
    "Cooling",
    "Field",
    "FlightPlan",
    "Footprint",
    "Jitter",
    "PointPlan",
    "RandomWaves",
    "Rays",
    "Recipe",
    "ScanPlan",
    "Settlement",
    "Sigmas",
    "SimulatedBias",
    "SimulatedChange",
    "SimulatedShutter",
    "Simulation",
    "Station",
    "Strip",
    "Swaths",
    "TargetPlan",
    "Terrain",
    "Tree",
    "Trees",
    "Wave",
    "footprint",
    "image_coordinates",
    "photograph",
    "remeasure",
    "simulate",
]  # fmt: skip
