"""PhotoModeler export with DBAT's control files beside it -> the tables of a block folder.

The export holds the camera, the images and the image points (pixels, counted as DBAT does, see dbat.py). Its own object
coordinates and orientations are in a frame of their own and are not read. Control is read from `ctrlpts-weighted.txt`,
camera stations from `fake-camera-positions.txt`, in the same folder.
"""

from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.table_layout import SIGMA_XYZ, XYZ
from jaxphoto.io.dbat import CAMERA, control_table
from jaxphoto.io.text_tables import Table, content_lines, finite, is_number, read_columns

CONTROL, STATIONS = "ctrlpts-weighted.txt", "fake-camera-positions.txt"
# The export's own standard deviations mark the kind of point (1 manual, 0 automatic); DBAT takes 1 pixel for all.
_SIGMA_PX = 1.0


def recognises(source: Path) -> bool:
    """Whether `source` is an export, or a folder that holds exactly one."""
    return len(_exports(source)) == 1


def read_photomodeler(source: Path) -> BlockTables:
    """The block of an export and the files beside it."""
    exports = _exports(source)
    if len(exports) != 1:
        raise InputError(f"{source} holds {len(exports)} PhotoModeler exports (*pmexport*.txt); name the one to read")
    path = exports[0]
    lines, rows = content_lines(path)
    if len(lines) < 5:
        raise InputError(f"{path.name}: the export ends within its header; export it again")
    cells = [line.split() for line in lines]
    _, _, width, height = _numbers(path, rows[1], cells[1], 4)
    c, px, py, sensor_width, _, *coefficients = _numbers(path, rows[3], cells[3], 10)
    if min(width, height, sensor_width) <= 0:
        raise InputError(f"{path.name}: the format of the camera is not positive; export it again")
    pixel = sensor_width / width
    if any(coefficients):
        raise InputError(f"{path.name}, row {rows[3]}: lens distortion is not read from an export; use a DBAT script")
    images = {parts[0]: _stem(parts[1]) for parts in cells[5:] if len(parts) == 2 and not is_number(parts[1])}
    measured = np.array([len(parts) == 6 for parts in cells])
    measured[:5] = False
    points = Table.of(
        path.name,
        {name: _column(cells, measured, j) for j, name in enumerate(("im", "point", "x", "y"))},
        np.array(rows)[measured],
    )
    for line, image in enumerate(points.text("im")):
        if image not in images:
            raise points.bad(line, f"image {image} is not among the export's images; export it again")
    names = np.array(list(images.values()), object)
    tables = {
        "images": Table.of(path.name, {"image": names, "camera": np.full(len(names), CAMERA, object)}),
        "image_points": Table(
            path.name,
            {
                "image": np.array([images[image] for image in points.text("im")], object),
                "point": points.text("point"),
                "column_px": points.numbers("x") - 0.5,
                "row_px": points.numbers("y") - 0.5,
                "sigma_px": np.full(len(points), _SIGMA_PX),
            },
            points.files,
            points.rows,
        ),
        "control_points": control_table(
            read_columns(path.parent / CONTROL, ("id", "label", "x", "y", "z", "sx", "sy", "sz")), "", 1.0
        ),
    }
    if (path.parent / STATIONS).is_file():
        tables["stations"] = _stations(path.parent / STATIONS)
    interior = {
        "c_mm": c,
        "xp_mm": px - pixel * (width / 2 + 0.5),
        "yp_mm": -(py - pixel * (height / 2 + 0.5)),
    }
    camera = {
        "width_px": int(width), "height_px": int(height), "pixel_mm": pixel, "distortion": "brown",
        "interior": interior,
    }  # fmt: skip
    return BlockTables({"title": lines[0].strip(), "cameras": {CAMERA: camera}}, tables, path.name)


def _exports(source: Path) -> list[Path]:
    if source.is_dir():
        return sorted(source.glob("*pmexport*.txt"))
    return [source] if source.is_file() and "pmexport" in source.name else []


def _stations(path: Path) -> Table:
    table = read_columns(path, ("image", *XYZ, "sigma"))
    columns = {"image": np.array([_stem(name) for name in table.ids("image")], object)}
    columns |= {name: table.numbers(name) for name in XYZ} | {name: table.numbers("sigma") for name in SIGMA_XYZ}
    return Table(table.file, columns, table.files, table.rows)


def _numbers(path: Path, row: int, cells: list[str], n: int) -> list[float]:
    numbers = [number for cell in cells if (number := finite(cell)) is not None]
    if len(cells) != n or len(numbers) != n:
        raise InputError(f"{path.name}, row {row}: {n} numbers are expected here; export it again")
    return numbers


def _column(cells: list[list[str]], chosen: np.ndarray, j: int) -> np.ndarray:
    return np.array([cells[i][j] for i in np.flatnonzero(chosen)], object)


def _stem(name: str) -> str:
    return Path(name.replace("\\", "/")).stem
