"""image_points.csv -> the points, in order of first appearance, and the measured image coordinates in mm."""

from typing import NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.arrays import on_device
from jaxphoto.camera import Sensor
from jaxphoto.errors import BlockError, InputError
from jaxphoto.io.block_folder.images import Images, refuse_duplicates
from jaxphoto.io.block_folder.settings import Settings
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import ImageRows

# How far outside the format, in parts of its half, a measurement may lie: beyond, it is in another unit.
_OUTSIDE = 1.5


class ObservedPoints(NamedTuple):
    """The observed points and their rows; `lines` is the line of the table each row comes from."""

    table: Table
    ids: tuple[str, ...]
    rows: ImageRows
    lines: np.ndarray

    def find(self, ids: np.ndarray) -> np.ndarray:
        """The index of each point, -1 where it is observed in no image."""
        return pd.Index(self.ids).get_indexer(pd.Index(ids))


def read_image_points(table: Table, images: Images, settings: Settings) -> ObservedPoints:
    """The measurements, sorted by point and image. Raises InputError and BlockError (see `tests/io`)."""
    if not len(table):
        raise BlockError(f"{table.file}: there are no image points; list what was measured in the images")
    image = images.find(table)
    named = table.ids("point")
    refuse_duplicates(
        table, {"image": table.text("image"), "point": named}, "point {point} is measured twice in image {image}"
    )
    sensors = [settings.cameras[camera].sensor for camera in images.cameras]
    pixel = np.array([s.pixel_mm for s in sensors])[image]
    xy = _coordinates(table, image, sensors)
    sigma = _sigmas(table, pixel, settings)
    point, ids = pd.factorize(named)
    order = np.lexsort((image, point))
    rows = ImageRows(image[order], point[order], on_device(xy[order]), on_device(sigma[order]))
    return ObservedPoints(table, tuple(ids), rows, order)


def check_rays(points: ObservedPoints, images: Images, held: np.ndarray) -> None:
    """Raise BlockError for an image with fewer than 3 points, or a point of one ray that no control holds.

    `held` (points,) is true where a control coordinate or a fixed one is known.
    """
    per_image = np.bincount(points.rows.image, minlength=len(images.ids))
    for i in np.flatnonzero(per_image < 3):
        raise images.table.misfit(
            i,
            f"image {images.ids[i]} has {per_image[i]} point(s) in {points.table.file}, but an orientation needs 3; "
            "measure more or delete the image",
        )
    per_point = np.bincount(points.rows.point, minlength=len(points.ids))
    for j in np.flatnonzero((per_point < 2) & ~held):
        line = points.lines[np.flatnonzero(points.rows.point == j)[0]]
        raise points.table.misfit(
            line,
            f"point {points.ids[j]} is measured in one image only, so its position is open; measure it in another, "
            "delete the row, or make it a control point",
        )


def _coordinates(table: Table, image: np.ndarray, sensors: list[Sensor]) -> np.ndarray:
    """(n, 2) millimetres from the image centre, from whichever pair of columns there is."""
    pairs = [pair for pair in (("x_mm", "y_mm"), ("column_px", "row_px")) if any(name in table for name in pair)]
    if len(pairs) != 1 or not all(name in table for name in pairs[0]):
        raise InputError(
            f"{table.file}: the coordinates are not given by one pair of columns; use either x_mm and y_mm or "
            "column_px and row_px"
        )
    values = np.stack([table.numbers(name) for name in pairs[0]], axis=1)
    half = np.array([(s.width_mm, s.height_mm) for s in sensors])[image] / 2
    if pairs[0][0] == "x_mm":
        hint = "give millimetres from the image centre, or name the columns column_px and row_px if these are pixels"
        xy = values
    else:
        hint = "give pixels from the upper left corner, and check the camera's width_px and height_px"
        pixel = np.array([s.pixel_mm for s in sensors])[image][:, None]
        xy = (values * pixel - half) * np.array([1.0, -1.0])
    for line, axis in np.argwhere(np.abs(xy) > _OUTSIDE * half):
        raise table.bad(line, f"{pairs[0][axis]} = {values[line, axis]:g} lies far outside the image; {hint}")
    return xy


def _sigmas(table: Table, pixel: np.ndarray, settings: Settings) -> np.ndarray:
    """(n, 2) in millimetres, from the columns or, where they are absent or empty, from [sigmas]."""
    in_mm = np.stack([table.sigmas("sigma_x_mm"), table.sigmas("sigma_y_mm")], axis=1)
    in_px = table.sigmas("sigma_px")[:, None] * pixel[:, None] * np.ones(2)
    for line in np.flatnonzero((~np.isnan(in_mm) & ~np.isnan(in_px)).any(axis=1)):
        raise table.bad(line, "sigma_px stands beside sigma_x_mm or sigma_y_mm; keep one of them")
    default = np.full_like(in_mm, np.nan)
    if "image_mm" in settings.sigmas:
        default[:] = settings.sigmas["image_mm"]
    elif "image_px" in settings.sigmas:
        default[:] = settings.sigmas["image_px"] * pixel[:, None]
    sigma = np.where(np.isnan(in_mm), np.where(np.isnan(in_px), default, in_px), in_mm)
    for line in np.flatnonzero(np.isnan(sigma).any(axis=1)):
        raise table.bad(
            line,
            "there is no standard deviation; add the column sigma_px, the columns sigma_x_mm and sigma_y_mm, or "
            f"image_mm (or image_px) under [sigmas] in {settings.file}",
        )
    return sigma
