"""A DBAT script and the text files it names -> the tables of a block folder."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.table_layout import SIGMA_XYZ, XYZ
from jaxphoto.io.dbat.script import Script, include_cameras, open_script
from jaxphoto.io.dbat.script_camera import camera_settings
from jaxphoto.io.text_tables import Table, concatenate, finite, read_columns

CAMERA = "camera"
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_INPUT = ("c", "ctrl_pts", "check_pts", "images", "image_pts", "cameras", "prior_eo")
_DEGREES = {"degrees": 1.0, "radian": float(np.rad2deg(1.0)), "gon": 0.9}
# Columns of prior_eo: the position, its angles, and the standard deviations of a position, together or by axis.
_POSITION, _ANGLES, _SIGMAS = ("x", "y", "z"), ("omega", "phi", "kappa"), ("sxyz", "sx", "sy", "sz")


def recognises(source: Path) -> bool:
    """Whether `source` is a DBAT script, or a folder that holds exactly one."""
    return len(_scripts(source)) == 1


def read_dbat(source: Path) -> BlockTables:
    """The block of a DBAT script. Raises InputError for what it asks that this reader cannot do."""
    scripts = _scripts(source)
    if len(scripts) != 1:
        raise InputError(f"{source} holds {len(scripts)} DBAT scripts; name the one XML file to read")
    path = scripts[0]
    script = open_script(path)
    for element in script.input:
        if element.tag not in _INPUT:
            raise script.error(f"<{element.tag}> in <input> cannot be read; remove it, or convert the project by hand")
    include_cameras(script)
    images = _images(script)
    camera = camera_settings(script)
    tables = {
        "images": Table(
            images.file,
            {"image": images.text("name"), "camera": np.full(len(images), CAMERA, object)},
            images.files,
            images.rows,
        ),
        "image_points": _image_points(script, images, camera["pixel_mm"]),
    }
    if script.input.find("prior_eo") is not None:
        prior = _prior_orientations(script, images)
        tables["images"] = _oriented(tables["images"], prior)
        if (stations := _observed_stations(prior)) is not None:
            tables["stations"] = stations
    control = [_control(script, "ctrl_pts", ""), _control(script, "check_pts", "check")]
    if given := [table for table in control if table is not None]:
        tables["control_points"] = concatenate(given)
    settings: dict[str, Any] = {"title": script.text("meta/name", path.stem), "cameras": {CAMERA: camera}}
    if script.text("operations/operation/set_datum", "") == "depend":
        # Any datum without constraints too many gives the same interior orientation, residuals and sigma naught.
        settings["datum"] = {"kind": "minimal"}
    return BlockTables(settings, tables, path.name)


def _scripts(source: Path) -> list[Path]:
    paths = sorted(source.glob("*.xml")) if source.is_dir() else [source] if source.suffix == ".xml" else []
    return [path for path in paths if path.is_file() and _names_itself(path)]


def _names_itself(path: Path) -> bool:
    with path.open("rb") as file:
        return b"dbat_script_version" in file.read(2000)


def _read(script: Script, element: ET.Element) -> Table:
    """The file of a <file> element, its columns named by the attribute `format`."""
    return read_columns(script.file(element), [name.strip() for name in element.get("format", "").split(",")])


def _images(script: Script) -> Table:
    """Columns id and name: the file's stem, or the id where stems are not unique."""
    elements = script.find("input/images").findall("file")
    if not elements:
        raise script.error("<images> names no file; add <file format='id,path'>")
    table = concatenate([_read(script, element) for element in elements])
    _need(script, "images", table, "id", "path")
    stems = [Path(path.replace("\\", "/")).stem for path in table.text("path")]
    names = table.ids("id") if len(set(stems)) < len(stems) else np.array(stems, object)
    return Table(table.file, {"id": table.ids("id"), "name": names}, table.files, table.rows)


def _prior_orientations(script: Script, images: Table) -> Table:
    """What <prior_eo> says: image, camera positions in metres, angles in degrees where it has them, and sigmas."""
    metres = _metres(script)
    names = dict(zip(images.text("id"), images.text("name"), strict=True))
    parts = []
    for element in script.find("input/prior_eo").findall("file"):
        table, unit = _read(script, element), element.get("units", "")
        _need(script, "prior_eo", table, "id", *_POSITION)
        if other := [name for name in table.columns if name not in ("id", "label", *_POSITION, *_ANGLES, *_SIGMAS)]:
            raise script.error(f"<prior_eo> has the column {quoted(other[0])}, which is not read; remove it")
        for line, image in enumerate(table.ids("id")):
            if image not in names:
                raise table.bad(line, f"image {image} is not in {images.file}; add it there or delete this row")
        columns = {"image": np.array([names[image] for image in table.text("id")], object)}
        columns |= {name: table.numbers(axis) * metres for name, axis in zip(XYZ, _POSITION, strict=True)}
        if any(name in table for name in _ANGLES):
            _need(script, "prior_eo", table, *_ANGLES)
            if unit not in _DEGREES:
                raise script.error(
                    f"the units {quoted(unit)} of <prior_eo> are unknown; use one of {', '.join(_DEGREES)}"
                )
            columns |= {f"{name}_deg": table.numbers(name) * _DEGREES[unit] for name in _ANGLES}
        for name, axis in zip(SIGMA_XYZ, _POSITION, strict=True):
            sigma = _first(table, "sxyz", f"s{axis}")
            if sigma is not None:
                columns[name] = table.sigmas(sigma) * metres
        parts.append(Table(table.file, columns, table.files, table.rows))
    if len(parts) != 1:
        raise script.error(f"<prior_eo> names {len(parts)} files, and one is read; put all orientations into it")
    return parts[0]


def _oriented(images: Table, prior: Table) -> Table:
    """The images with their orientations where all six values are there."""
    columns = (*XYZ, *(f"{name}_deg" for name in _ANGLES))
    if not all(name in prior for name in columns):
        return images
    row = {name: k for k, name in enumerate(prior.text("image"))}
    place = [row.get(name) for name in images.text("image")]
    cells = {
        name: np.array(["" if k is None else repr(float(prior.columns[name][k])) for k in place], object)
        for name in columns
    }
    return Table(images.file, images.columns | cells, images.files, images.rows)


def _observed_stations(prior: Table) -> Table | None:
    """stations.csv, where the positions have standard deviations."""
    if not any(name in prior for name in SIGMA_XYZ):
        return None
    columns = {name: prior.columns[name] for name in ("image", *XYZ, *SIGMA_XYZ) if name in prior}
    return Table(prior.file, columns, prior.files, prior.rows)


def _metres(script: Script) -> float:
    unit = script.text("meta/project_unit", "m")
    if unit not in _METRES:
        raise script.error(f"the project_unit {unit!r} is unknown; use one of {', '.join(_METRES)}")
    return _METRES[unit]


def _image_points(script: Script, images: Table, pixel_mm: float) -> Table:
    names = dict(zip(images.text("id"), images.text("name"), strict=True))
    parts = []
    for element in script.find("input/image_pts").findall("file"):
        table = _read(script, element)
        _need(script, "image_pts", table, "id", "im", "x", "y")
        for line, image in enumerate(table.ids("im")):
            if image not in names:
                raise table.bad(line, f"image {image} is not in {images.file}; add it there or delete this row")
        columns = {
            "image": np.array([names[image] for image in table.text("im")], object),
            "point": table.ids("id"),
            "column_px": table.numbers("x") - 0.5,
            "row_px": table.numbers("y") - 0.5,
        }
        for axis in "xy":
            columns[f"sigma_{axis}_mm"] = _image_sigma(script, element, table, axis) * pixel_mm
        parts.append(Table(table.file, columns, table.files, table.rows))
    if not parts:
        raise script.error("<image_pts> names no file; add <file format='id,im,x,y' sxy='1'>")
    return concatenate(parts)


def _image_sigma(script: Script, element: ET.Element, table: Table, axis: str) -> np.ndarray:
    """Pixels: the attribute overrides the columns."""
    for name in ("sxy", f"s{axis}"):
        if name in element.attrib:
            value = finite(element.attrib[name])
            if value is None:
                raise script.error(f"{name} = {quoted(element.attrib[name])} is not a number; give it in pixels")
            return np.full(len(table), value)
    for name in ("sxy", f"s{axis}"):
        if name in table:
            return table.sigmas(name)
    raise script.error(f"the points of {table.file} have no standard deviation; add sxy='...' (pixels) to their <file>")


def _control(script: Script, tag: str, role: str) -> Table | None:
    """Control (role "control" with standard deviations, "fixed" without) or check points, in metres."""
    section = script.input.find(tag)
    if section is None:
        return None
    metres = _metres(script)
    elements = section.findall("file")
    if not elements:
        raise script.error(f"<{tag}> names no file; add <file format='id,label,x,y,z,sx,sy,sz'>")
    table = concatenate([control_table(_read(script, e), role, metres) for e in elements])
    for element in section.findall("filter"):
        wanted = {part.strip() for part in element.get("id", "").split(",")}
        action = (element.text or "").strip()
        if action not in ("keep", "remove") or wanted == {""}:
            raise script.error(
                f"a <filter> of <{tag}> is not understood; write <filter id='1,2'>keep or remove</filter>"
            )
        chosen = np.array([point in wanted for point in table.text("point")], bool)
        table = table.take(chosen if action == "keep" else ~chosen)
    return table


def control_table(table: Table, role: str, metres: float) -> Table:
    """A DBAT control file as control_points.csv; `role` "" is control, or fixed where no row has a sigma."""
    sigmas = {axis: _first(table, f"s{axis}", "sxy" if axis != "z" else "sz", "sxyz") for axis in "xyz"}
    columns: dict[str, np.ndarray] = {"point": table.ids("id")}
    columns |= {name: table.numbers(axis) * metres for name, axis in zip(XYZ, "xyz", strict=True)}
    zero = np.ones(len(table), bool)
    for name, sigma in zip(SIGMA_XYZ, sigmas.values(), strict=True):
        values = np.zeros(len(table)) if sigma is None else table.numbers(sigma)
        zero &= values == 0
        columns[name] = values * metres
    # DBAT's standard deviation zero means that the point is held.
    columns["role"] = (
        np.where(zero, "fixed", "control").astype(object) if not role else np.full(len(table), role, object)
    )
    for name in SIGMA_XYZ:
        cells = columns[name]
        columns[name] = np.array(["" if z else repr(float(s)) for s, z in zip(cells, zero, strict=True)], object)
    return Table(table.file, columns, table.files, table.rows)


def _first(table: Table, *names: str) -> str | None:
    return next((name for name in names if name in table), None)


def _need(script: Script, tag: str, table: Table, *columns: str) -> None:
    for name in columns:
        if name not in table:
            raise script.error(f"the format of <{tag}> has no {name}; add it ({', '.join(columns)} are needed)")
