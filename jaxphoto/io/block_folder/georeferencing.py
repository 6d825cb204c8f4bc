"""stations.csv, attitudes.csv and distances.csv -> what GNSS, an IMU and scale bars observed."""

import numpy as np

from jaxphoto.arrays import on_device
from jaxphoto.block import Attitudes, Distances, Rows
from jaxphoto.io.block_folder.control import default_sigma
from jaxphoto.io.block_folder.image_points import Points
from jaxphoto.io.block_folder.images import Images, check_angles, refuse_duplicates
from jaxphoto.io.block_folder.layout import ATTITUDE, SIGMA_ATTITUDE, SIGMA_XYZ, XYZ
from jaxphoto.io.block_folder.settings import Settings
from jaxphoto.io.tables import Table


def read_stations(table: Table, images: Images, settings: Settings) -> Rows:
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
    return Rows(image[lines], axes, on_device(value[lines, axes]), on_device(sigma[lines, axes]))


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


def read_distances(table: Table, points: Points, settings: Settings) -> Distances:
    """Scale bars between observed points."""
    ends = np.stack([points.find(table.ids(name)) for name in ("point_a", "point_b")], axis=1)
    for line, end in np.argwhere(ends < 0):
        name = table.text(("point_a", "point_b")[end])[line]
        raise table.misfit(line, f"point {name} is measured in no image; measure it or delete the distance")
    for line in np.flatnonzero(ends[:, 0] == ends[:, 1]):
        raise table.bad(line, "the distance runs from a point to itself; correct point_a or point_b")
    low, high = np.sort(ends, axis=1).T
    refuse_duplicates(table, {"a": low, "b": high}, "the distance between these points is given twice")
    value = table.numbers("distance_m")
    for line in np.flatnonzero(value <= 0):
        raise table.bad(line, f"distance_m is {value[line]:g}; a distance is positive, so give its true value")
    sigma = table.sigmas("sigma_m")
    for line in np.flatnonzero(np.isnan(sigma)):
        sigma[line] = default_sigma(table, line, "sigma_m", settings, "distance_m")
    return Distances(ends, on_device(value), on_device(sigma))
