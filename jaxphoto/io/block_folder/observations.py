"""Read the tables of a block as its observations: images, image points, control, stations, attitudes, surfaces.

Tables are `checked`: ids are text, other cells are floats, NaN if empty.
"""

import dataclasses
import warnings
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import numpy as np
import pandas as pd

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Temperatures
from jaxphoto.camera import RATES
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError, InputError, few, quoted
from jaxphoto.io.block_folder.settings import Settings, default_sigma
from jaxphoto.io.block_folder.table_layout import (
    ANGLES,
    ATTITUDE,
    FOOT,
    NORMAL,
    SIGMA_ATTITUDE,
    SIGMA_XYZ,
    TURN,
    XYZ,
    refuse_duplicates,
)
from jaxphoto.io.conditions import CONDITIONS, read_conditions
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import AXES, Attitudes, CameraPositions, ControlCoordinates, ImagePoints, SurfaceRows
from jaxphoto.unknowns import FIXED, Unknowns

ROLES = ("control", "fixed", "check")
# Maximum |x| / half width and |y| / half height of an image point; beyond it, the unit is wrong.
_OUTSIDE = 1.5
# Minimum and maximum temperature of a camera in use (degrees Celsius).
_COLDEST_C, _WARMEST_C = -90.0, 120.0
# Columns of conditions.csv, in order of preference.
_TEMPERATURES = ("lens_temperature_c", "sensor_temperature_c", "temperature_c")
# Maximum deviation of the length of a unit normal from 1; allows rounding to a few digits.
_UNIT = 1e-3

_from_angles = eqx.filter_jit(ExteriorOrientation.from_angles)


class Images(NamedTuple):
    """Images in the order of images.csv, one entry per image."""

    table: Table
    ids: tuple[str, ...]
    cameras: tuple[str, ...]
    strips: tuple[str, ...]
    times: np.ndarray
    """Seconds from the mean time of the image's strip."""
    flight_times: np.ndarray
    """Seconds from the mean time of all images."""
    middle_s: float
    """Mean time of all images on the clock of the file (s), rounded to a nanosecond."""
    exterior: ExteriorOrientation
    known: np.ndarray

    def find(self, table: Table, column: str = "image") -> np.ndarray:
        """Return the index of the image in each line of `table`. Raises BlockError for unknown images."""
        listed = self.table.file
        return table.find(column, self.ids, lambda name: f"image {name} is not in {listed}; add it or delete this row")

    @property
    def strips_are_the_flight(self) -> bool:
        """True if all strips have the same mean time, to a nanosecond: one strip, or times centred in the file."""
        return bool(np.allclose(self.flight_times, self.times, rtol=0.0, atol=1e-9))


def read_images(table: Table, settings: Settings) -> Images:
    """Read images.csv."""
    if not len(table):
        raise BlockError(f"{table.file}: no images; list at least two")
    cameras, strips, times = table.text("camera"), table.text("strip"), table.numbers("time_s", empty=True)
    table.find(
        "camera",
        tuple(settings.cameras),
        lambda name: (
            f"camera {name} has no table [cameras.{name}] in {settings.file}; add it or use one of "
            + ", ".join(settings.cameras)
        ),
    )
    table.check(
        strips == "default",
        lambda _: f"the strip name default means every strip in {settings.file}; give it another name",
    )
    values = table.matrix((*XYZ, *ANGLES), empty=True)
    known = ~np.isnan(values).any(axis=1)
    partly = np.flatnonzero(~known & ~np.isnan(values).all(axis=1))
    if len(partly):
        warnings.warn(
            f"{table.place(partly[0])}: the approximate orientation of {len(partly)} image(s) is incomplete and is not "
            "used; give all six values or none",
            UserWarning,
            stacklevel=2,
        )
    values[~known] = 0.0
    exterior = call_compiled(_from_angles, values[:, :3], np.deg2rad(values[:, 3:]))
    timed = times[~np.isnan(times)]
    return Images(
        table,
        tuple(table.text("image")),
        tuple(cameras),
        tuple(strips),
        _centred(times, strips),
        _centred(times, np.zeros(len(times))),
        round(float(timed.mean()), 9) if len(timed) else 0.0,
        exterior,
        known,
    )


def _centred(times: np.ndarray, strips: np.ndarray) -> np.ndarray:
    """Return seconds from the mean time of the image's strip; zero without a time."""
    seconds = pd.Series(times)
    return (seconds - seconds.groupby(strips).transform("mean")).fillna(0.0).to_numpy()


def partitions_of(images: Images, settings: Settings) -> dict[str, tuple[str, ...]]:
    """Return the part of each image, by partition."""
    parts = {name: images.table.text(name) for name in settings.keys.partitions}
    for name, part in parts.items():
        for line in np.flatnonzero(part == "default")[:1]:
            raise images.table.bad(line, f"the {name} default means every {name} in [unknowns]; give it another name")
    return {name: tuple(part) for name, part in parts.items()}


def with_temperatures(images: Table, folder: Path) -> Table:
    """Return images.csv with temperatures from conditions.csv in `folder`, unless it has temperatures.

    The first temperature that is known for every image is used: of the lens, else of the sensor, else of the air.
    """
    if "temperature_c" in images or not (folder / CONDITIONS).is_file():
        return images
    conditions = {one.image: one for one in read_conditions(folder / CONDITIONS)}
    rows = [conditions.get(image) for image in images.text("image")]
    for name in _TEMPERATURES:
        celsius = [getattr(row, name, None) for row in rows]
        if all(value is not None for value in celsius):
            return dataclasses.replace(images, columns=images.columns | {"temperature_c": np.array(celsius, float)})
    return images


def temperatures_of(images: Images, settings: Settings) -> Temperatures | None:
    """Return the temperatures of the cameras; None if none is known."""
    celsius = images.table.numbers("temperature_c", empty=True)
    images.table.check(
        (celsius < _COLDEST_C) | (celsius > _WARMEST_C),
        lambda k: f"temperature_c = {celsius[k]:g} is not a plausible camera temperature; give it in degrees Celsius",
    )
    known, reference = ~np.isnan(celsius), settings.keys.reference_temperature_c
    if not known.any():
        return None
    return Temperatures(as_jax_array(celsius), float(celsius[known].mean()) if reference is None else reference)


def check_times(images: Images, starts: Unknowns, priors: Unknowns) -> None:
    """Raise BlockError if an image lacks a time or temperature that a drift or a camera change requires."""

    def changes(start: object, prior: object, *names: str) -> bool:
        return any(getattr(prior, n) != FIXED or np.any(np.asarray(getattr(start, n)) != 0) for n in names)

    owners: list[tuple[str, str, tuple[str, ...], set[str]]] = []
    drifting = {name for name, start in starts.strips.items() if changes(start, priors.strips[name], "drift")}
    owners.append(("time_s", "its strip", images.strips, drifting))
    for rates in RATES:
        changing = {
            name
            for name, start in starts.more.get(rates.kind, {}).items()
            if changes(start, priors.more[rates.kind][name], *vars(start))
        }
        column = {"time_h": "time_s", "temperature_K": "temperature_c"}[rates.along]
        owners.append((column, f"in [unknowns.{rates.kind}] its camera", images.cameras, changing))
    for column, whose, names, changing in owners:
        missing = np.isnan(images.table.numbers(column, empty=True))
        for i in np.flatnonzero(missing & np.array([name in changing for name in names], bool))[:1]:
            raise images.table.misfit(
                i,
                f"image {images.ids[i]} has no {column}, but {whose} {names[i]} drifts; add the "
                f'{column.partition("_")[0]}, or make the drift or the rates "fixed"',
            )


class ObservedPoints(NamedTuple):
    """Observed points and their image points; `lines` is the line of the table of each row."""

    table: Table
    ids: tuple[str, ...]
    rows: ImagePoints
    lines: np.ndarray

    def find(self, ids: np.ndarray) -> np.ndarray:
        """Return the index of each point; -1 if it has no image point."""
        return pd.Index(self.ids).get_indexer(pd.Index(ids))


def read_image_points(table: Table, images: Images, settings: Settings) -> ObservedPoints:
    """Read the image points, sorted by point and image; points are in order of first appearance."""
    if not len(table):
        raise BlockError(f"{table.file}: no image points; add the image measurements")
    image = images.find(table)
    sensors = [settings.cameras[camera].sensor for camera in images.cameras]
    pixel = np.array([s.pixel_mm for s in sensors])[image][:, None]
    half = np.array([(s.width_mm, s.height_mm) for s in sensors])[image] / 2
    xy = _coordinates(table, pixel, half)
    sigma = _image_sigmas(table, pixel, settings)
    point, ids = pd.factorize(table.text("point"))
    order = np.lexsort((image, point))
    rows = ImagePoints(image[order], point[order], as_jax_array(xy[order]), as_jax_array(sigma[order]))
    return ObservedPoints(table, tuple(ids), rows, order)


def _coordinates(table: Table, pixel: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return (n, 2) millimetres from the image centre, from millimetre or pixel columns."""
    pairs = [pair for pair in (("x_mm", "y_mm"), ("column_px", "row_px")) if any(name in table for name in pair)]
    if len(pairs) != 1 or not all(name in table for name in pairs[0]):
        raise InputError(
            f"{table.file}: image coordinates need exactly one pair of columns; use either x_mm and y_mm or "
            "column_px and row_px"
        )
    xy = values = table.matrix(pairs[0])
    hint = "give millimetres from the image centre, or name the columns column_px and row_px if these are pixels"
    if pairs[0][0] == "column_px":
        hint = "give pixels from the upper left corner, and check the camera's width_px and height_px"
        xy = (values * pixel - half) * np.array([1.0, -1.0])
        if (np.abs(values * pixel - half[..., ::-1]) <= half[..., ::-1]).all():
            hint += "; all points fit with width and height exchanged: the pictures may have been turned by 90 degrees"
    for line, axis in np.argwhere(np.abs(xy) > _OUTSIDE * half)[:1]:
        raise table.bad(line, f"{pairs[0][axis]} = {values[line, axis]:g} is far outside the image; {hint}")
    return xy


def _image_sigmas(table: Table, pixel: np.ndarray, settings: Settings) -> np.ndarray:
    """Return (n, 2) sigmas in millimetres, from the columns; absent or empty cells are taken from [sigmas]."""
    in_mm = np.stack([table.sigmas("sigma_x_mm"), table.sigmas("sigma_y_mm")], axis=1)
    in_px = table.sigmas("sigma_px")[:, None] * pixel * np.ones(2)
    table.check(
        np.isfinite(in_mm + in_px).any(axis=1),
        lambda _: "both sigma_px and sigma_x_mm or sigma_y_mm are given; keep one of them",
    )
    default = np.full_like(in_mm, default_sigma(settings, "image_mm"))
    if "image_mm" not in settings.sigmas:
        default[:] = default_sigma(settings, "image_px") * pixel
    sigma = np.where(np.isnan(in_mm), np.where(np.isnan(in_px), default, in_px), in_mm)
    table.check(
        np.asarray(np.isnan(sigma).any(axis=1)),
        lambda _: (
            "missing standard deviation; add the column sigma_px, the columns sigma_x_mm and sigma_y_mm, or "
            f"image_mm (or image_px) under [sigmas] in {settings.file}"
        ),
    )
    return sigma


def check_rays(points: ObservedPoints, images: Images, controlled: np.ndarray) -> None:
    """Raise BlockError for an image with fewer than 3 points, or a point with one ray and no control.

    `controlled` (points,): True if a control or fixed coordinate is known.
    """
    per_image = np.bincount(points.rows.image, minlength=len(images.ids))
    for i in np.flatnonzero(per_image < 3)[:1]:
        raise images.table.misfit(
            i,
            f"image {images.ids[i]} has {per_image[i]} point(s) in {points.table.file}, but an orientation needs 3; "
            "measure more or delete the image",
        )
    per_point = np.bincount(points.rows.point, minlength=len(points.ids))
    for j in np.flatnonzero((per_point < 2) & ~controlled)[:1]:
        raise points.table.misfit(
            points.lines[np.flatnonzero(points.rows.point == j)[0]],
            f"point {points.ids[j]} is measured in one image only, which gives no position; measure it in another, "
            "delete the row, or make it a control point",
        )


class Control(NamedTuple):
    """Object coordinates by role, initial coordinates (points, 3), and masks of points.

    `known`: all three initial coordinates are known. `controlled`: at least one control or fixed coordinate.
    """

    control: ControlCoordinates
    fixed: ControlCoordinates
    check: ControlCoordinates
    start: np.ndarray
    known: np.ndarray
    controlled: np.ndarray


def sigmas_of(
    table: Table, column: str, settings: Settings, *keys: str, needed: np.ndarray | bool = True
) -> np.ndarray:
    """Read a column of sigmas; missing `needed` ones are taken from the first of `keys` in [sigmas]."""
    given = table.sigmas(column)
    sigma = np.where(np.isnan(given) & needed, default_sigma(settings, *keys), given)
    table.check(
        np.isnan(sigma) & needed,
        lambda _: (
            f"missing standard deviation; fill in the column {column}, or add {' or '.join(keys)} under [sigmas] "
            f"in {settings.file}"
        ),
    )
    return sigma


def read_control(table: Table, approximations: Table, points: ObservedPoints, settings: Settings) -> Control:
    """Read the coordinates of each role; warn (UserWarning) of points without image points and skip them.

    Initial coordinates are taken per axis from control and fixed points, else from object_points.csv. A point may have
    two rows with different axes (control in X and Y, check in Z).
    """
    start = np.full((len(points.ids), 3), np.nan)
    index = _find_or_warn(approximations, points)
    start[index[index >= 0]] = approximations.matrix(XYZ)[index >= 0]

    index, role = _find_or_warn(table, points), np.where(table.text("role") == "", "control", table.text("role"))
    table.check(
        ~np.isin(role, ROLES), lambda k: f"the role {quoted(role[k])} is unknown; write control, fixed or check"
    )
    value, lines, axes = _given_coordinates(table)
    refuse_duplicates(
        table.take(lines), {"point": table.text("point")[lines], "coordinate": np.array(AXES, object)[axes]}
    )
    sigma = np.zeros((len(table), 3))
    for a, axis in enumerate(AXES):
        needed = (role == "control") & ~np.isnan(value[:, a])
        keys = (f"control_{axis}_m", "control_m")
        sigma[:, a] = sigmas_of(table, SIGMA_XYZ[a], settings, *keys, needed=needed)
    sigma[role == "fixed"] = 0.0
    # Set missing sigmas of check coordinates to zero: they are not used in the adjustment.
    sigma = np.nan_to_num(sigma)
    rows = ControlCoordinates(index[lines], axes, as_jax_array(value[lines, axes]), as_jax_array(sigma[lines, axes]))
    by_role = {name: rows.take((role[lines] == name) & (index[lines] >= 0)) for name in ROLES}
    controlled = np.zeros(len(points.ids), bool)
    for given in (by_role["control"], by_role["fixed"]):
        start[given.who, given.axis] = given.value
        controlled[given.who] = True
    known = ~np.isnan(start).any(axis=1)
    start[~known] = 0.0
    return Control(by_role["control"], by_role["fixed"], by_role["check"], start, known, controlled)


def _given_coordinates(table: Table) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return all coordinates (n, 3), and line and axis of each cell that is not empty. Every row needs at least one."""
    value = table.matrix(XYZ, empty=True)
    table.check(np.isnan(value).all(axis=1), lambda _: "no coordinates; give at least one, or delete the row")
    lines, axes = np.nonzero(~np.isnan(value))
    return value, lines, axes


def _find_or_warn(table: Table, points: ObservedPoints) -> np.ndarray:
    """Return the index of each line's point; -1, with a warning, for points without image points."""
    named = table.text("point")
    index = points.find(named)
    if missing := list(dict.fromkeys(named[index < 0])):
        warnings.warn(
            f"{table.file}: {len(missing)} point(s) are measured in no image and are not used: {few(missing)}",
            UserWarning,
            stacklevel=2,
        )
    return index


def check_datum_points(over: object, points: ObservedPoints, file: str) -> None:
    """Raise InputError for datum points without image points."""
    if isinstance(over, tuple):
        for name, index in zip(over, points.find(np.array(over, object)), strict=True):
            if index < 0:
                raise InputError(f"{file}, [datum] over: point {name} is measured in no image; remove it from the list")


def read_stations(table: Table, images: Images, settings: Settings) -> CameraPositions:
    """Read observed positions, one row per coordinate."""
    image, (value, lines, axes) = images.find(table), _given_coordinates(table)
    needed = ~np.isnan(value)
    columns = enumerate(SIGMA_XYZ)
    sigma = np.stack([sigmas_of(table, c, settings, "station_m", needed=needed[:, a]) for a, c in columns], axis=1)
    return CameraPositions(image[lines], axes, as_jax_array(value[lines, axes]), as_jax_array(sigma[lines, axes]))


def read_attitudes(table: Table, images: Images, settings: Settings) -> Attitudes:
    """Read observed attitudes (rad)."""
    sigma = np.stack([sigmas_of(table, c, settings, "attitude_deg") for c in SIGMA_ATTITUDE], axis=1)
    degrees = table.matrix(ATTITUDE)
    return Attitudes(images.find(table), as_jax_array(np.deg2rad(degrees)), as_jax_array(np.deg2rad(sigma)))


def read_surfaces(table: Table, strips: tuple[str, ...], points: ObservedPoints, settings: Settings) -> SurfaceRows:
    """Read points on laser-scanned surfaces. Values are in the object frame, even if other files are in a map system.

    `strips`: strips with a table [scanner.shifts.X].
    """
    message = "is measured in no image; measure it or delete the row"
    point = table.find("point", points.ids, lambda name: f"point {name} {message}")
    foot, normal, turn = (table.matrix(names) for names in (FOOT, NORMAL, TURN))
    sigma, length = table.numbers("sigma_m"), np.linalg.norm(normal, axis=1)
    table.check(np.abs(length - 1) > _UNIT, lambda k: f"the normal has length {length[k]:.4f}; give a unit vector")
    number = np.zeros(len(table), int)
    if strips:
        cure = f"to {settings.file}"
        number = table.find(
            "strip", strips, lambda name: f"strip {quoted(name)} has no table; add [scanner.shifts.{name}] {cure}"
        )
    return SurfaceRows(point, number, *map(as_jax_array, (foot, normal, turn, sigma)))
