"""A table of exposures, one line a photograph: our own, a CSV with a header, or another's (docs/exposures.md)."""

from collections import Counter
from collections.abc import Container
from pathlib import Path, PureWindowsPath
from typing import get_args

import jax
import numpy as np

from jaxphoto.compiling import jit_quickly
from jaxphoto.errors import InputError, quoted
from jaxphoto.georeferencing.camera_attitude import USUAL_SIGMA_DEG, CameraAttitude, level_from_belly
from jaxphoto.georeferencing.datum_change import wgs84_places
from jaxphoto.georeferencing.gps import Fix, Heights
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.io.exposures.other_tables import GEOGRAPHIC, MAP, OtherTable, read_other_table
from jaxphoto.io.exposures.records import Exposures, check_places
from jaxphoto.io.text_tables import Table, content_lines, read_csv
from jaxphoto.rotation import matrix_from_omega_phi_kappa

_OPK, _RPY = ("omega_deg", "phi_deg", "kappa_deg"), ("roll_deg", "pitch_deg", "yaw_deg")
_SIGMA_M = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
_SIGMA_OPK, _SIGMA_RPY = tuple(f"sigma_{name}" for name in _OPK), tuple(f"sigma_{name}" for name in _RPY)
_LARGEST_DEG = 360.0


def read_table(
    path: Path, code: int | None = None, heights: Heights = "unknown", without: Container[int] = ()
) -> Exposures:
    """The exposures of a CSV: image, and X_m, Y_m, Z_m (EPSG system `code`) or longitude_deg, latitude_deg, height_m.

    Optional are omega_deg, phi_deg, kappa_deg or roll_deg, pitch_deg, yaw_deg (of the camera: all zero where it looks
    down with the top of its picture to the north that the coordinates have), standard deviations sigma_X_m ...
    sigma_yaw_deg, and fix (fixed, float, single). Tables of other programs are those of `other_tables`; a system that
    they name counts, not `code`. The rows `without` are passed over. Raises InputError, naming file
    and row.
    """
    read = (
        _read_own(path, without)
        or read_other_table(path, without)
        or OtherTable(read_csv(path, ("image",), without=without), None, False)
    )
    table, system, vertical = read.table, read.system, None
    if system is not None and system.crs is not None:
        code, vertical = system.code, system.vertical
        on_ellipsoid = read.ellipsoid or vertical is not None or len(system.crs.axis_info) > 2
        heights = "ellipsoid" if on_ellipsoid else heights
    # Windows' strokes are read everywhere.
    ids = [PureWindowsPath(name).stem for name in table.ids("image")]
    often = Counter(ids)
    twice = np.array([often[name] > 1 for name in ids], bool)
    table.check(twice, lambda k: f"the image {quoted(ids[int(k)])} stands there twice; keep one of the lines")
    on_map = _set_of(table, MAP, GEOGRAPHIC, "positions") is MAP
    if on_map and code is None:
        raise InputError(f"{path.name}: its positions are map coordinates; give the EPSG code of their system (--epsg)")
    place = _columns(table, MAP if on_map else GEOGRAPHIC)
    turn = np.broadcast_to(np.eye(3), (len(place), 3, 3))
    if on_map and len(place):
        assert code is not None
        place, grid = _from_map(table, place, code, vertical, heights == "ellipsoid")
        turn = turn if read.true_north and _RPY[0] in table else grid
    check_places(path.name, table.rows, place)
    sigma = np.stack([table.sigmas(name) for name in _SIGMA_M], axis=1)
    return Exposures(
        path.name,
        table.rows,
        np.full(len(ids), np.nan),
        place,
        sigma,
        tuple(_fixes(table)),
        heights,
        names=tuple(ids),
        attitude=tuple(_attitudes(table, turn)),
    )


def _read_own(path: Path, without: Container[int]) -> OtherTable | None:
    """A table whose header has the names of one set of positions, as they are; None for another."""
    lines, _ = content_lines(path, without)
    header = {cell.strip() for cell in lines[0].replace(";", ",").split(",")} if lines else set()
    if not lines or "image" not in header or not any(header.issuperset(names) for names in (MAP, GEOGRAPHIC)):
        return None
    optional = (*MAP, *GEOGRAPHIC, *_OPK, *_RPY, *_SIGMA_M, *_SIGMA_OPK, *_SIGMA_RPY, "fix")
    return OtherTable(read_csv(path, ("image",), optional, text=("fix",), without=without), None, False)


def _set_of(table: Table, one: tuple[str, ...], other: tuple[str, ...], what: str) -> tuple[str, ...] | None:
    """The one of two sets of columns that the table has."""
    there = [names for names in (one, other) if any(name in table for name in names)]
    if len(there) > 1 or (there and not all(name in table for name in there[0])):
        raise InputError(
            f"{table.file}: the {what} are not given by one set of columns; use either {', '.join(one)} or "
            f"{', '.join(other)}"
        )
    if not there and what == "positions":
        raise InputError(f"{table.file}: it has no {what}; add {', '.join(one)} or {', '.join(other)}")
    return there[0] if there else None


def _columns(table: Table, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([table.numbers(name) for name in names], axis=1)


def _from_map(
    table: Table, coordinates: np.ndarray, code: int, vertical: int | None, ellipsoidal: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Longitude, latitude, height of WGS 84, and the turns from axes of the map's grid to those of true north."""
    place = MapFrame(code, vertical, (0.0, 0.0, 0.0)).place(coordinates)
    outside = ~np.isfinite(place).all(axis=1)
    table.check(outside, lambda _: f"the coordinates lie where EPSG:{code} does not reach; correct them or the code")
    frame = MapFrame(code, None, (*np.median(place[:, :2], axis=0).tolist(), 0.0))
    local = frame.local_from_place(place)
    turn = np.swapaxes(frame.local_from_level(local), 1, 2) @ frame.local_from_grid(local)
    return wgs84_places(code, place, ellipsoidal), turn


def _attitudes(table: Table, level_from_axes: np.ndarray):
    """Of each line, None where it has no angles."""
    names = _set_of(table, _OPK, _RPY, "attitudes")
    if names is None:
        yield from [None] * len(table)
        return
    angles = np.stack([table.numbers(name, empty=True) for name in names], axis=1)
    told = np.isfinite(angles)
    table.check(
        told.any(axis=1) & ~told.all(axis=1),
        lambda k: f"{names[int(np.argmin(told[k]))]} is empty; give all three angles, or none",
    )
    angles = np.nan_to_num(angles)
    for name, angle in zip(names, angles.T, strict=True):
        large = np.abs(angle) > _LARGEST_DEG
        table.check(large, lambda k: f"{name} = {angle[k]:g} is more than a turn; give degrees")  # noqa: B023
    sigma = np.stack([table.sigmas(name) for name in (_SIGMA_OPK if names is _OPK else _SIGMA_RPY)], axis=1)
    if names is _OPK:
        # Near the nadir, which is what such tables are of: omega is about x, right, as pitch; phi about y, as roll.
        sigma = sigma[:, [1, 0, 2]]
        turned = np.swapaxes(np.asarray(_matrices(np.deg2rad(angles))), 1, 2)
    else:
        turned = np.array([level_from_belly(yaw, pitch, roll) for roll, pitch, yaw in angles]).reshape(-1, 3, 3)
    for matrix, own, known in zip(level_from_axes @ turned, sigma.tolist(), told[:, 0], strict=True):
        said = (own[0], own[1], own[2]) if np.isfinite(own).all() else USUAL_SIGMA_DEG
        yield CameraAttitude(matrix, said) if known else None


def _fixes(table: Table):
    known, cells = get_args(Fix), table.text("fix")
    table.check(
        np.array([cell not in ("", *known) for cell in cells], bool),
        lambda k: f"fix is {quoted(cells[k])}; give one of {', '.join(known)}, or nothing",
    )
    yield from (cell or "unknown" for cell in cells)


_matrices = jit_quickly(jax.vmap(matrix_from_omega_phi_kappa))
