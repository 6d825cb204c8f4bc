"""Options that say where in the format cameras are compared: a grid, and how far it reaches."""

import math

import numpy as np

from jaxphoto.camera import Sensor
from jaxphoto.errors import InputError
from jaxphoto.stability import UNKNOWNS, image_grid


def points_of(sensor: Sensor, grid: str, extent: str | None) -> np.ndarray:
    """The image points (mm) of --grid 15x11 and --extent 4.0x3.0. Raises InputError for options that say none."""
    columns, rows = _grid(grid)
    return image_grid(sensor, columns, rows, _extent(extent))


def check_grid(grid: str, extent: str | None) -> None:
    """Raise InputError for options that say no grid, before anything is read."""
    _grid(grid)
    _extent(extent)


def _grid(text: str) -> tuple[int, int]:
    columns, rows = _pair("--grid", text, "15x11")
    least = max(UNKNOWNS.values()) // 2 + 1
    if columns != int(columns) or rows != int(rows) or min(columns, rows) < 2 or columns * rows < least:
        raise InputError(f"--grid {text}: give whole numbers of 2 or more, like 15x11")
    return int(columns), int(rows)


def _extent(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    width, height = _pair("--extent", text, "4.0x3.0")
    if not (width > 0 and height > 0):
        raise InputError(f"--extent {text}: give a positive width and height in mm, like 4.0x3.0")
    return width, height


def _pair(option: str, text: str, like: str) -> tuple[float, float]:
    try:
        first, second = (float(part) for part in text.lower().split("x"))
    except ValueError:
        raise InputError(f"{option} {text}: give two numbers with an x between them, like {like}") from None
    if not (math.isfinite(first) and math.isfinite(second)):
        raise InputError(f"{option} {text}: give two numbers with an x between them, like {like}")
    return first, second
