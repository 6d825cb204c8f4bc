"""The tables of a block in an EPSG system, brought to the local frame of the adjustment, and back.

A point or station that is not given whole (height control) is completed for the way, there and back, by what else is
known of it: its other rows, then its approximate coordinates.
"""

from collections.abc import Callable, Mapping
from typing import NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxphoto.block import Frame
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing.map_frame import MapFrame, map_system
from jaxphoto.io.block_folder.images import check_angles
from jaxphoto.io.block_folder.table_layout import ANGLES, ATTITUDE, VELOCITY, XYZ, coordinate_names
from jaxphoto.io.text_tables import Table
from jaxphoto.io.trajectory import Records
from jaxphoto.rotation import (
    matrix_from_omega_phi_kappa,
    matrix_from_roll_pitch_yaw,
    omega_phi_kappa_from_matrix,
    roll_pitch_yaw_from_matrix,
)

# How far (degrees) a block may reach beyond the area that a system is meant for.
_BEYOND = 3.0
_PLACED = ("images", "control_points", "stations", "object_points")

Numbers = dict[str, pd.DataFrame]
Refuse = Callable[[str, int, str], NoReturn]


def tables_to_local(tables: Mapping[str, Table], frame: Frame) -> dict[str, Table]:
    """The tables of a block folder with X_m, Y_m, Z_m and all angles in the local frame; others as they are.

    `frame` has its origin. Raises InputError where a row cannot be converted.
    """
    names = dict(zip(coordinate_names(frame), XYZ, strict=True))
    for name, columns in (("images", ANGLES), ("attitudes", ATTITUDE)):
        table = tables[name]
        check_angles(table, np.stack([table.numbers(c, empty=True) for c in columns], axis=1), columns)
    numbers = {name: _numbers(tables[name], names) for name in (*_PLACED, "attitudes")}

    def refuse(name: str, line: int, message: str) -> NoReturn:
        raise tables[name].bad(line, message)

    converted = dict(tables)
    for name, local in _converted(numbers, frame, False, refuse).items():
        table = tables[name]
        kept = {column: values for column, values in table.columns.items() if column not in names}
        turned = {c: _text(local[c].to_numpy()) for c in local if c in (*XYZ, *ANGLES, *ATTITUDE, *VELOCITY)}
        converted[name] = Table(table.file, kept | turned, table.files, table.rows)
    return converted


def tables_to_map(tables: Numbers, frame: Frame) -> Numbers:
    """The tables of `write_block` in the system of `frame`: the inverse of `tables_to_local`."""

    def refuse(name: str, line: int, message: str) -> NoReturn:
        raise BlockError(f"{name}.csv, entry {line + 1}: {message}")

    converted = _converted({name: tables[name] for name in (*_PLACED, "attitudes")}, frame, True, refuse)
    names = dict(zip(XYZ, coordinate_names(frame), strict=True))
    return tables | {name: columns.rename(columns=names) for name, columns in converted.items()}


def origin_of(
    tables: Mapping[str, Table], frame: Frame, trajectory: Records | None
) -> tuple[float, float, float] | None:
    """A round place amid the coordinates of the tables, or of the trajectory, height zero; None where there are none.

    Raises InputError where those of one file are not in the area of the system.
    """
    assert frame.code is not None
    # Places do not depend on the origin, which is not known yet.
    system, names = MapFrame(frame.code, frame.vertical, (0.0, 0.0, 0.0)), coordinate_names(frame)
    placed = []
    for table in (tables[name] for name in _PLACED if all(column in tables[name] for column in names)):
        values = np.stack([table.numbers(column, empty=True) for column in names], axis=1)
        values = values[~np.isnan(values).any(axis=1)]
        placed.append((table.file, values, system.place(values)))
    if trajectory is not None:
        values = trajectory.coordinates
        placed.append((trajectory.file, values, values if trajectory.geographic else system.place(values)))
    for file, values, places in placed:
        if len(values):
            _check_area(file, np.median(values, axis=0), np.median(places, axis=0), frame)
    of_tables = [places for _, _, places in (placed if trajectory is None else placed[:-1]) if len(places)]
    places = np.concatenate(of_tables or [places for _, _, places in placed] or [np.zeros((0, 3))])
    if not len(places):
        return None
    longitude, latitude, _ = np.median(places, axis=0)
    return round(float(longitude), 4), round(float(latitude), 4), 0.0


def _check_area(file: str, coordinates: np.ndarray, place: np.ndarray, frame: Frame) -> None:
    """Raise InputError where the middle of a file's `coordinates`, at `place`, is not in the area of the system."""
    assert frame.code is not None
    area, names, (longitude, latitude, _) = map_system(frame.code).area_of_use, coordinate_names(frame), place
    if area is None:
        return
    west, south, east, north = area.bounds
    outside = west <= east and not west - _BEYOND <= longitude <= east + _BEYOND
    if outside or not south - _BEYOND <= latitude <= north + _BEYOND or not np.isfinite(longitude):
        about = ", ".join(f"{value:.1f}" for value in coordinates[:2])
        raise InputError(
            f"{file}: the coordinates, about ({about}), lie outside the area of EPSG:{frame.code} ({area.name}); "
            f"correct the code, or the coordinates ({names[0]} is east, {names[1]} north)"
        )


def _numbers(table: Table, names: dict[str, str]) -> pd.DataFrame:
    """Ids and role as text, all else that is to be converted as numbers, coordinates named `XYZ`.

    What is converted together is there together: NaN where the file lacks a column.
    """
    columns = {column: table.columns[column] for column in ("image", "point", "role") if column in table}
    for together in (tuple(names), ANGLES, ATTITUDE, VELOCITY):
        if any(column in table for column in together):
            columns |= {names.get(column, column): table.numbers(column, empty=True) for column in together}
    return pd.DataFrame(columns)


def _converted(tables: Numbers, frame: Frame, back: bool, refuse: Refuse) -> Numbers:
    """All tables to the local frame, or back. Completed coordinates serve the conversion and are not kept."""
    system, converted = frame.map, dict(tables)
    control, images = tables["control_points"], tables["images"]
    role = control["role"] if "role" in control else pd.Series("", index=control.index)
    sources = {
        "control_points": [control[role != "check"], tables["object_points"], control],
        "stations": [images],
        "images": [],
        "object_points": [],
    }
    local: dict[str, np.ndarray] = {}
    for name, others in sources.items():
        table = tables[name]
        if not set(XYZ) <= set(table.columns):
            continue
        given = table[list(XYZ)].to_numpy(float)
        whole = _completed(table, given, others)
        partly = np.isnan(whole).any(axis=1)
        if name != "images":
            for line in np.flatnonzero(partly & ~np.isnan(given).all(axis=1)):
                missing = XYZ[int(np.flatnonzero(np.isnan(whole[line]))[0])]
                where = "images.csv" if name == "stations" else "object_points.csv"
                refuse(
                    name,
                    int(line),
                    f"the conversion from EPSG:{frame.code} needs {missing} too, at least approximately; add the row "
                    f"to {where}",
                )
        # The incomplete orientation of an image is kept for the warning that it is not used.
        to = given.copy()
        to[~partly] = system.map(whole[~partly]) if back else system.local(whole[~partly])
        for line in np.flatnonzero((~np.isfinite(to) & ~np.isnan(given)).any(axis=1)):
            refuse(name, int(line), f"the coordinates lie where EPSG:{frame.code} does not reach; correct them")
        local[name] = whole if back else to
        columns = table.assign(**dict(zip(XYZ, np.where(np.isnan(given), np.nan, to).T, strict=True)))
        if name == "images" and ANGLES[0] in columns:
            columns = _turned(columns, ANGLES, system.local_from_grid, local[name], back)
        if name == "stations" and VELOCITY[0] in columns:
            columns = _turned(columns, VELOCITY, system.local_from_grid, local[name], back)
        converted[name] = columns
    attitudes = tables["attitudes"]
    if len(attitudes):
        places = [
            tables[n].assign(**dict(zip(XYZ, local[n].T, strict=True))) for n in ("stations", "images") if n in local
        ]
        at = _completed(attitudes, np.full((len(attitudes), 3), np.nan), places)
        for line in np.flatnonzero(np.isnan(at).any(axis=1)):
            refuse(
                "attitudes",
                int(line),
                f"north and the vertical in EPSG:{frame.code} depend on the position, which neither stations.csv nor "
                "images.csv gives; add it",
            )
        axes = system.local_from_level if frame.yaw == "true" else system.local_from_grid
        converted["attitudes"] = _turned(attitudes, ATTITUDE, axes, at, back)
    return converted


def _completed(table: pd.DataFrame, given: np.ndarray, sources: list[pd.DataFrame]) -> np.ndarray:
    """`given` with what is missing from the first of `sources` that has it of the same point or image."""
    values = given.copy()
    for source in sources:
        key = "point" if "point" in source else "image"
        for axis, column in enumerate(XYZ):
            missing = np.isnan(values[:, axis])
            if missing.any() and column in source:
                known = source.dropna(subset=[column]).drop_duplicates(key).set_index(key)[column]
                values[missing, axis] = table[key][missing].map(known)
    return values


def _turned(
    table: pd.DataFrame, columns: tuple[str, ...], axes: Callable, local: np.ndarray, back: bool
) -> pd.DataFrame:
    """Angles or velocities in axes of the files at `local` as they are in axes of the local frame, or back."""
    values = table[list(columns)].to_numpy(float, copy=True)
    known = ~np.isnan(values).any(axis=1) & ~np.isnan(local).any(axis=1)
    turn = axes(local[known])
    if back:
        turn = np.swapaxes(turn, 1, 2)
    values[known] = _TURNS[columns](turn, values[known])
    return table.assign(**dict(zip(columns, values.T, strict=True)))


@eqx.filter_jit
@jax.vmap
def _turned_camera(turn, degrees):
    camera = matrix_from_omega_phi_kappa(jnp.deg2rad(degrees))
    return jnp.rad2deg(omega_phi_kappa_from_matrix(camera @ turn.T))


@eqx.filter_jit
@jax.vmap
def _turned_body(turn, degrees):
    return jnp.rad2deg(roll_pitch_yaw_from_matrix(turn @ matrix_from_roll_pitch_yaw(jnp.deg2rad(degrees))))


def _turned_vector(turn: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", turn, vector)


_TURNS: dict[tuple[str, ...], Callable] = {
    ANGLES: _turned_camera,
    ATTITUDE: _turned_body,
    VELOCITY: _turned_vector,
}


def _text(values: np.ndarray) -> np.ndarray:
    """Cells that read as the same numbers, empty for NaN."""
    cells = np.empty(len(values), object)
    cells[:] = ["" if np.isnan(v) else repr(float(v)) for v in values]
    return cells
