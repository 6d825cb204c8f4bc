"""Convert the tables of a block in an EPSG system to the local frame of the adjustment, and back.

For the conversion, missing coordinates of a point or station (height control) are completed from its other rows, then
from its approximate coordinates.
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
from jaxphoto.georeferencing.map_frame import MapFrame, check_area
from jaxphoto.io.block_folder.table_layout import ANGLES, ATTITUDE, TOML, VELOCITY, XYZ, coordinate_names
from jaxphoto.io.text_tables import Table
from jaxphoto.io.trajectory import Records
from jaxphoto.rotation import (
    matrix_from_omega_phi_kappa,
    matrix_from_roll_pitch_yaw,
    omega_phi_kappa_from_matrix,
    roll_pitch_yaw_from_matrix,
)

# Maximum distance (m) of the block from its origin; the vertical is tilted by 3 degrees there.
_FAR_M = 3e5
_PLACED = ("images", "control_points", "stations", "object_points")

ArrayLike = dict[str, pd.DataFrame]
Refuse = Callable[[str, int, str], NoReturn]


def tables_to_local(tables: Mapping[str, Table], frame: Frame) -> dict[str, Table]:
    """Convert X_m, Y_m, Z_m and all angles of a block folder to the local frame; other columns are unchanged.

    `frame` has its origin. Raises InputError for rows that cannot be converted.
    """
    names = dict(zip(coordinate_names(frame), XYZ, strict=True))
    converted_names = (*XYZ, *ANGLES, *ATTITUDE, *VELOCITY)

    def as_numbers(table: Table) -> pd.DataFrame:
        columns = {column: table.columns[column] for column in ("image", "point", "role") if column in table}
        for together in (tuple(names), ANGLES, ATTITUDE, VELOCITY):
            if any(column in table for column in together):
                columns |= {names.get(column, column): table.numbers(column, empty=True) for column in together}
        return pd.DataFrame(columns)

    def refuse(name: str, line: int, message: str) -> NoReturn:
        raise tables[name].bad(line, message)

    converted = dict(tables)
    for name, local in _converted(
        {n: as_numbers(tables[n]) for n in (*_PLACED, "attitudes")}, frame, False, refuse
    ).items():
        table = tables[name]
        columns = {column: values for column, values in table.columns.items() if column not in names}
        columns |= {column: local[column].to_numpy() for column in local if column in converted_names}
        converted[name] = Table(table.file, columns, table.files, table.rows)
    return converted


def tables_to_map(tables: ArrayLike, frame: Frame) -> ArrayLike:
    """Convert the tables of `write_block` to the system of `frame`: the inverse of `tables_to_local`."""

    def refuse(name: str, line: int, message: str) -> NoReturn:
        raise BlockError(f"{name}.csv, entry {line + 1}: {message}")

    converted = _converted({name: tables[name] for name in (*_PLACED, "attitudes")}, frame, True, refuse)
    names = dict(zip(XYZ, coordinate_names(frame), strict=True))
    return tables | {name: columns.rename(columns=names) for name, columns in converted.items()}


def with_origin(frame: Frame, tables: Mapping[str, Table], trajectory: Records | None, file: str) -> Frame:
    """Return the frame with its origin: from block.toml, or the rounded median of the coordinates at height zero.

    Raises InputError if the coordinates of a file are outside the area of the system, or far from the origin.
    """
    assert frame.code is not None
    # Use a zero origin: longitude and latitude do not depend on it.
    system, names = MapFrame(frame.code, frame.vertical, (0.0, 0.0, 0.0)), coordinate_names(frame)
    cure = f"correct the code in {TOML}, or the coordinates ({names[0]} is east, {names[1]} north)"
    placed: list[np.ndarray] = []
    for table in (tables[name] for name in _PLACED if all(column in tables[name] for column in names)):
        values = table.matrix(names, empty=True)
        values = values[~np.isnan(values).any(axis=1)]
        if len(values):
            placed.append(system.place(values))
            check_area(frame.code, placed[-1], table.file, values, cure)
    if trajectory is not None:
        values = trajectory.coordinates
        places = values if trajectory.geographic else system.place(values)
        check_area(frame.code, places, trajectory.file, values, cure)
        placed = placed or [places]
    if not placed:
        if frame.origin is None:
            raise InputError(
                f"{file}, [frame]: the block has no coordinates to place its origin; add origin = [longitude, "
                "latitude, height] in degrees and metres"
            )
        return frame
    longitude, latitude, _ = np.median(np.concatenate(placed), axis=0)
    middle = round(float(longitude), 4), round(float(latitude), 4), 0.0
    located = Frame(frame.kind, frame.code, frame.vertical, frame.yaw, frame.origin or middle)
    distance = float(np.linalg.norm(located.map.local_from_place(np.array([middle]))))
    if distance > _FAR_M:
        raise InputError(
            f"{file}, [frame] origin: it is {distance / 1e3:.0f} km from the block, which is near "
            f"({middle[0]:.4f}, {middle[1]:.4f}) degrees; correct it or remove the key"
        )
    _refuse_far_rows(tables, located, names)
    return located


def _refuse_far_rows(tables: Mapping[str, Table], frame: Frame, names: tuple[str, ...]) -> None:
    """Raise RowError for a row of surveyed or recorded coordinates that is far from the others."""
    for table in (tables[name] for name in ("stations", "control_points", "images") if names[0] in tables[name]):
        values = table.matrix(names, empty=True)
        whole = np.flatnonzero(~np.isnan(values).any(axis=1))
        distance = np.linalg.norm(frame.map.local(values[whole]), axis=1)
        for line, far in zip(whole[distance > _FAR_M], distance[distance > _FAR_M], strict=True):
            raise table.bad(
                line,
                f"the position is {far / 1e3:.0f} km from the block: a placeholder, or another zone of the map? "
                "Correct or delete the row",
            )


def _converted(tables: ArrayLike, frame: Frame, back: bool, refuse: Refuse) -> ArrayLike:
    """Convert all tables to the local frame, or back. Completed coordinates are used, but not returned."""
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
        # Retain incomplete orientations of images: the reader warns that they are not used.
        for line in np.flatnonzero(partly & ~np.isnan(given).all(axis=1)) if name != "images" else ():
            missing = XYZ[int(np.flatnonzero(np.isnan(whole[line]))[0])]
            where = "images.csv" if name == "stations" else "object_points.csv"
            refuse(
                name,
                int(line),
                f"the conversion from EPSG:{frame.code} needs {missing} too, at least approximately; add the row to "
                f"{where}",
            )
        to = given.copy()
        to[~partly] = system.map(whole[~partly]) if back else system.local(whole[~partly])
        for line in np.flatnonzero((~np.isfinite(to) & ~np.isnan(given)).any(axis=1)):
            refuse(name, int(line), f"the coordinates are outside the area of EPSG:{frame.code}; correct them")
        local[name] = whole if back else to
        columns = table.assign(**dict(zip(XYZ, np.where(np.isnan(given), np.nan, to).T, strict=True)))
        for vectors in (ANGLES,) if name == "images" else (VELOCITY,) if name == "stations" else ():
            if vectors[0] in columns:
                columns = _rotated(columns, vectors, system.local_from_grid, local[name], back)
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
        converted["attitudes"] = _rotated(attitudes, ATTITUDE, axes, at, back)
    return converted


def _completed(table: pd.DataFrame, given: np.ndarray, sources: list[pd.DataFrame]) -> np.ndarray:
    """Complete missing values of `given` from the first of `sources` that has them for the same point or image."""
    values = given.copy()
    for source in sources:
        key = "point" if "point" in source else "image"
        for axis, column in enumerate(XYZ):
            missing = np.isnan(values[:, axis])
            if missing.any() and column in source:
                known = source.dropna(subset=[column]).drop_duplicates(key).set_index(key)[column]
                values[missing, axis] = table[key][missing].map(known)
    return values


def _rotated(
    table: pd.DataFrame, columns: tuple[str, ...], axes: Callable, local: np.ndarray, back: bool
) -> pd.DataFrame:
    """Rotate angles or velocities from the axes of the files at `local` to the local frame, or back."""
    values = table[list(columns)].to_numpy(float, copy=True)
    known = ~np.isnan(values).any(axis=1) & ~np.isnan(local).any(axis=1)
    rotation = axes(local[known])
    if back:
        rotation = np.swapaxes(rotation, 1, 2)
    values[known] = _ROTATIONS[columns](rotation, values[known])
    return table.assign(**dict(zip(columns, values.T, strict=True)))


@eqx.filter_jit
@jax.vmap
def _rotated_camera(rotation, degrees):
    camera = matrix_from_omega_phi_kappa(jnp.deg2rad(degrees))
    return jnp.rad2deg(omega_phi_kappa_from_matrix(camera @ rotation.T))


@eqx.filter_jit
@jax.vmap
def _rotated_body(rotation, degrees):
    return jnp.rad2deg(roll_pitch_yaw_from_matrix(rotation @ matrix_from_roll_pitch_yaw(jnp.deg2rad(degrees))))


def _rotated_vector(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", rotation, vector)


_ROTATIONS: dict[tuple[str, ...], Callable] = {
    ANGLES: _rotated_camera,
    ATTITUDE: _rotated_body,
    VELOCITY: _rotated_vector,
}
