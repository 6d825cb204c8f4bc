"""control_points.csv and object_points.csv -> control, fixed and check coordinates, and where points start."""

import warnings
from typing import NamedTuple

import numpy as np

from jaxphoto.arrays import on_device
from jaxphoto.errors import InputError, quoted
from jaxphoto.io.block_folder.image_points import ObservedPoints
from jaxphoto.io.block_folder.images import refuse_duplicates
from jaxphoto.io.block_folder.settings import Settings
from jaxphoto.io.block_folder.table_layout import SIGMA_XYZ, XYZ
from jaxphoto.io.text_tables import Line, Table
from jaxphoto.observations import AXES, ControlRows

ROLES = ("control", "fixed", "check")


class Control(NamedTuple):
    """Object coordinates by role, starting coordinates (points, 3) and for which points all three are known."""

    control: ControlRows
    fixed: ControlRows
    check: ControlRows
    start: np.ndarray
    known: np.ndarray
    held: np.ndarray


def read_control(table: Table, approximations: Table, points: ObservedPoints, settings: Settings) -> Control:
    """Control of each role; a point that no image shows is dropped with a UserWarning.

    Starting coordinates are those of control and fixed points, axis by axis, then those of object_points.csv.
    A point may stand in two rows if these give different axes (control in X and Y, check in Z).
    """
    start = np.full((len(points.ids), 3), np.nan)
    where = _find(approximations, points)
    refuse_duplicates(approximations, {"point": approximations.text("point")}, "point {point} is listed twice")
    values = np.stack([approximations.numbers(name) for name in XYZ], axis=1)
    start[where[where >= 0]] = values[where >= 0]

    # Rows of points that no image shows are checked like the others before they are dropped.
    role, rows = _read_rows(table, _find(table, points), settings)
    role, rows = role[rows.who >= 0], rows.take(rows.who >= 0)
    by_role = {name: rows.take(role == name) for name in ROLES}
    held = np.zeros(len(points.ids), bool)
    for name in ("control", "fixed"):
        given = by_role[name]
        start[given.who, given.axis] = given.value
        held[given.who] = True
    known = ~np.isnan(start).any(axis=1)
    start[~known] = 0.0
    return Control(by_role["control"], by_role["fixed"], by_role["check"], start, known, held)


def default_sigma(table: Table, line: Line, column: str, settings: Settings, *keys: str) -> float:
    """The first of `keys` that [sigmas] has. Raises InputError, naming all that would help, if none."""
    for key in keys:
        if key in settings.sigmas:
            return settings.sigmas[key]
    raise table.bad(
        line,
        f"there is no standard deviation; fill in the column {column}, or add {' or '.join(keys)} under [sigmas] in "
        f"{settings.file}",
    )


def _find(table: Table, points: ObservedPoints) -> np.ndarray:
    """The index of each line's point, -1 (and a warning) where no image shows it."""
    named = table.ids("point")
    index = points.find(named)
    missing = list(dict.fromkeys(named[index < 0]))
    if missing:
        listed = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
        warnings.warn(
            f"{table.file}: {len(missing)} point(s) are measured in no image and are not used: {listed}",
            UserWarning,
            stacklevel=2,
        )
    return index


def _read_rows(table: Table, point: np.ndarray, settings: Settings) -> tuple[np.ndarray, ControlRows]:
    """The role of each row and the rows, one per given coordinate."""
    role = np.where(table.text("role") == "", "control", table.text("role"))
    for line in np.flatnonzero(~np.isin(role, ROLES)):
        raise table.bad(line, f"the role {quoted(role[line])} is unknown; write control, fixed or check")
    value = np.stack([table.numbers(name, empty=True) for name in XYZ], axis=1)
    sigma = np.stack([table.sigmas(name) for name in SIGMA_XYZ], axis=1)
    for line in np.flatnonzero(np.isnan(value).all(axis=1)):
        raise table.bad(line, "the point has no coordinate; give at least one, or delete the row")
    lines, axes = np.nonzero(~np.isnan(value))
    refuse_duplicates(
        table.take(lines),
        {"point": table.text("point")[lines], "axis": np.array(AXES, object)[axes]},
        "{axis} of point {point} is given twice",
    )
    for i, a in zip(lines, axes, strict=True):
        if role[i] == "fixed":
            sigma[i, a] = 0.0
        elif np.isnan(sigma[i, a]) and role[i] == "control":
            keys = (f"control_{AXES[a]}_m", "control_m")
            sigma[i, a] = default_sigma(table, i, SIGMA_XYZ[a], settings, *keys)
    # A check coordinate needs no sigma: it never enters an adjustment.
    sigma = np.nan_to_num(sigma)
    rows = ControlRows(point[lines], axes, on_device(value[lines, axes]), on_device(sigma[lines, axes]))
    return role[lines], rows


def check_datum_points(over: object, points: ObservedPoints, file: str) -> None:
    """Raise InputError for a datum over points that no image shows."""
    if isinstance(over, tuple):
        for name, index in zip(over, points.find(np.array(over, object)), strict=True):
            if index < 0:
                raise InputError(f"{file}, [datum] over: point {name} is measured in no image; remove it from the list")
