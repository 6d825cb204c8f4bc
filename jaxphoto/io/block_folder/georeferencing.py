"""stations.csv and attitudes.csv -> what GNSS and an IMU observed."""

import numpy as np

from jaxphoto.arrays import on_device
from jaxphoto.io.block_folder.control import default_sigma
from jaxphoto.io.block_folder.images import Images, check_angles, refuse_duplicates
from jaxphoto.io.block_folder.settings import Settings
from jaxphoto.io.block_folder.table_layout import ATTITUDE, SIGMA_ATTITUDE, SIGMA_XYZ, XYZ
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import Attitudes, StationRows


def read_stations(table: Table, images: Images, settings: Settings) -> StationRows:
    """Observed positions, one row per coordinate given."""
    image = images.find(table)
    refuse_duplicates(table, {"image": table.text("image")}, "image {image} has two stations")
    value = np.stack([table.numbers(name, empty=True) for name in XYZ], axis=1)
    sigma = np.stack([table.sigmas(name) for name in SIGMA_XYZ], axis=1)
    for line in np.flatnonzero(np.isnan(value).all(axis=1)):
        raise table.bad(line, "the station has no coordinate; give at least one, or delete the row")
    lines, axes = np.nonzero(~np.isnan(value))
    for i, a in zip(lines, axes, strict=True):
        if np.isnan(sigma[i, a]):
            sigma[i, a] = default_sigma(table, i, SIGMA_XYZ[a], settings, "station_m")
    return StationRows(image[lines], axes, on_device(value[lines, axes]), on_device(sigma[lines, axes]))


def read_attitudes(table: Table, images: Images, settings: Settings) -> Attitudes:
    """Observed attitudes, in radians."""
    image = images.find(table)
    refuse_duplicates(table, {"image": table.text("image")}, "image {image} has two attitudes")
    degrees = np.stack([table.numbers(name) for name in ATTITUDE], axis=1)
    check_angles(table, degrees, ATTITUDE)
    sigma = np.stack([table.sigmas(name) for name in SIGMA_ATTITUDE], axis=1)
    for i, a in np.argwhere(np.isnan(sigma)):
        sigma[i, a] = default_sigma(table, i, SIGMA_ATTITUDE[a], settings, "attitude_deg")
    return Attitudes(image, on_device(np.deg2rad(degrees)), on_device(np.deg2rad(sigma)))
