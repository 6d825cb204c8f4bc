"""AICON / JAG3D close-range files (.ior, .phc, .eor, .obc, .scale) -> the tables of a block folder.

Lengths are millimetres. Image coordinates are ours (x right, y up, from the centre); the rotation is
`object_from_camera = Rx(omega) Ry(phi) Rz(kappa)`, whose transpose is our `camera_from_object`. The model is
`Balanced` with A1-A3, B1, B2, C1, C2 and R0 as they stand; the principal distance only changes its sign.
"""

from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.errors import InputError
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.table_layout import ANGLES, XYZ
from jaxphoto.io.text_tables import Table, content_lines, finite, read_columns

_MM = 0.001
# What the program gives every image coordinate; columns 5 and 6 of the .phc file are results.
_SIGMA_MM = 0.0005
_ENDS = (".ior", ".phc", ".eor", ".obc", ".scale")
_PHC = ("image", "point", "x", "y", "sx", "sy", "vx", "vy", "flag_1", "flag_2", "flag_3")
_EOR = ("image", "camera", *XYZ, *ANGLES, "flag_1", "flag_2", "flag_3")
_OBC = ("point", *XYZ, "sx", "sy", "sz", "rays", "flag_1", "flag_2", "flag_3")
_SCALE = ("bar", "name", "point_a", "point_b", "distance", "sigma", "flag")
_FREE = ("c_mm", "xp_mm", "yp_mm", "a1", "a2", "b1", "b2")


def recognises(source: Path) -> bool:
    """Whether `source` is one of the files, or a folder with exactly one of each kind that is needed."""
    return len(_stems(source)) == 1


def read_aicon(source: Path) -> BlockTables:
    """The free-network self-calibration of an AICON project: points and orientations start at the files' values.

    Image points count where all three flags are 1 and the point is in the .obc file. The datum is inner over the
    points; a scale bar gives the scale, without one the datum does.
    """
    stems = _stems(source)
    if len(stems) != 1:
        raise InputError(f"{source} holds {len(stems)} AICON projects (.ior, .phc, .eor, .obc); name one file of one")
    stem = stems[0]
    camera, interior = _camera(stem.with_suffix(".ior"))
    images = read_columns(stem.with_suffix(".eor"), _EOR, None)
    points = read_columns(stem.with_suffix(".obc"), _OBC, None)
    for line in np.flatnonzero(images.text("camera") != camera):
        raise images.bad(line, f"camera {images.text('camera')[line]} is not in {stem.name}.ior; add it there")
    observed = _observed(read_columns(stem.with_suffix(".phc"), _PHC, None), points)
    seen = np.isin(points.text("point").astype(str), observed.text("point").astype(str))
    tables = {
        "images": _with(
            images,
            {"image": images.ids("image"), "camera": images.ids("camera")}
            | {name: images.numbers(name) * _MM for name in XYZ}
            | {name: np.rad2deg(images.numbers(name)) for name in ANGLES},
        ),
        "image_points": _with(
            observed,
            {"image": observed.ids("image"), "point": observed.ids("point")}
            | {"x_mm": observed.numbers("x"), "y_mm": observed.numbers("y")},
        ),
        "object_points": _with(
            points, {"point": points.ids("point")} | {name: points.numbers(name) * _MM for name in XYZ}
        ).take(seen),
    }
    has_scale = stem.with_suffix(".scale").exists()
    if has_scale:
        bars = read_columns(stem.with_suffix(".scale"), _SCALE, None)
        bars = bars.take(bars.text("flag") == "1")
        tables["distances"] = _with(
            bars,
            {name: bars.ids(name) for name in ("point_a", "point_b")}
            | {"distance_m": bars.numbers("distance") * _MM, "sigma_m": bars.sigmas("sigma") * _MM},
        )
    settings = {
        "title": stem.name,
        "sigmas": {"image_mm": _SIGMA_MM},
        "cameras": {camera: interior},
        "datum": {"kind": "inner", "over": "points", "scale": not has_scale},
    }
    return BlockTables(settings, tables, f"{stem.name}.ior")


def _stems(source: Path) -> list[Path]:
    if source.is_dir():
        stems = sorted(path.with_suffix("") for path in source.glob("*.phc"))
    else:
        stems = [source.with_suffix("")] if source.suffix in _ENDS else []
    needed = (".ior", ".phc", ".eor", ".obc")
    return [stem for stem in stems if all(stem.with_suffix(end).is_file() for end in needed)]


def _camera(path: Path) -> tuple[str, dict[str, Any]]:
    """The camera's id and its [cameras.X] table, from the five lines of one camera."""
    lines, rows = content_lines(path)
    cells = [line.split() for line in lines]
    if [len(parts) for parts in cells] != [8, 1, 2, 2, 4]:
        raise InputError(
            f"{path.name}: the five lines of one camera (8, 1, 2, 2, 4 numbers) are expected; keep one camera"
        )
    values = []
    for parts, row in zip(cells, rows, strict=True):
        numbers = [number for cell in parts if (number := finite(cell)) is not None]
        if len(numbers) < len(parts):
            raise InputError(f"{path.name}, row {row}: a cell is not a finite number; correct it")
        values.append(numbers)
    if min(values[-1]) <= 0:
        raise InputError(f"{path.name}, row {rows[-1]}: the format in mm and pixels is positive; correct it")
    (_, _, c, x, y, a1, a2, r0), (a3,), (b1, b2), (c1, c2), (width_mm, height_mm, width, height) = values
    # One pixel size serves both axes: only the format is derived from it, the image coordinates are millimetres.
    pixel = (width_mm / width + height_mm / height) / 2
    interior = {
        "c_mm": -c, "xp_mm": x, "yp_mm": y, "a1": a1, "a2": a2, "a3": a3, "b1": b1, "b2": b2, "c1": c1, "c2": c2,
        "r0_mm": r0,
    }  # fmt: skip
    return cells[0][0], {
        "width_px": int(width), "height_px": int(height), "pixel_mm": pixel, "distortion": "balanced",
        "interior": interior, "unknowns": dict.fromkeys(_FREE, "free"),
    }  # fmt: skip


def _observed(table: Table, points: Table) -> Table:
    """The image points that count."""
    flags = np.stack([table.text(f"flag_{i}") == "1" for i in (1, 2, 3)])
    listed = np.isin(table.text("point").astype(str), points.ids("point").astype(str))
    return table.take(flags.all(axis=0) & listed)


def _with(table: Table, columns: dict[str, np.ndarray]) -> Table:
    return Table(table.file, columns, table.files, table.rows)
