"""DBAT (Damped Bundle Adjustment Toolbox): a script as XML and the text files that it names.

DBAT counts pixels from (1, 1) at the centre of the upper left one, we from (0.5, 0.5); its principal point is in mm
from pixel (0, 0); it *adds* K, P and the aspect `as` to the measured coordinate where our Brown model subtracts, so all
of them change sign. Its model 3 applies 1 + as and the skew before the polynomial: `affine_brown` with b1 = -as;
<aspect> is 1 - as. Models 1 and 2 have neither aspect nor skew. Model 4 applies both after it, `brown_affine`. Model 5
applies 1 + as before the principal point is subtracted, which divides px by it, and the skew after the polynomial:
`stretched_brown`. Source: DBAT, github.com/niclasborlin/dbat.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.files import Format, by_content, read_columns
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.table_layout import SIGMA_XYZ, XYZ
from jaxphoto.io.text_files import read_bytes
from jaxphoto.io.text_tables import Table, concatenate, finite

CAMERA = "camera"
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_DEGREES = {"degrees": 1.0, "radian": float(np.rad2deg(1.0)), "gon": 0.9}
_INPUT = ("c", "ctrl_pts", "check_pts", "images", "image_pts", "cameras", "prior_eo")
_POSITION, _ANGLES, _SIGMAS = ("x", "y", "z"), ("omega", "phi", "kappa"), ("sxyz", "sx", "sy", "sz")
# DBAT's lens models ("Backward (Photogrammetry)") as ours, up to sign.
_MODELS = {
    "1": "affine_brown", "2": "affine_brown", "3": "affine_brown", "4": "brown_affine", "5": "stretched_brown"
}  # fmt: skip
_CAMERA_PLACE = "input/cameras/camera"


class _Script(NamedTuple):
    """A script; places are paths of tags from its root."""

    path: Path
    root: ElementTree.Element

    def error(self, message: str) -> InputError:
        return InputError(f"{self.path.name}: {message}")

    def find(self, place: str) -> ElementTree.Element:
        element = self.root.find(place)
        if element is None:
            raise self.error(f"there is no <{place.replace('/', '><')}>; add it")
        return element

    def text(self, place: str, default: str) -> str:
        return (self.root.findtext(place) or default).strip()

    def numbers(self, place: str, default: str, n: int | None = None) -> list[float]:
        """The comma-separated numbers of an element, `n` of them if given."""
        text = self.text(place, default)
        values = [finite(part) for part in text.split(",")]
        numbers = [value for value in values if value is not None]
        if len(numbers) < len(values) or n not in (None, len(values)):
            many = f"{n} numbers" if n else "numbers"
            raise self.error(f"<{place.split('/')[-1]}> is {quoted(text)}; give {many} separated by commas")
        return numbers

    def file(self, element: ElementTree.Element) -> Path:
        """The file that an element names, by the base folder of <input>."""
        base = self.find("input").get("base_dir", "$HERE").replace("$HERE", str(self.path.parent))
        base = base.replace("$HOME", str(Path.home()))
        name = (element.text or "").strip()
        if "$" in base or "$" in name:
            raise self.error(f"the folder of {name} ({base}) is not known here; write it with $HERE")
        return Path(base) / name

    def tables(self, tag: str, *columns: str) -> list[tuple[Table, ElementTree.Element]]:
        """The files of <input><tag>, columns named by the attribute `format`; `columns` are needed."""
        elements = self.find(f"input/{tag}").findall("file")
        if not elements:
            raise self.error(f"<{tag}> names 0 files; add <file format='{','.join(columns)}'>")
        tables = []
        for element in elements:
            names = [name.strip() for name in element.get("format", "").split(",")]
            table = read_columns(self.file(element), names)
            for name in columns:
                if name not in table:
                    raise self.error(f"the format of <{tag}> has no {name}; add it ({', '.join(columns)} are needed)")
            tables.append((table, element))
        return tables

    def setting(self, operation: str, key: str) -> str:
        """The text of an operation's element, or of its <all>."""
        element = self.root.find(f"operations/operation/{operation}/{key}")
        return "default" if element is None else (element.findtext("all") or element.text or "").strip()

    @property
    def metres(self) -> float:
        unit = self.text("meta/project_unit", "m")
        if unit not in _METRES:
            raise self.error(f"the project_unit {unit!r} is unknown; use one of {', '.join(_METRES)}")
        return _METRES[unit]


def _names_itself(path: Path) -> bool:
    with path.open("rb") as file:
        return b"dbat_script_version" in file.read(2000)


def _open(path: Path) -> _Script:
    return _Script(path, ElementTree.fromstring(read_bytes(path)))


def read(path: Path) -> BlockTables:
    """Read the block of a script. Raise InputError for operations that have no equal here."""
    script = _open(path)
    for element in script.find("input"):
        if element.tag not in _INPUT:
            raise script.error(f"<{element.tag}> in <input> cannot be read; remove it, or convert the project by hand")
    _include_cameras(script)
    images = concatenate([table for table, _ in script.tables("images", "id", "path")])
    stems = [Path(path.replace("\\", "/")).stem for path in images.text("path")]
    names = images.ids("id") if len(set(stems)) < len(stems) else np.array(stems, object)
    name_of = dict(zip(images.text("id"), names, strict=True))
    camera = _camera(script)
    columns = {"image": names, "camera": np.full(len(images), CAMERA, object)}
    tables = {
        "images": Table(images.file, columns, images.files, images.rows),
        "image_points": _image_points(script, images.file, name_of, camera["pixel_mm"]),
    }
    if script.root.find("input/prior_eo") is not None:
        prior = _prior_orientations(script, images.file, name_of)
        tables["images"] = _oriented(tables["images"], prior)
        if any(name in prior for name in SIGMA_XYZ):
            stations = {name: prior.columns[name] for name in ("image", *XYZ, *SIGMA_XYZ) if name in prior}
            tables["stations"] = Table(prior.file, stations, prior.files, prior.rows)
    control = [_control(script, tag, role) for tag, role in (("ctrl_pts", ""), ("check_pts", "check"))]
    if known := [table for table in control if table is not None]:
        tables["control_points"] = concatenate(known)
    settings: dict[str, Any] = {"title": script.text("meta/name", path.stem), "cameras": {CAMERA: camera}}
    if script.text("operations/operation/set_datum", "") == "depend":
        # Any minimal datum gives the same interior orientation, residuals and sigma naught.
        settings["datum"] = {"kind": "minimal"}
    return BlockTables(settings, tables, path.name)


def _include_cameras(script: _Script) -> None:
    """Put the cameras of the files that <cameras> names in place of these."""
    cameras = script.find("input/cameras")
    for element in cameras.findall("file"):
        path = script.file(element)
        included = _open(path).root.findall("cameras/camera")
        if not included:
            raise script.error(f"{path.name} has no <cameras><camera>; name a camera file of DBAT")
        cameras.remove(element)
        cameras.extend(included)


def _check_images(table: Table, column: str, name_of: dict[str, str], file: str) -> np.ndarray:
    """Names of the images in a column of ids."""
    ids = table.ids(column)
    for line, image in enumerate(ids):
        if image not in name_of:
            raise table.bad(line, f"image {image} is not in {file}; add it there or delete this row")
    return np.array([name_of[image] for image in ids], object)


def _prior_orientations(script: _Script, file: str, name_of: dict[str, str]) -> Table:
    """Image, camera position, and where given angles in degrees and standard deviations."""
    ((table, element), *more) = script.tables("prior_eo", "id", *_POSITION)
    if more:
        raise script.error(f"<prior_eo> names {1 + len(more)} files, and one is read; put all orientations into it")
    if other := [name for name in table.columns if name not in ("id", "label", *_POSITION, *_ANGLES, *_SIGMAS)]:
        raise script.error(f"<prior_eo> has the column {quoted(other[0])}, which is not read; remove it")
    metres, unit = script.metres, element.get("units", "")
    columns = {"image": _check_images(table, "id", name_of, file)}
    columns |= {name: table.numbers(axis) * metres for name, axis in zip(XYZ, _POSITION, strict=True)}
    if any(name in table for name in _ANGLES):
        if not all(name in table for name in _ANGLES):
            raise script.error("<prior_eo> has some of omega, phi, kappa; give all three or none")
        if unit not in _DEGREES:
            raise script.error(f"the units {quoted(unit)} of <prior_eo> are unknown; use one of {', '.join(_DEGREES)}")
        columns |= {f"{name}_deg": table.numbers(name) * _DEGREES[unit] for name in _ANGLES}
    for name, axis in zip(SIGMA_XYZ, _POSITION, strict=True):
        if sigma := _first(table, "sxyz", f"s{axis}"):
            columns[name] = table.sigmas(sigma) * metres
    return Table(table.file, columns, table.files, table.rows)


def _oriented(images: Table, prior: Table) -> Table:
    """The images with orientations where all six values are given."""
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


def _image_points(script: _Script, file: str, name_of: dict[str, str], pixel_mm: float) -> Table:
    parts = []
    for table, element in script.tables("image_pts", "id", "im", "x", "y"):
        columns = {
            "image": _check_images(table, "im", name_of, file),
            "point": table.ids("id"),
            "column_px": table.numbers("x") - 0.5,
            "row_px": table.numbers("y") - 0.5,
        }
        for axis in "xy":
            columns[f"sigma_{axis}_mm"] = _image_sigma(script, element, table, axis) * pixel_mm
        parts.append(Table(table.file, columns, table.files, table.rows))
    return concatenate(parts)


def _image_sigma(script: _Script, element: ElementTree.Element, table: Table, axis: str) -> np.ndarray:
    """Pixels; the attribute precedes the column."""
    for name in ("sxy", f"s{axis}"):
        if name in element.attrib:
            value = finite(element.attrib[name])
            if value is None:
                raise script.error(f"{name} = {quoted(element.attrib[name])} is not a number; give it in pixels")
            return np.full(len(table), value)
    if column := _first(table, "sxy", f"s{axis}"):
        return table.sigmas(column)
    raise script.error(f"the points of {table.file} have no standard deviation; add sxy='...' (pixels) to their <file>")


def _control(script: _Script, tag: str, role: str) -> Table | None:
    """Control points (fixed without standard deviations) or check points, in metres."""
    section = script.root.find(f"input/{tag}")
    if section is None:
        return None
    table = concatenate([control_table(t, role, script.metres) for t, _ in script.tables(tag, "id", *_POSITION)])
    for element in section.findall("filter"):
        ids = {part.strip() for part in element.get("id", "").split(",")}
        action = (element.text or "").strip()
        if action not in ("keep", "remove") or ids == {""}:
            raise script.error(f"write <filter id='1,2'>keep or remove</filter> in <{tag}>")
        chosen = np.array([point in ids for point in table.text("point")], bool)
        table = table.take(chosen if action == "keep" else ~chosen)
    return table


def control_table(table: Table, role: str, metres: float) -> Table:
    """Return a control file of DBAT as control_points.csv; `role` "" is control, or fixed for rows without sigma."""
    columns: dict[str, np.ndarray] = {"point": table.ids("id")}
    columns |= {name: table.numbers(axis) * metres for name, axis in zip(XYZ, "xyz", strict=True)}
    sigmas = []
    for axis in "xyz":
        column = _first(table, f"s{axis}", "sxy" if axis != "z" else "sz", "sxyz")
        sigmas.append(np.zeros(len(table)) if column is None else table.numbers(column) * metres)
    # A standard deviation of zero means a fixed point.
    zero = (np.array(sigmas) == 0).all(axis=0)
    columns["role"] = np.array([role or ("fixed" if z else "control") for z in zero], object)
    for name, sigma in zip(SIGMA_XYZ, sigmas, strict=True):
        columns[name] = np.array(["" if z else repr(float(s)) for s, z in zip(sigma, zero, strict=True)], object)
    return Table(table.file, columns, table.files, table.rows)


def _first(table: Table, *names: str) -> str | None:
    return next((name for name in names if name in table), None)


# Camera -------------------------------------------------------------------------------------------------------


def _camera(script: _Script) -> dict[str, Any]:
    """The [cameras.X] table of the one camera."""
    c = _CAMERA_PLACE
    if len(script.find("input/cameras").findall("camera")) != 1:
        raise script.error("there is not exactly one <camera>; this reader takes one, so convert the project by hand")
    if (unit := script.text(f"{c}/unit", "mm")) != "mm":
        raise script.error(f"the camera's unit is {unit!r}; give the camera in mm")
    if (model := script.text(f"{c}/model", "3")) not in _MODELS:
        raise script.error(f"lens model {model} has no equal here; use one of {', '.join(_MODELS)}")
    width, height = (int(n) for n in script.numbers(f"{c}/image", "", 2))
    if min(width, height) < 1:
        raise script.error(f"<image> is {width} x {height} pixels; give the format of the camera")
    pixel = _pixel_mm(script, f"{c}/sensor", width, height)
    # Their pixel (1, 1) is our (0.5, 0.5): the image centre lies at (width / 2 + 0.5) pixels.
    middle = pixel * (width / 2 + 0.5), pixel * (height / 2 + 0.5)
    interior = dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2", "b1"), 0.0)
    interior["c_mm"] = script.numbers(f"{c}/focal", "0")[0]
    if script.setting("set_initial_values", "io") != "default":
        interior["c_mm"] = script.numbers(f"{c}/cc", "0")[0] or interior["c_mm"]
        px, py = script.numbers(f"{c}/pp", "0,0", 2)
        if (px, py) != (0, 0):
            interior["xp_mm"], interior["yp_mm"] = px - middle[0], -(py - middle[1])
        interior |= _coefficients(script, "K", 3) | _coefficients(script, "P", 2)
        interior["b1"] = script.numbers(f"{c}/aspect", "1")[0] - 1.0
        if script.numbers(f"{c}/skew", "0")[0] != 0:
            raise script.error("a <skew> other than 0 cannot be read; set it to 0")
    unknowns = _free(script)
    if model in "12" and (interior["b1"] != 0 or {"b1", "b2"} & set(unknowns)):
        raise script.error(f"lens model {model} has neither aspect nor skew; set aspect to 1 and estimate none")
    if model == "5" and interior["xp_mm"] != 0:
        interior["xp_mm"] = (interior["xp_mm"] + middle[0]) / (1.0 - interior["b1"]) - middle[0]
    return {
        "width_px": width, "height_px": height, "pixel_mm": pixel, "distortion": _MODELS[model],
        "interior": interior, "unknowns": unknowns,
    }  # fmt: skip


def _pixel_mm(script: _Script, place: str, width: int, height: int) -> float:
    text = script.text(place, "")
    parts = [part.strip() for part in text.split(",")]
    lengths = [(finite(part), n) for part, n in zip(parts, (width, height), strict=False) if part != "auto"]
    sizes = [length / n for length, n in lengths if length is not None and length > 0]
    if len(parts) != 2 or not sizes or len(sizes) < len(lengths):
        raise script.error(f"<sensor> is {quoted(text)}; give width,height in mm, one of which may be auto")
    if abs(sizes[0] - sizes[-1]) > 1e-6 * sizes[0]:
        raise script.error(f"the pixels of {sizes[0]:g} x {sizes[-1]:g} mm are not square; give the aspect instead")
    return sizes[-1]


def _coefficients(script: _Script, tag: str, most: int) -> dict[str, float]:
    values = script.numbers(f"{_CAMERA_PLACE}/{tag}", "0")
    if any(value != 0 for value in values[most:]):
        raise script.error(f"<{tag}> has more than {most} coefficients; remove the others")
    return {f"{tag.lower()}{i}": 0.0 - value for i, value in enumerate(values[:most], start=1)}


def _free(script: _Script) -> dict[str, str]:
    """The interior parameters that the script estimates."""
    n_k, n_p = (int(script.numbers(f"{_CAMERA_PLACE}/{name}", n)[0]) for name, n in (("nK", "3"), ("nP", "2")))
    if n_k > 3 or n_p > 2:
        raise script.error(f"nK = {n_k}, nP = {n_p} are more coefficients than Brown's model has; use at most 3 and 2")
    ks, ps = tuple(f"k{i + 1}" for i in range(n_k)), tuple(f"p{i + 1}" for i in range(n_p))
    groups: dict[str, tuple[str, ...]] = {
        "cc": ("c_mm",), "pp": ("xp_mm", "yp_mm"), "px": ("xp_mm",), "py": ("yp_mm",), "K": ks, "P": ps,
        "aspect": ("b1",), "as": ("b1",), "skew": ("b2",), "sk": ("b2",),
    }  # fmt: skip
    groups |= {name.upper(): (name,) for name in (*ks, *ps)}
    estimate = "set_bundle_estimate_params"
    for key in ("eo", "op"):
        if (value := script.setting(estimate, key)) not in ("true", "default"):
            raise script.error(f"<{key}> {value!r} in <{estimate}> cannot be read; set it to true")
    every = script.setting(estimate, "io") == "true"
    free = {name for names in groups.values() for name in names} if every else set()
    for element in script.root.findall(f"operations/operation/{estimate}/io/*"):
        if element.tag in ("c", "all"):
            continue
        if element.tag not in groups:
            raise script.error(f"<{element.tag}> in <io> is unknown; use all, {', '.join(groups)}")
        value = (element.text or "").strip()
        if value not in ("true", "false"):
            raise script.error(f"<{element.tag}> in <io> is {value!r}; write true or false")
        free = free | set(groups[element.tag]) if value == "true" else free - set(groups[element.tag])
    return dict.fromkeys(sorted(free), "free")


FORMATS = (Format("dbat", "script of DBAT, XML", by_content("*.xml", _names_itself), read),)
