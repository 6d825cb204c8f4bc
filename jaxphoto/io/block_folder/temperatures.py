"""Temperatures of cameras at their exposures: from images.csv, or as the photographs say them in conditions.csv."""

import dataclasses
from pathlib import Path

import numpy as np

from jaxphoto.arrays import on_device
from jaxphoto.block import Temperatures
from jaxphoto.io.block_folder.settings import Settings
from jaxphoto.io.conditions import CONDITIONS, read_conditions
from jaxphoto.io.text_tables import Table

COLUMN = "temperature_c"
# In conditions.csv, what lies nearest to the lens first.
_SAID = ("lens_temperature_c", "sensor_temperature_c", "temperature_c")
# Of any camera that takes photographs: beyond are kelvins, degrees Fahrenheit of a hot one and slips of the pen.
_COLDEST_C, _WARMEST_C = -90.0, 120.0


def with_temperatures(images: Table, folder: Path) -> Table:
    """images.csv with the temperatures of conditions.csv beside it, where it has none of its own.

    They are those of the lens, or else of the sensor, or else of the air: the first that is known of every image.
    """
    if COLUMN in images or not (folder / CONDITIONS).is_file():
        return images
    said = {one.image: one for one in read_conditions(folder / CONDITIONS)}
    taken = [said.get(image) for image in images.names("image")]
    for name in _SAID:
        celsius = [getattr(one, name, None) for one in taken]
        if all(value is not None for value in celsius):
            return dataclasses.replace(images, columns=images.columns | {COLUMN: np.array(celsius, float)})
    return images


def celsius_in(images: Table) -> np.ndarray:
    """The column of images.csv, NaN where it says nothing. Raises InputError for what is that of no camera."""
    celsius = images.numbers(COLUMN, empty=True)
    for line in np.flatnonzero((celsius < _COLDEST_C) | (celsius > _WARMEST_C)):
        raise images.bad(line, f"{COLUMN} = {celsius[line]:g} is that of no camera; give it in degrees Celsius")
    return celsius


def temperatures_of(celsius: np.ndarray, settings: Settings) -> Temperatures | None:
    """Those of a block, where any is known."""
    known = ~np.isnan(celsius)
    if not known.any():
        return None
    told = settings.reference_temperature_c
    reference = float(celsius[known].mean()) if told is None else told
    return Temperatures(on_device(celsius), reference)
