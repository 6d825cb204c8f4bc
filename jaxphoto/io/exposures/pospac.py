"""Exterior orientation as text, as Applanix POSPac exports it for photographs (POS Export Utility, POSEO).

A head of free text tells the mapping frame; then a header of words between commas, units in brackets, and rows of
numbers between blanks:

    Mapping frame datum: WGS84  ; Mapping frame projection : UTM;
    central meridian = 9.000000 deg;
    latitude of the grid origin = 0.000000 deg; grid scale factor = 0.999600:
    false easting = 500000.000000 m; false northing = 0.000000 m;
    ID, # EVENT, TIME (s), EASTING, NORTHING, ELLIPSOID HEIGHT, OMEGA, PHI, KAPPA, LAT, LONG

Positions are those of the camera, lever arm and boresight of the head applied; angles are in degrees, from grid north.
Sources: the head in the comments of auvlib (github.com/nilsbore/auvlib, src/data_tools/src/csv_data.cpp), the header in
a reader of such files for a waveform lidar; no whole file is public.
"""

import re

import numpy as np
from pyproj import Transformer

from jaxphoto.io.control_files.rows import Cells
from jaxphoto.io.text_tables import finite
from jaxphoto.procedures.control.surveyed import ControlSystem, system_of

_PROGRAM = re.compile(r"\bPOS Export Utility\b|\bPOSEO\b|\bApplanix\b", re.IGNORECASE)
# The program is named in the first lines, and the head is a page at most.
_NAMED, _HEAD = 10, 100
_WANTED = ("EASTING", "NORTHING", "ELLIPSOID HEIGHT", "OMEGA", "PHI", "KAPPA")
_COLUMNS = dict(zip(("x", "y", "z", "omega", "phi", "kappa"), _WANTED, strict=True))
# Zones of UTM that EPSG has, from the first of each datum on.
_UTM = {"WGS84": (32600, 32700), "WGS 84": (32600, 32700), "ETRS89": (25800, None), "NAD83": (26900, None)}
# Between the latitude and longitude of a row and its easting and northing (m).
_SAME_M = 1.0


def read_pospac(cells: Cells) -> tuple[Cells, dict[str, int], ControlSystem | None] | None:
    """Rows, the columns of the words of `other_tables`, and the system, of the lines of a file; None for another file.

    `cells` has each line as its one cell. Raises InputError for a trajectory, for rows that are too short, for angles
    in another order and for coordinates that are not those of the mapping frame.
    """
    lines = [record[0] for record in cells.records]
    if not any(_PROGRAM.search(line) for line in lines[:_NAMED]):
        return None
    headers = [[cell.partition("(")[0].strip().upper() for cell in line.split(",")] for line in lines[:_HEAD]]
    begins = next((k for k, header in enumerate(headers) if {"TIME", "EASTING", "NORTHING"} <= set(header)), None)
    if begins is None:
        raise cells.none("its head names no columns (TIME, EASTING, NORTHING ...); export it anew with its header")
    header, head = headers[begins], " ".join(lines[:begins])
    if "ID" not in header or not set(_WANTED) <= set(header):
        raise cells.none(
            f"its columns are not those of photographs (ID, {', '.join(_WANTED)}): export the exterior orientation at "
            "the camera's events, or take the SBET, which has the whole trajectory"
        )
    # Of angles that turn about another axis first nothing is known.
    if (first := re.search(r"first rotation is around the '(\w)'", head, re.IGNORECASE)) and first[1].lower() != "x":
        raise cells.none(f"its angles turn about {first[1]} first: export omega, phi, kappa, which begin about x")
    rows = [k for k in range(begins + 1, len(lines)) if lines[k].strip() and not lines[k].lstrip().startswith("(")]
    own = Cells(cells.file, [lines[k].replace(",", " ").split() for k in rows], [cells.rows[k] for k in rows])
    own.check(
        [len(record) == len(header) for record in own.records],
        lambda k: f"{len(own.records[k])} cells, and the header has {len(header)}; complete the row",
    )
    system = _mapping_frame(cells.file, head)
    if system is not None and {"LAT", "LONG"} <= set(header):
        _check_places(own, header, system)
    # How good the position is no column says: GNSS and IMU together, afterwards.
    columns = {"image": header.index("ID"), **{name: header.index(word) for name, word in _COLUMNS.items()}}
    fixed = own._replace(records=[[*record, "integrated"] for record in own.records])
    return fixed, columns | {"fix": len(header)}, system


def _mapping_frame(file: str, head: str) -> ControlSystem | None:
    """The system of eastings and northings; None for another than a zone of UTM."""
    datum = re.search(r"frame datum\s*:\s*([^;]*?)\s*;", head, re.IGNORECASE)
    told = [
        finite(found[1]) if (found := re.search(words + r"\s*=\s*(-?[\d.]+)", head, re.IGNORECASE)) else None
        for words in (
            "central meridian",
            "latitude of the grid origin",
            "scale factor",
            "false easting",
            "false northing",
        )
    ]
    if datum is None or None in told or datum[1].upper() not in _UTM:
        return None
    meridian, origin, scale, easting, northing = told
    assert meridian is not None and northing is not None
    zone = (meridian + 183) / 6
    north, south = _UTM[datum[1].upper()]
    first = {0.0: north, 1e7: south}.get(northing)
    if first is None or zone != int(zone) or not 1 <= zone <= 60 or (origin, scale, easting) != (0.0, 0.9996, 5e5):
        return None
    return system_of(f"EPSG:{first + int(zone)}", file)


def _check_places(cells: Cells, header: list[str], system: ControlSystem) -> None:
    """Raise InputError where easting and northing are not at the latitude and longitude of their row, in degrees."""
    assert system.crs is not None and system.crs.geodetic_crs is not None
    columns = [header.index(name) for name in ("LONG", "LAT", "EASTING", "NORTHING")]
    # What is no number, as minutes and seconds are none, is not compared.
    read = [[finite(record[i]) for i in columns] for record in cells.records]
    place = np.array([[np.nan if v is None else v for v in row] for row in read]).reshape(-1, 4)
    on_map = Transformer.from_crs(system.crs.geodetic_crs, system.crs, always_xy=True)
    off = np.hypot(*(np.stack(on_map.transform(place[:, 0], place[:, 1])) - place[:, 2:].T))
    cells.check(
        ~(off > _SAME_M),
        lambda k: (
            f"its easting and northing lie {off[k]:.3g} m from its latitude and longitude in {system.name}, which the "
            "head says: export it anew, or leave the columns LAT and LONG out"
        ),
    )
