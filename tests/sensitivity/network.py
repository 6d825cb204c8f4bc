"""A small network to design: four strips of two images over 36 points."""

import numpy as np

from jaxphoto import Brown, InteriorOrientation, Sensor
from jaxphoto.sensitivity.network.layout import StripDesign, StripPlan

SENSOR = Sensor(4500, 3000, 0.008)
INTERIOR = InteriorOrientation(34.25, 0.064, 0.273, Brown(k1=-9.12e-5, k2=1.0435e-7))
FREE = ("c_mm", "xp_mm", "yp_mm", "k1")


def _plan() -> StripPlan:
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(*[np.linspace(-750.0, 750.0, 6)] * 2), axis=-1).reshape(-1, 2)
    ground = np.column_stack([grid + rng.normal(0, 40, grid.shape), rng.uniform(-60, 60, len(grid))])
    return StripPlan(
        interior=INTERIOR,
        points=ground,
        turn=rng.normal(0, 0.03, (8, 3)),
        shift=rng.normal(0, 15, (8, 3)),
        base=400.0,
        reach=200.0,
        image_sigma=0.004,
        control_sigma=0.03,
        station_sigma=0.1,
        images=(2, 2, 2, 2),
        sensor=SENSOR,
        free=FREE,
    )


PLAN = _plan()
USUAL = StripDesign(
    heading=np.deg2rad([75.0, 255.0, 165.0, 345.0]),
    height=np.array([1000.0, 1000.0, 1000.0, 1000.0]),
    across=np.array([170.0, 170.0, 170.0, 170.0]),
    along=np.zeros(4),
    roll=np.zeros(4),
    pitch=np.zeros(4),
    control=np.array([[120.0, -340.0]]),
)
