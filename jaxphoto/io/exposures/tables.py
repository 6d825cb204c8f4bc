"""Tables of exposures, by photograph, of jaxphoto and other programs.

    jaxphoto      image, X_m, Y_m, Z_m or longitude_deg, latitude_deg, height_m [, omega_deg, phi_deg, kappa_deg or
                  roll_deg, pitch_deg, yaw_deg] [, sigma_X_m ... sigma_yaw_deg] [, fix]
    Pix4D         imagename,latitude,longitude,altitude[,accuracy horizontal,accuracy vertical] and
                  omega,phi,kappa or yaw,pitch,roll
    Metashape     #Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll[,X_acc ...], #CoordinateSystem: WKT above it
    --to opk      imageName X Y Z Omega Phi Kappa, with a comment about the system
    OpenDroneMap  geo.txt: the system in the first line, then name x y z [yaw pitch roll [accuracy in plan, in height]];
                  angles that are all 0 are unknown
    POSPac        exterior orientation as text (POS Export Utility): a head of free text with the mapping frame, then
                  ID, # EVENT, TIME (s), EASTING, NORTHING, ELLIPSOID HEIGHT, OMEGA, PHI, KAPPA [, LAT, LONG]

Cells are separated by tabs, semicolons, commas or blanks; header words in any case and order. Yaw, pitch and roll are
of a camera that looks down with the top of its picture to the north at zero; yaw counts from true north (ours:
from the north of the coordinates), omega, phi, kappa from grid north. Positions are those of the camera.
Sources: Pix4D support, articles 202558539 and 202558969; OpenDroneMap documentation, "Image Geolocation Files", and its
`compute_opk`; Agisoft Metashape User Manual, "Reference pane"; POSPac's head in the comments of auvlib
(github.com/nilsbore/auvlib, src/data_tools/src/csv_data.cpp).
"""

import re
from collections.abc import Sequence
from pathlib import PureWindowsPath
from typing import NamedTuple, get_args

import jax
import numpy as np
import pandas as pd
from pyproj import Transformer

from jaxphoto.compiling import jit_quickly
from jaxphoto.errors import InputError, RowError, quoted
from jaxphoto.georeferencing.camera_attitude import USUAL_SIGMA_DEG, CameraAttitude, level_from_belly
from jaxphoto.georeferencing.datum_change import wgs84_places
from jaxphoto.georeferencing.gps import Fix, Heights
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.io.control_table import PLACE, SYSTEM, columns_of, in_degrees, separator_of, split_row
from jaxphoto.io.exposures.records import Exposures, Lines
from jaxphoto.procedures.control.surveyed import ControlSystem, system_of
from jaxphoto.rotation import matrix_from_omega_phi_kappa

_OPK, _RPY = ("omega", "phi", "kappa"), ("roll", "pitch", "yaw")
_SIGMA = ("sigma_x", "sigma_y", "sigma_z")
_WORDS = {
    "image": ("image", "imagename", "image name", "label", "photo", "photograph", "filename", "file name", "name"),
    **PLACE,
    **{name: (name,) for name in (*_OPK, *_RPY)},
    **{f"sigma_{name}": (f"sigma {name}", f"{name} acc", f"accuracy {name}") for name in (*_OPK, *_RPY)},
    "fix": ("fix",),
    "enabled": ("enable", "enabled"),
}
_ODM = ("image", "x", "y", "z", "yaw", "pitch", "roll", "sigma_plan", "sigma_z")
_WKT = re.compile(r"#\s*CoordinateSystem:\s*(\S.*)$", re.IGNORECASE)
_EPSG = re.compile(r"\b(EPSG::?\s*\d{4,6}(?:\s*\+\s*\d{4,6})?)", re.IGNORECASE)
_GON = re.compile(r"\b(gons?|grads?|gradians?)\b", re.IGNORECASE)
_POSPAC = re.compile(r"\bPOS Export Utility\b|\bPOSEO\b|\bApplanix\b", re.IGNORECASE)
_POSPAC_COLUMNS = {
    "x": "EASTING", "y": "NORTHING", "z": "ELLIPSOID HEIGHT", "omega": "OMEGA", "phi": "PHI", "kappa": "KAPPA",
    "image": "ID",
}  # fmt: skip
# UTM zones of EPSG, before the first zone of each datum, north and south.
_UTM = {"WGS84": (32600, 32700), "WGS 84": (32600, 32700), "ETRS89": (25800, None), "NAD83": (26900, None)}


class _Table(NamedTuple):
    cells: pd.DataFrame
    """Text by row number; columns are keys of `_WORDS`."""
    geographic: bool
    system: ControlSystem | None
    true_north: bool
    """True if yaw counts from true north in map coordinates, too."""
    ellipsoid: bool


def read_table(file: str, lines: Lines, errors: dict[int, str], code: int | None, heights: Heights) -> Exposures:
    """Read a table; `errors` takes the invalid rows, `code` is the EPSG system of map coordinates.

    Raises InputError for a table without image, position or heights, with angles in gon, or without a system.
    """
    cells, geographic, system, true_north, ellipsoid = _table(file, lines, errors)
    vertical = None
    if system is not None and system.crs is not None:
        code, vertical = system.code, system.vertical
        above_ellipsoid = ellipsoid or vertical is not None or len(system.crs.axis_info) > 2
        heights = "ellipsoid" if above_ellipsoid else heights
    on_map = system is not None or not geographic
    if on_map and code is None:
        raise InputError(f"{file}: its positions are map coordinates; give the EPSG code of their system (--epsg)")
    rows = cells.index.to_numpy(int)

    def check(invalid: np.ndarray | pd.Series, name: str, requirement: str) -> None:
        for k in np.flatnonzero(invalid):
            value = quoted(cells[name].iloc[k]) if cells[name].iloc[k] else "empty"
            errors.setdefault(int(rows[k]), f"{name} is {value}; {requirement}")

    numbers = {}
    for name in cells.columns.difference(["image", "fix", "enabled"]):
        numbers[name] = pd.to_numeric(cells[name], errors="coerce").to_numpy(float)
        optional = (cells[name] == "") & (name not in "xyz")
        check(~np.isfinite(numbers[name]) & ~optional, name, "give a finite number, or delete the row")
        if name.startswith("sigma"):
            check(numbers[name] <= 0, name, "a standard deviation is positive")
    ids = [PureWindowsPath(name).stem for name in cells["image"]]
    check(cells["image"] == "", "image", "give its name, or delete the row")
    check(pd.Series(ids).duplicated(keep=False), "image", "it is there twice: keep one of the rows")
    fixes = cells["fix"] if "fix" in cells else pd.Series([""] * len(ids), cells.index)
    if "fix" in cells:
        check(~fixes.isin(["", *get_args(Fix)]), "fix", f"give one of {', '.join(get_args(Fix))}, or nothing")
    place = np.stack([numbers[name] for name in "xyz"], axis=1)
    turn = np.broadcast_to(np.eye(3), (len(place), 3, 3))
    finite = np.isfinite(place).all(axis=1)
    if on_map and finite.any():
        assert code is not None
        # Rows that are not finite are skipped: any place serves.
        place, grid = _from_map(np.where(finite[:, None], place, place[finite][0]), code, vertical, heights)
        check(~np.isfinite(place).all(axis=1), "x", f"the coordinates are outside the area of EPSG:{code}")
        turn = turn if true_north and _RPY[0] in numbers else grid
    unknown = np.full(len(ids), np.nan)
    exposures = Exposures(
        file,
        rows,
        unknown,
        place,
        np.stack([numbers.get(name, unknown) for name in _SIGMA], axis=1),
        tuple(fixes.replace("", "unknown")),  # type: ignore[arg-type]
        heights,
        names=tuple(ids),
    )
    names = next((names for names in (_OPK, _RPY) if set(names) <= set(numbers)), None)
    if names is None:
        return exposures._replace(attitude=(None,) * len(ids))
    angles = np.stack([numbers[name] for name in names], axis=1)
    known = np.isfinite(angles)
    for name, angle, present in zip(names, angles.T, known.T, strict=True):
        check(~present & known.any(axis=1), name, "give all three angles, or none")
        check(np.abs(angle) > 360, name, "give degrees")
    sigma = np.stack([numbers.get(f"sigma_{name}", unknown) for name in names], axis=1)
    return exposures._replace(attitude=_attitudes(angles, sigma, turn, names is _OPK))


def _table(file: str, lines: Lines, errors: dict[int, str]) -> _Table:
    content = [(row, line) for row, line in lines if not line.lstrip().startswith("#")]
    comments = [line.strip() for _, line in lines[:20] if line.lstrip().startswith("#")]
    if not content:
        raise InputError(f"{file}: the file is empty; give it a header with the columns image, X_m, Y_m, Z_m")
    if SYSTEM.match(content[0][1].strip()):
        return _open_drone_map(file, content, errors)
    if any(_POSPAC.search(line) for _, line in content[:10]):
        return _pospac(file, content, errors)
    separator = separator_of(content[0][1])
    records = {}
    for row, line in content:
        try:
            records[row] = split_row(file, line, row, separator)
        except RowError:
            errors[row] = "the quotation marks do not pair; close or remove them"
    first = records.get(content[0][0], [])
    comment_cells = [line.lstrip("# ").split(None if separator == " " else separator) for line in comments]
    for header in (first, *comment_cells):
        columns = columns_of(header, _WORDS)
        if {"image", "x", "y"} <= set(columns) and len(header) <= len(first):
            break
    else:
        raise InputError(f"{file}: the column image is missing, or coordinates are (X_m, Y_m, Z_m); add a header")
    if "z" not in columns:
        raise InputError(f"{file}: its header names no heights (Z, altitude or height); add them")
    if set(columns) & {*_OPK, *_RPY} and _GON.search(" ".join([*comments, *header])):
        raise InputError(f"{file}: its angles are in gon; give degrees")
    if header is first:
        del records[content[0][0]]
    table = _cells(records, columns, errors, surplus=len(header))
    if separator != ",":
        text = table.columns.isin(["image", "fix", "enabled"])
        table.loc[:, ~text] = table.loc[:, ~text].apply(lambda column: column.str.replace(",", "."))
    if "enabled" in table:
        table = table[~table["enabled"].str.lower().isin(["0", "false", "no"])]
    words = [match[1] for line in comments for pattern in (_WKT, _EPSG) if (match := pattern.search(line))]
    own_yaw = "yaw" in columns and header[columns["yaw"]].lower() == "yaw_deg"
    return _Table(
        table,
        in_degrees(header, columns),
        _system(file, words[0]) if words else None,
        not own_yaw,
        any("heights above the ellipsoid" in line for line in comments),
    )


def _cells(
    records: dict[int, list[str]], columns: dict[str, int], errors: dict[int, str], surplus: int | None = None
) -> pd.DataFrame:
    """The cells of rows by the names of their columns."""
    for row, cells in list(records.items()):
        if surplus is not None and len(cells) > surplus:
            errors[row] = f"{len(cells)} cells, but the header has {surplus}; correct the row"
            del records[row]
    padded = [[cells[k] if k < len(cells) else "" for k in columns.values()] for cells in records.values()]
    table = pd.DataFrame(padded, index=list(records), columns=list(columns), dtype=object)
    if "sigma_plan" in table:
        table = table.assign(sigma_x=table["sigma_plan"], sigma_y=table["sigma_plan"]).drop(columns="sigma_plan")
    elif "sigma_x" in table:
        table = table.assign(**{name: table["sigma_x"] for name in _SIGMA if name not in table})
    return table


def _open_drone_map(file: str, content: Lines, errors: dict[int, str]) -> _Table:
    records = {row: line.split() for row, line in content[1:]}
    for cells in records.values():
        if cells[4:7] and all(re.fullmatch(r"[-+]?0*\.?0*", cell) for cell in cells[4:7]):
            cells[4:7] = [""] * 3
    width = max(map(len, records.values()), default=0)
    # Three angles, and two accuracies.
    names = _ODM[: 9 if width >= 9 else 7 if width >= 7 else 4]
    columns = {name: k for k, name in enumerate(names)}
    return _Table(_cells(records, columns, errors), False, _system(file, content[0][1].strip()), True, False)


def _pospac(file: str, content: Lines, errors: dict[int, str]) -> _Table:
    """Exterior orientation of POSPac. Raises InputError for a trajectory, and for angles in another order."""
    headers = [[cell.partition("(")[0].strip().upper() for cell in line.split(",")] for _, line in content[:100]]
    begin = next((k for k, header in enumerate(headers) if {"TIME", "EASTING", "NORTHING"} <= set(header)), None)
    if begin is None:
        raise InputError(f"{file}: its head names no columns (TIME, EASTING, NORTHING ...); export it with its header")
    header, head = headers[begin], " ".join(line for _, line in content[:begin])
    if not set(_POSPAC_COLUMNS.values()) <= set(header):
        raise InputError(
            f"{file}: its columns are not those of photographs ({', '.join(_POSPAC_COLUMNS.values())}): export the "
            "exterior orientation at the camera's events, or take the SBET, which has the whole trajectory"
        )
    if (first := re.search(r"first rotation is around the '(\w)'", head, re.IGNORECASE)) and first[1].lower() != "x":
        raise InputError(f"{file}: its angles turn about {first[1]} first: export omega, phi, kappa")
    records = {}
    for row, line in content[begin + 1 :]:
        cells = line.replace(",", " ").split()
        if line.lstrip().startswith("("):
            continue
        if len(cells) == len(header):
            records[row] = cells
        else:
            errors[row] = f"{len(cells)} cells, and the header has {len(header)}; complete the row"
    system = _mapping_frame(file, head)
    if system is not None and {"LAT", "LONG"} <= set(header):
        assert system.crs is not None and system.crs.geodetic_crs is not None
        names = ("LONG", "LAT", "EASTING", "NORTHING")
        compared = _cells(records, {name: header.index(name) for name in names}, errors)
        place = compared.apply(pd.to_numeric, errors="coerce").to_numpy(float)
        on_map = Transformer.from_crs(system.crs.geodetic_crs, system.crs, always_xy=True)
        off = np.hypot(*(np.stack(on_map.transform(place[:, 0], place[:, 1])) - place[:, 2:].T))
        for row, metres in zip(records, off.tolist(), strict=True):
            if metres > 1.0:
                errors[row] = (
                    f"its easting and northing lie {metres:.3g} m from its latitude and longitude in {system.name}, "
                    "the mapping frame of the head; export it again, or delete the columns LAT and LONG"
                )
    table = _cells(records, {name: header.index(word) for name, word in _POSPAC_COLUMNS.items()}, errors)
    # The accuracy is that of GNSS and IMU, integrated afterwards.
    return _Table(table.assign(fix="integrated"), False, system, False, True)


def _mapping_frame(file: str, head: str) -> ControlSystem | None:
    """The UTM zone of the head; None for another system."""
    datum = re.search(r"frame datum\s*:\s*([^;]*?)\s*;", head, re.IGNORECASE)
    names = ("central meridian", "latitude of the grid origin", "scale factor", "false easting", "false northing")
    matches = [re.search(name + r"\s*=\s*(-?[\d.]+)", head, re.IGNORECASE) for name in names]
    if datum is None or None in matches or datum[1].upper() not in _UTM:
        return None
    meridian, origin, scale, easting, northing = (float(match[1]) for match in matches if match)
    zone, (north, south) = (meridian + 183) / 6, _UTM[datum[1].upper()]
    base = {0.0: north, 1e7: south}.get(northing)
    if base is None or zone != int(zone) or not 1 <= zone <= 60 or (origin, scale, easting) != (0.0, 0.9996, 5e5):
        return None
    return system_of(f"EPSG:{base + int(zone)}", file)


def _system(file: str, words: str) -> ControlSystem:
    system = system_of(words, file)
    if system.code is None or system.crs is None or system.crs.is_geocentric:
        raise InputError(f"{file}: its system ({system.name}) is not a map with an EPSG code; write EPSG:25832, say")
    return system


def _from_map(
    coordinates: np.ndarray, code: int, vertical: int | None, heights: Heights
) -> tuple[np.ndarray, np.ndarray]:
    """Longitude, latitude, height of WGS 84, and the rotations from the axes of the grid to those of true north."""
    place = MapFrame(code, vertical, (0.0, 0.0, 0.0)).place(coordinates)
    inside = np.isfinite(place).all(axis=1)
    on_wgs84, rotation = np.full_like(place, np.nan), np.tile(np.eye(3), (len(place), 1, 1))
    if inside.any():
        place = place[inside]
        frame = MapFrame(code, None, (*np.median(place[:, :2], axis=0).tolist(), 0.0))
        local = frame.local_from_place(place)
        rotation[inside] = np.swapaxes(frame.local_from_level(local), 1, 2) @ frame.local_from_grid(local)
        on_wgs84[inside] = wgs84_places(code, place, heights == "ellipsoid")
    return on_wgs84, rotation


def _attitudes(
    angles: np.ndarray, sigma: np.ndarray, level_from_axes: np.ndarray, opk: bool
) -> tuple[CameraAttitude | None, ...]:
    if opk:
        # Near the nadir, omega is about x, right, as pitch; phi about y, as roll.
        sigma = sigma[:, [1, 0, 2]]
        camera = np.swapaxes(np.asarray(_matrices(np.deg2rad(angles))), 1, 2)
    else:
        camera = np.array([level_from_belly(yaw, pitch, roll) for roll, pitch, yaw in np.nan_to_num(angles)])
    known = np.isfinite(angles).all(axis=1) & np.isfinite(level_from_axes).all(axis=(1, 2))
    matrices = level_from_axes @ camera.reshape(-1, 3, 3)
    sigmas: Sequence = [tuple(s) if np.isfinite(s).all() else USUAL_SIGMA_DEG for s in sigma.tolist()]
    return tuple(CameraAttitude(m, s) if k else None for m, s, k in zip(matrices, sigmas, known, strict=True))


_matrices = jit_quickly(jax.vmap(matrix_from_omega_phi_kappa))
