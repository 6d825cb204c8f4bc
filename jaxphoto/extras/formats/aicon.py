"""AICON / JAG3D close-range projects: .ior, .phc, .eor, .obc, .scale.

Lengths are in millimetres. Image coordinates follow docs/conventions.md (x right, y up, from the image centre). The
rotation is `object_from_camera = Rx(omega) Ry(phi) Rz(kappa)`, the transpose of our `camera_from_object`. The
distortion is `Balanced` with unchanged A1-A3, B1, B2, C1, C2 and R0; the principal distance has the opposite sign.
Source: github.com/applied-geodesy/bundle-adjustment, which reads these files.
"""

from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.errors import InputError
from jaxphoto.extras.formats.files import Format, content_rows, read_columns
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.table_layout import ANGLES, XYZ
from jaxphoto.io.text_tables import Table, finite

_MM = 0.001
# Standard deviation of image coordinates (mm) in AICON; columns 5 and 6 of .phc are adjustment results.
_SIGMA_MM = 0.0005
_NEEDED = (".ior", ".phc", ".eor", ".obc")
_PHC = ("image", "point", "x", "y", "sx", "sy", "vx", "vy", "flag_1", "flag_2", "flag_3")
_EOR = ("image", "camera", *XYZ, *ANGLES, "flag_1", "flag_2", "flag_3")
_OBC = ("point", *XYZ, "sx", "sy", "sz", "rays", "flag_1", "flag_2", "flag_3")
_SCALE = ("bar", "name", "point_a", "point_b", "distance", "sigma", "flag")
_FREE = ("c_mm", "xp_mm", "yp_mm", "a1", "a2", "b1", "b2")


def find(source: Path) -> list[Path]:
    """Return the .phc file of each complete project; `source` is a folder or any file of a project."""
    paths = sorted(source.glob("*.phc")) if source.is_dir() else []
    if source.suffix in (*_NEEDED, ".scale"):
        paths = [source.with_suffix(".phc")]
    return [path for path in paths if all(path.with_suffix(end).is_file() for end in _NEEDED)]


def read(path: Path) -> BlockTables:
    """Read a project; image points are used if all flags are 1 and the point is in .obc.

    The datum is defined by inner constraints over the points; scale bars, if given, determine the scale.
    """
    camera, interior = _camera(path.with_suffix(".ior"))
    images, points, observed = (
        read_columns(path.with_suffix(end), columns, None)
        for end, columns in ((".eor", _EOR), (".obc", _OBC), (".phc", _PHC))
    )
    for line in np.flatnonzero(images.text("camera") != camera):
        raise images.bad(line, f"camera {images.text('camera')[line]} is not in {path.stem}.ior; add it there")
    flags = np.stack([observed.text(f"flag_{i}") == "1" for i in (1, 2, 3)])
    listed = np.isin(observed.text("point").astype(str), points.ids("point").astype(str))
    observed = observed.take(flags.all(axis=0) & listed)
    seen = np.isin(points.text("point").astype(str), observed.text("point").astype(str))
    metres = lambda table: {name: table.numbers(name) * _MM for name in XYZ}  # noqa: E731
    angles = {name: np.rad2deg(images.numbers(name)) for name in ANGLES}
    ids = lambda table, *names: {name: table.ids(name) for name in names}  # noqa: E731
    xy = {"x_mm": observed.numbers("x"), "y_mm": observed.numbers("y")}
    tables = {
        "images": _with(images, ids(images, "image", "camera") | metres(images) | angles),
        "image_points": _with(observed, ids(observed, "image", "point") | xy),
        "object_points": _with(points, ids(points, "point") | metres(points)).take(seen),
    }
    has_scale = path.with_suffix(".scale").exists()
    if has_scale:
        bars = read_columns(path.with_suffix(".scale"), _SCALE, None)
        bars = bars.take(bars.text("flag") == "1")
        lengths = {"distance_m": bars.numbers("distance") * _MM, "sigma_m": bars.sigmas("sigma") * _MM}
        tables["distances"] = _with(bars, ids(bars, "point_a", "point_b") | lengths)
    settings = {
        "title": path.stem,
        "sigmas": {"image_mm": _SIGMA_MM},
        "cameras": {camera: interior},
        "datum": {"kind": "inner", "over": "points", "scale": not has_scale},
    }
    return BlockTables(settings, tables, f"{path.stem}.ior")


def _camera(path: Path) -> tuple[str, dict[str, Any]]:
    """Read the camera's id and its [cameras.X] table from the five lines of .ior."""
    rows = [(row, line.split()) for row, line in content_rows(path)]
    if [len(cells) for _, cells in rows] != [8, 1, 2, 2, 4]:
        raise InputError(f"{path.name}: not the five lines of one camera (8, 1, 2, 2, 4 numbers); export it again")
    values = []
    for row, cells in rows:
        numbers = [number for cell in cells if (number := finite(cell)) is not None]
        if len(numbers) < len(cells):
            raise InputError(f"{path.name}, row {row}: a cell is not a finite number; correct it")
        values.append(numbers)
    if min(values[-1]) <= 0:
        raise InputError(
            f"{path.name}, row {rows[-1][0]}: the image format in mm or pixels is not positive; correct it"
        )
    (_, _, c, x, y, a1, a2, r0), (a3,), (b1, b2), (c1, c2), (width_mm, height_mm, width, height) = values
    # Use the mean pixel size of both axes: it affects only the format.
    pixel = (width_mm / width + height_mm / height) / 2
    interior = {
        "c_mm": -c, "xp_mm": x, "yp_mm": y, "a1": a1, "a2": a2, "a3": a3, "b1": b1, "b2": b2, "c1": c1, "c2": c2,
        "r0_mm": r0,
    }  # fmt: skip
    return rows[0][1][0], {
        "width_px": int(width), "height_px": int(height), "pixel_mm": pixel, "distortion": "balanced",
        "interior": interior, "unknowns": dict.fromkeys(_FREE, "free"),
    }  # fmt: skip


def _with(table: Table, columns: dict[str, np.ndarray]) -> Table:
    return Table(table.file, columns, table.files, table.rows)


FORMATS = (Format("aicon", "AICON: .ior, .phc, .eor, .obc", find, read),)
