"""Simulated laser points over known ground."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest


def ground(height: Callable, density: float, sigma_z: float, sigma_xy: float, side: float, seed: int = 0) -> np.ndarray:
    """Laser points of a square, off by normal errors."""
    rng = np.random.default_rng(seed)
    true = rng.uniform(0, side, (rng.poisson(density * side**2), 2))
    z = height(*true.T) + rng.normal(0, sigma_z, len(true))
    return np.column_stack([true + rng.normal(0, sigma_xy, true.shape), z])


def gable(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Roofs in a row, 16 m wide, of 30 degrees."""
    return np.tan(np.radians(30)) * (8 - np.abs(x % 16 - 8))


SURFACES = {
    "plane": lambda x, y: 100 + 0 * x,
    "slope 20 deg": lambda x, y: np.tan(np.radians(20)) * x,
    "slope 45 deg": lambda x, y: np.cos(0.7) * x + np.sin(0.7) * y,
    "gable": gable,
    "rolling": lambda x, y: 5 * np.sin(x / 15) + 4 * np.cos(y / 12 + 0.3),
}


def read_autzen(data_dir: Path) -> np.ndarray:
    """X, Y, Z (feet) of a real cloud; its test is skipped where there is none."""
    path = data_dir / "lidar" / "autzen_trim.laz"
    if not path.exists():
        pytest.skip(f"no {path}: set JAXPHOTO_DATA to the folder that holds lidar/autzen_trim.laz")
    laspy = pytest.importorskip("laspy")
    las = laspy.read(path)
    return np.column_stack([las.x, las.y, las.z])


def places_over(xyz: np.ndarray, n: int = 10_000) -> np.ndarray:
    return np.random.default_rng(0).uniform(xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0), (n, 2))
