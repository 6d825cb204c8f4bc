"""DBAT (Damped Bundle Adjustment Toolbox): an XML script and the text files that it references; PhotoModeler's export.

DBAT's pixel coordinates are (1, 1) at the centre of the upper left pixel, ours (0.5, 0.5). Its principal point is in mm
from pixel (0, 0). It *adds* K, P and the aspect `as` to the measured coordinates; our Brown model subtracts them, so
all of them change sign. Model 3 applies 1 + as and the skew before the polynomial: `affine_brown` with b1 = -as;
<aspect> is 1 - as. Models 1 and 2 have neither aspect nor skew. Model 4 applies both after the polynomial:
`brown_affine`. Model 5 applies 1 + as before the principal point is subtracted, which divides px by it, and the skew
after the polynomial: `stretched_brown`. Its residuals are those of the corrected coordinates: `residuals = "model"`.
Source: DBAT, github.com/niclasborlin/dbat.

PhotoModeler's text export, optionally with DBAT's control files in the same folder.

    title; tolerance, iterations, width, height; standard deviations; c, px, py, width, height (mm), K1 K2 K3 P1 P2
    for each photograph six lines: number name; X Y Z kappa phi omega; standard deviations; covariances or nothing;
        camera; standard deviations of the camera
    an empty line, then three tables, each ended by an empty line:
        control points (id X Y Z and sigmas); object points (the same);
        marks (photograph id x y and sigmas; pixels counted as in DBAT)

K and P are added to coordinates reduced to the principal point; our Brown model subtracts them, so all change sign. px
and py are relative to DBAT's pixel (0, 0), half a pixel outside the upper left corner; y points down. Angles are
defined in docs/conventions.md, in degrees. Control points are read from `ctrlpts-weighted.txt`, camera stations from
`fake-camera-positions.txt`, in the same folder. The orientations and object points of the export are in an arbitrary
frame; they are read only if these control files do not exist.

Sources: PhotoModeler's help, "Lens Distortion Formulation" and "Decentering lens distortion"; exports distributed with
DBAT.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.files import Format, beginning, by_content, read_columns, row_numbers, warn
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.table_layout import ANGLES, SIGMA_XYZ, XYZ
from jaxphoto.io.text_files import has_words, read_text
from jaxphoto.io.text_tables import Table, concatenate, finite, is_number

CAMERA = "camera"
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_DEGREES = {"degrees": 1.0, "radian": float(np.rad2deg(1.0)), "gon": 0.9}
_INPUT = ("c", "ctrl_pts", "check_pts", "images", "image_pts", "cameras", "prior_eo")
_ANGLES, _SIGMAS = ("omega", "phi", "kappa"), ("sxyz", "sx", "sy", "sz")
# Our distortion for each of DBAT's lens models ("Backward (Photogrammetry)"), up to sign.
_MODELS = {
    "1": "affine_brown", "2": "affine_brown", "3": "affine_brown", "4": "brown_affine", "5": "stretched_brown"
}  # fmt: skip
_PARAMETERS = {
    "cc": ("c_mm",), "pp": ("xp_mm", "yp_mm"), "px": ("xp_mm",), "py": ("yp_mm",), "aspect": ("b1",), "as": ("b1",),
    "skew": ("b2",), "sk": ("b2",),
}  # fmt: skip
_CAMERA_PLACE, _ESTIMATE = "input/cameras/camera", "set_bundle_estimate_params"
CONTROL_FILE, STATIONS = "ctrlpts-weighted.txt", "fake-camera-positions.txt"
# Assumed standard deviation of image points (px), as in DBAT: the sigmas of the export are flags (1 manual, 0
# automatic).
_SIGMA_PX = 1.0
# Number of values in rows 2 to 4 of the header; row 2 may lack the size of the photographs.
_HEADERS = ((4, 9, 10), (2, 9, 10))
_LINES_PER_PHOTOGRAPH = 6
_POINT, _MARK = ("id", "x", "y", "z", "sx", "sy", "sz"), ("im", "id", "x", "y", "sx", "sy")
_ALWAYS_FREE = ("c_mm", "xp_mm", "yp_mm")
_LEAST_CONTROL = 3
# Maximum relative difference of the sides of a pixel treated as square.
_SQUARE = 1e-9


class _Script(NamedTuple):
    """DBAT script; elements are addressed by tag paths from the root."""

    path: Path
    root: ElementTree.Element

    def error(self, message: str) -> InputError:
        return InputError(f"{self.path.name}: {message}")

    def find(self, place: str) -> ElementTree.Element:
        element = self.root.find(place)
        if element is None:
            raise self.error(f"missing <{place.replace('/', '><')}>; add it")
        return element

    def text(self, place: str, default: str) -> str:
        return (self.root.findtext(place) or default).strip()

    def one_of(self, values: dict[str, Any], name: str, value: str) -> Any:
        if value not in values:
            raise self.error(f"{name} {quoted(value)} is not supported; use one of {', '.join(values)}")
        return values[value]

    def numbers(self, place: str, default: str, n: int | None = None) -> list[float]:
        """Parse the comma-separated values of an element; `n` is the required count, if given."""
        text = self.text(f"{_CAMERA_PLACE}/{place}", default)
        numbers = [value for part in text.split(",") if (value := finite(part)) is not None]
        if len(numbers) <= text.count(",") or n not in (None, len(numbers)):
            raise self.error(f"<{place}> is {quoted(text)}; give {n or ''} numbers separated by commas")
        return numbers

    def file(self, element: ElementTree.Element) -> Path:
        """Return the path of a file element, relative to the base folder of <input>."""
        base = self.find("input").get("base_dir", "$HERE").replace("$HERE", str(self.path.parent))
        name = (element.text or "").strip()
        if "$" in base or "$" in name:
            raise self.error(f"unknown folder {base} of {name}; write it with $HERE")
        return Path(base) / name

    def tables(self, tag: str, *columns: str) -> list[tuple[Table, ElementTree.Element]]:
        """Read the files of <input><tag>; the attribute `format` names their columns, `columns` are required."""
        elements = self.find(f"input/{tag}").findall("file")
        if not elements:
            raise self.error(f"<{tag}> has no file; add <file format='{','.join(columns)}'>")
        tables = []
        for element in elements:
            names = [name.strip() for name in element.get("format", "").split(",")]
            if missing := [name for name in columns if name not in names]:
                raise self.error(f"the format of <{tag}> has no {missing[0]}; {', '.join(columns)} are needed")
            tables.append((read_columns(self.file(element), names), element))
        return tables

    def setting(self, operation: str, key: str) -> str:
        """Return the text of an operation's element, or of its <all> child."""
        element = self.root.find(f"operations/operation/{operation}/{key}")
        return "default" if element is None else (element.findtext("all") or element.text or "").strip()


def _open(path: Path) -> _Script:
    return _Script(path, ElementTree.fromstring(read_text(path)))


def read(path: Path) -> BlockTables:
    """Read the block of a script. Raise InputError for unsupported input and lens models."""
    script = _open(path)
    for element in script.find("input"):
        if element.tag not in _INPUT:
            raise script.error(
                f"<{element.tag}> in <input> is not supported; remove it, or convert the project by hand"
            )
    # Replace the file references in <cameras> by the cameras of these files.
    cameras = script.find("input/cameras")
    for element in cameras.findall("file"):
        cameras.remove(element)
        cameras.extend(_open(script.file(element)).root.findall("cameras/camera"))
    metres = script.one_of(_METRES, "project_unit", script.text("meta/project_unit", "m"))
    images = concatenate([table for table, _ in script.tables("images", "id", "path")])
    stems = [Path(path.replace("\\", "/")).stem for path in images.text("path")]
    names = images.ids("id") if len(set(stems)) < len(stems) else np.array(stems, object)
    ids = images.text("id").tolist()

    def images_of(table: Table, column: str) -> np.ndarray:
        found = table.find(column, ids, lambda image: f"image {image} is not in {images.file}; add it there")
        return names[found]

    camera = _camera(script)
    columns = {"image": names, "camera": np.full(len(images), CAMERA, object)}
    tables = {"images": Table(images.file, columns, images.files, images.rows)}
    parts = []
    for table, element in script.tables("image_pts", "id", "im", "x", "y"):
        columns = {"image": images_of(table, "im"), "point": table.ids("id")}
        columns |= {"column_px": table.numbers("x") - 0.5, "row_px": table.numbers("y") - 0.5}
        for axis in "xy":
            columns[f"sigma_{axis}_mm"] = _image_sigma(script, element, table, axis) * camera["pixel_mm"]
        parts.append(Table(table.file, columns, table.files, table.rows))
    tables["image_points"] = concatenate(parts)
    if script.root.find("input/prior_eo") is not None:
        tables |= _prior_orientations(script, metres, tables["images"], images_of)
    control = [
        _filtered(
            script, tag, concatenate([control_table(t, role, metres) for t, _ in script.tables(tag, "id", *"xyz")])
        )
        for tag, role in (("ctrl_pts", ""), ("check_pts", "check"))
        if script.root.find(f"input/{tag}") is not None
    ]
    if control:
        tables["control_points"] = concatenate(control)
    settings: dict[str, Any] = {"title": script.text("meta/name", path.stem), "cameras": {CAMERA: camera}}
    if script.text("operations/operation/set_datum", "") == "depend":
        # All minimal datums give the same interior orientation, residuals and sigma naught.
        settings["datum"] = {"kind": "minimal"}
    return BlockTables(settings, tables, path.name)


def _prior_orientations(script: _Script, metres: float, images: Table, images_of: Any) -> dict[str, Table]:
    """Return the images table with the given orientations, and positions with standard deviations as stations."""
    table, element = script.tables("prior_eo", "id", *"xyz")[0]
    if other := [name for name in table.columns if name not in ("id", "label", *"xyz", *_ANGLES, *_SIGMAS)]:
        raise script.error(f"<prior_eo> has the unsupported column {quoted(other[0])}; remove it")
    columns = {"image": images_of(table, "id")}
    columns |= {name: table.numbers(axis) * metres for name, axis in zip(XYZ, "xyz", strict=True)}
    tables = {}
    if sigmas := [_first(table, "sxyz", f"s{axis}") for axis in "xyz" if _first(table, "sxyz", f"s{axis}")]:
        sigma = {name: table.sigmas(column) * metres for name, column in zip(SIGMA_XYZ, sigmas, strict=True)}  # type: ignore[arg-type]
        tables["stations"] = Table(table.file, columns | sigma, table.files, table.rows)
    if all(name in table for name in _ANGLES):
        degrees = script.one_of(_DEGREES, "the unit of <prior_eo>", element.get("units", ""))
        columns |= {name: table.numbers(angle) * degrees for name, angle in zip(ANGLES, _ANGLES, strict=True)}
        row = {name: k for k, name in enumerate(columns.pop("image"))}
        place = [row.get(name) for name in images.text("image")]
        cells = {
            name: np.array(["" if k is None else repr(float(values[k])) for k in place], object)
            for name, values in columns.items()
        }
        tables["images"] = Table(images.file, images.columns | cells, images.files, images.rows)
    return tables


def _image_sigma(script: _Script, element: ElementTree.Element, table: Table, axis: str) -> np.ndarray:
    """Return the standard deviation in pixels; the <file> attribute has priority over the column."""
    for name in ("sxy", f"s{axis}"):
        if (value := finite(element.get(name, ""))) is not None:
            return np.full(len(table), value)
    if column := _first(table, "sxy", f"s{axis}"):
        return table.sigmas(column)
    raise script.error(f"the points of {table.file} have no standard deviation; add sxy='...' (pixels) to their <file>")


def _filtered(script: _Script, tag: str, table: Table) -> Table:
    """Select points by the filters of a section."""
    for element in script.find(f"input/{tag}").findall("filter"):
        ids = {part.strip() for part in element.get("id", "").split(",")}
        keep = script.one_of({"keep": True, "remove": False}, f"<filter> in <{tag}>", (element.text or "").strip())
        table = table.take(np.array([(point in ids) == keep for point in table.text("point")], bool))
    return table


def control_table(table: Table, role: str, metres: float) -> Table:
    """Convert a control file of DBAT to control_points.csv. `role` "": control, or fixed for rows without sigma."""
    columns: dict[str, np.ndarray] = {"point": table.ids("id")}
    columns |= {name: table.numbers(axis) * metres for name, axis in zip(XYZ, "xyz", strict=True)}
    sigmas = []
    for axis in "xyz":
        column = _first(table, f"s{axis}", "sxy" if axis != "z" else "sz", "sxyz")
        sigmas.append(np.zeros(len(table)) if column is None else table.numbers(column) * metres)
    # DBAT marks fixed points by zero standard deviations.
    zero = (np.array(sigmas) == 0).all(axis=0)
    columns["role"] = np.array([role or ("fixed" if z else "control") for z in zero], object)
    for name, sigma in zip(SIGMA_XYZ, sigmas, strict=True):
        columns[name] = np.array(["" if z else repr(float(s)) for s, z in zip(sigma, zero, strict=True)], object)
    return Table(table.file, columns, table.files, table.rows)


def _first(table: Table, *names: str) -> str | None:
    return next((name for name in names if name in table), None)


# Camera -------------------------------------------------------------------------------------------------------


def _camera(script: _Script) -> dict[str, Any]:
    """Return the [cameras.X] table of the only camera."""
    if (count := len(script.find("input/cameras").findall("camera"))) != 1:
        raise script.error(
            f"{count} <camera> in <cameras> or its camera file of DBAT, not 1; convert the project by hand"
        )
    if (unit := script.text(f"{_CAMERA_PLACE}/unit", "mm")) != "mm":
        raise script.error(f"the camera's unit is {unit!r}; give the camera in mm")
    model = script.text(f"{_CAMERA_PLACE}/model", "3")
    distortion = script.one_of(_MODELS, "lens model", model)
    width, height = (int(n) for n in script.numbers("image", "", 2))
    sides = script.text(f"{_CAMERA_PLACE}/sensor", "").split(",")
    lengths = [finite(side) for side in sides]
    sizes = [length / n for length, n in zip(lengths, (width, height), strict=False) if length and n > 0]
    if len(sides) != 2 or not sizes or min(sizes) <= 0:
        raise script.error(f"<sensor> is {quoted(','.join(sides))}; give width,height in mm, one of which may be auto")
    if abs(sizes[0] - sizes[-1]) > 1e-6 * sizes[0]:
        raise script.error(f"the pixels of {sizes[0]:g} x {sizes[-1]:g} mm are not square; give the aspect instead")
    pixel = sizes[-1]
    # DBAT's pixel (1, 1) is our (0.5, 0.5): the image centre is at (width / 2 + 0.5) pixels.
    middle = pixel * (width / 2 + 0.5), pixel * (height / 2 + 0.5)
    interior = dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2", "b1"), 0.0)
    interior["c_mm"] = script.numbers("focal", "0")[0]
    if script.setting("set_initial_values", "io") != "default":
        interior["c_mm"] = script.numbers("cc", "0")[0] or interior["c_mm"]
        px, py = script.numbers("pp", "0,0", 2)
        if (px, py) != (0, 0):
            interior["xp_mm"], interior["yp_mm"] = px - middle[0], -(py - middle[1])
        for tag, most in (("K", 3), ("P", 2)):
            values = script.numbers(tag, "0")
            if any(values[most:]):
                raise script.error(f"<{tag}> has more than {most} coefficients; remove the rest")
            interior |= {f"{tag.lower()}{i}": 0.0 - value for i, value in enumerate(values[:most], start=1)}
        interior["b1"] = script.numbers("aspect", "1")[0] - 1.0
        if script.numbers("skew", "0")[0] != 0:
            raise script.error("<skew> is not 0; set it to 0")
    unknowns = _free(script)
    if model in "12" and (interior["b1"] != 0 or {"b1", "b2"} & set(unknowns)):
        raise script.error(f"lens model {model} has neither aspect nor skew; set aspect to 1 and estimate none")
    if model == "5" and interior["xp_mm"] != 0:
        interior["xp_mm"] = (interior["xp_mm"] + middle[0]) / (1.0 - interior["b1"]) - middle[0]
    return {
        "width_px": width, "height_px": height, "pixel_mm": pixel, "distortion": distortion,
        "residuals": "model", "interior": interior, "unknowns": unknowns,
    }  # fmt: skip


def _free(script: _Script) -> dict[str, str]:
    """Return the names of the interior parameters that the script estimates."""
    groups = dict(_PARAMETERS)
    for tag, most in (("K", 3), ("P", 2)):
        n = int(script.numbers(f"n{tag}", str(most))[0])
        if n > most:
            raise script.error(f"n{tag} = {n} is more than Brown's model has; use at most {most}")
        groups[tag] = tuple(f"{tag.lower()}{i + 1}" for i in range(n))
        groups |= {name.upper(): (name,) for name in groups[tag]}
    for key in ("eo", "op"):
        if (value := script.setting(_ESTIMATE, key)) not in ("true", "default"):
            raise script.error(f"<{key}> {value!r} in <{_ESTIMATE}> is not supported; set it to true")
    every = script.setting(_ESTIMATE, "io") == "true"
    free = {name for names in groups.values() for name in names} if every else set()
    for element in script.root.findall(f"operations/operation/{_ESTIMATE}/io/*"):
        if element.tag in ("c", "all"):
            continue
        names = set(script.one_of(groups, "in <io>", element.tag))
        estimated = script.one_of(
            {"true": True, "false": False}, f"<{element.tag}> in <io>", (element.text or "").strip()
        )
        free = free | names if estimated else free - names
    return dict.fromkeys(sorted(free), "free")


# PhotoModeler ------------------------------------------------------------------------------------------------


def _is_export(path: Path) -> bool:
    begin = [line.split() for line in beginning(path, 2_000)]
    numeric = all(is_number(cell) for row in begin[1:4] for cell in row)
    return len(begin) > 5 and tuple(map(len, begin[1:4])) in _HEADERS and numeric


def read_export(path: Path) -> BlockTables:
    """Read the block of an export and of DBAT's control files in the same folder.

    Without control files the initial values are the orientations and points of the export. Its control points define
    the datum if there are at least three, otherwise the network is free. The camera has free c, xp, yp and nonzero
    coefficients.
    """
    lines = read_text(path).split("\n")
    if len(lines) < 6:
        raise InputError(f"{path.name}: the file ends within its header. Export it again")
    camera, at, names = _export_camera(path, lines), 5, dict[str, str]()
    poses, rows = [], []
    while at < len(lines) and lines[at].strip():
        words = lines[at].split(maxsplit=1)
        if len(words) != 2 or len(lines) < at + _LINES_PER_PHOTOGRAPH:
            raise InputError(
                f"{path.name}, row {at + 1}: {quoted(lines[at])} does not start a photograph. Export it again"
            )
        names[words[0]] = _stem(words[1].strip())
        poses.append(row_numbers(path, at + 2, lines[at + 1].split(), 7)[1:])
        rows.append(at + 2)
        at += _LINES_PER_PHOTOGRAPH
    images = {"image": np.array(list(names.values()), object), "camera": np.full(len(names), CAMERA, object)}
    x, y, z, kappa, phi, omega = np.array(poses).T
    outer = dict(zip((*XYZ, *ANGLES), (x, y, z, omega, phi, kappa), strict=True))
    control, points, marks = _sections(path, lines, at)
    numbers, stems = list(names), np.array(list(names.values()), object)
    shown = stems[marks.find("im", numbers, lambda number: f"image {number} is not among the export's images")]
    columns = {"image": shown, "point": marks.text("id"), "sigma_px": np.full(len(marks), _SIGMA_PX)}
    columns |= {"column_px": marks.numbers("x") - 0.5, "row_px": marks.numbers("y") - 0.5}
    tables = {"image_points": Table(path.name, columns, marks.files, marks.rows)}
    settings: dict[str, Any] = {"title": lines[0].strip(), "cameras": {CAMERA: camera}}
    if (path.parent / CONTROL_FILE).is_file():
        tables["images"] = Table.of(path.name, images)
        control = read_columns(path.parent / CONTROL_FILE, ("id", "label", "x", "y", "z", "sx", "sy", "sz"))
        tables["control_points"] = control_table(control, "", 1.0)
    else:
        tables["images"] = Table.of(path.name, images | outer, np.array(rows, int))
        xyz = {name: points.numbers(axis) for name, axis in zip(XYZ, "xyz", strict=True)}
        tables["object_points"] = Table(path.name, {"point": points.ids("id")} | xyz, points.files, points.rows)
        estimated = [name for name, value in camera["interior"].items() if value != 0]
        camera["unknowns"] = dict.fromkeys([*_ALWAYS_FREE, *estimated], "free")
        if len(control) < _LEAST_CONTROL:
            settings["datum"] = {"kind": "inner", "over": "points"}
            if len(control):
                warn(f"{path.name}: {len(control)} control points are too few for a datum; the block is a free network")
        else:
            # Negative sigmas mark fixed coordinates in PhotoModeler, zeros in DBAT.
            sigmas = {name: np.maximum(control.numbers(name), 0.0) for name in ("sx", "sy", "sz")}
            fixed = Table(path.name, control.columns | sigmas, control.files, control.rows)
            tables["control_points"] = control_table(fixed, "", 1.0)
    if (path.parent / STATIONS).is_file():
        table = read_columns(path.parent / STATIONS, ("image", *XYZ, "sigma"))
        stations = {"image": np.array([_stem(name) for name in table.ids("image")], object)}
        stations |= {name: table.numbers(name) for name in XYZ}
        stations |= {name: table.numbers("sigma") for name in SIGMA_XYZ}
        tables["stations"] = Table(table.file, stations, table.files, table.rows)
    return BlockTables(settings, tables, path.name)


def _export_camera(path: Path, lines: list[str]) -> dict[str, Any]:
    """Return the [cameras.X] table of the camera."""
    if len(lines[1].split()) == 2:
        raise InputError(f"{path.name}, row 2: no size of the photographs; write width, height at its end")
    _, _, width, height = row_numbers(path, 2, lines[1].split(), 4)
    c, px, py, width_mm, height_mm, *coefficients = row_numbers(path, 4, lines[3].split(), 10)
    if min(width, height, width_mm, height_mm) <= 0:
        raise InputError(f"{path.name}: the format of the camera is not positive. Export it again")
    sides = width_mm / width, height_mm / height
    square = abs(sides[0] / sides[1] - 1) < _SQUARE
    # Affinity is applied first: it makes the pixels square.
    pixel = sides[0] if square else sides[1]
    b1 = 0.0 if square else 1.0 - sides[0] / pixel
    xp, yp = px / (1.0 - b1) - pixel * (width / 2 + 0.5), -(py - pixel * (height / 2 + 0.5))
    interior = {"c_mm": c, "xp_mm": xp, "yp_mm": yp}
    interior |= dict(zip(("k1", "k2", "k3", "p1", "p2"), (0.0 - value for value in coefficients), strict=True))
    return {
        "width_px": int(width), "height_px": int(height), "pixel_mm": pixel,
        "distortion": "brown" if square else "affine_brown", "residuals": "model",
        "interior": interior | ({} if square else {"b1": b1}),
    }  # fmt: skip


def _sections(path: Path, lines: list[str], at: int) -> list[Table]:
    """Read control points, object points and marks; an empty line ends each table."""
    tables = []
    for columns in (_POINT, _POINT, _MARK):
        at, cells, rows = at + 1, [], []
        while at < len(lines) and lines[at].strip():
            cells.append(lines[at].split())
            at += 1
            rows.append(at)
            if len(cells[-1]) != len(columns):
                raise InputError(f"{path.name}, row {at}: expected {len(columns)} numbers. Export it again")
        values = {name: np.array([row[j] for row in cells], object) for j, name in enumerate(columns)}
        tables.append(Table.of(path.name, values, np.array(rows, int)))
    return tables


def _stem(name: str) -> str:
    return Path(name.replace("\\", "/")).stem


FORMATS = (
    Format(
        "dbat", "script of DBAT, XML", by_content("*.xml", lambda path: has_words(path, "dbat_script_version")), read
    ),
    Format("photomodeler", "export of PhotoModeler", by_content("*.txt", _is_export), read_export),
)
