"""Exported photographs of `tests.io.test_exports`, with image points as texts beside them; reprojection errors."""

import jax
import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.extras.formats import ProjectCamera, export
from jaxphoto.io.block_folder.table_layout import ANGLES, XYZ
from tests.formulas import camera_from_object
from tests.io.test_exports import SENSOR, photographs

_projected = jax.jit(jax.vmap(project, (None, 0, 0)))


def misfits_px(block, points=None, exterior=None):
    """Image points measured minus projected (px), of the start values or of `points` and `exterior`."""
    rows, start = block.image_points, block.start.unknowns
    image = np.asarray(rows.image)
    xyz = np.asarray(start.points if points is None else points)[np.asarray(rows.point)]
    at = jax.tree.map(lambda leaf: np.asarray(leaf)[image], start.exterior if exterior is None else exterior)
    cameras, found = np.array(block.image_camera, object)[image], np.zeros((len(image), 2))
    for name, interior in start.interior.items():
        of = np.flatnonzero(cameras == name)
        projected = _projected(interior, jax.tree.map(lambda leaf, of=of: leaf[of], at), xyz[of])
        found[of] = (np.asarray(rows.xy)[of] - projected) / block.sensors[name].pixel_mm
    return found


def inside(camera="agisoft", kind="epsg"):
    """Four photographs, with the image points that lie in their formats."""
    p = photographs(camera, kind)
    there = ((p.column_row > 0) & (p.column_row < [SENSOR.width_px, SENSOR.height_px])).all(axis=1)
    return p._replace(image=p.image[there], point=p.point[there], column_row=p.column_row[there])


def text_of_points(p, head, unit_mm=1.0):
    """Image points in a text: in units of `unit_mm` from the middle, y up, or pixels where that is 0."""
    lines = []
    for name, rows in zip(p.files, p.rows_of_images, strict=True):
        lines.append(head.format(name.rsplit(".", 1)[0]))
        for k in rows.tolist():
            column, row = p.column_row[k].tolist()
            x, y = (column - SENSOR.width_px / 2) * SENSOR.pixel_mm, (SENSOR.height_px / 2 - row) * SENSOR.pixel_mm
            at = (x / unit_mm, y / unit_mm) if unit_mm else (column, row)
            lines.append(f"{p.points[p.point[k]]} {at[0]!r} {at[1]!r} 0")
        lines.append("-99")
    return "\n".join(lines) + "\n"


BINGO = "{} H_9.6_7.2"


def write_metashape(folder, camera="agisoft", kind="epsg", change=lambda text: text, ties=True):
    """cameras.xml as `--to metashape` writes it, and BINGO's image points."""
    p = inside(camera, kind)
    export(p, folder, "metashape")
    path = folder / "cameras.xml"
    path.write_text(change(path.read_text()))
    (folder / "image_points.csv").unlink()
    if ties:
        (folder / "bingo.txt").write_text(text_of_points(p, BINGO))
    return folder


def markers(p, names, coordinates):
    """Elements of a chunk: markers with coordinates, marked where the photographs show points of these names."""
    own, marks = "", ""
    for k, (name, (x, y, z)) in enumerate(zip(names, np.asarray(coordinates).tolist(), strict=True)):
        enabled = "true" if k else "false"
        place = f'<reference x="{x!r}" y="{y!r}" z="{z!r}" enabled="{enabled}"/>'
        own += f'<marker id="{k}" label="{name}">{place}</marker>'
        marks += f'<marker marker_id="{k}">'
        for row in np.flatnonzero(p.point == p.points.index(name)):
            column, line = p.column_row[row].tolist()
            marks += f'<location camera_id="{p.image[row]}" pinned="true" x="{column!r}" y="{line!r}"/>'
        marks += "</marker>"
    return f'<markers>{own}</markers><frames><frame id="0"><markers>{marks}</markers></frame></frames>'


PATB = "{} 8800.0 0"


def write_angles(folder, kind="epsg", change=lambda text: text, points="bingo"):
    """exterior.txt and camera.toml as `--to opk` writes them, and image points in its form or one of three others."""
    p = inside("opencv", kind)
    export(p, folder, "opk")
    path = folder / "exterior.txt"
    path.write_text(change(path.read_text()))
    if points == "own":
        return folder
    (folder / "image_points.csv").unlink()
    head, unit = {"bingo": (BINGO, 1.0), "patb": (PATB, 1e-3), "pix4d": ("{}", 0.0)}[points]
    (folder / "ties.dat").write_text(text_of_points(p, head, unit))
    return folder


def write_patb(folder, kind="local", change=lambda text: text):
    """PATB's orientations, in three rows a photograph, with PATB's image points and the camera of `--to opk`."""
    p = inside("opencv", kind)
    write_angles(folder, kind, points="patb")
    (folder / "exterior.txt").unlink()
    on_map = p.in_map().exterior
    lines = []
    for name, at, r in zip(p.images, *map(np.asarray, (on_map.position, on_map.camera_from_object)), strict=True):
        a = [f"{value:.17g}" for value in r.T.ravel()]
        lines += [" ".join([name, "8800.0", *map(repr, at.tolist())]), " ".join(a[:5]), " ".join(a[5:])]
    (folder / "patb.ori").write_text(change("\n".join(lines) + "\n"))
    return folder


def write_bingo(folder, kind="local", change=lambda text: text):
    """itera.dat: object points, then orientations whose angles turn about Y, X and Z one after the other, in gon."""
    p = inside("opencv", kind)
    write_angles(folder, kind)
    (folder / "exterior.txt").unlink()
    on_map = p.in_map().exterior
    lines = ["* phi omega kappa", *(f"CORD {k} {k}.5 2.5 3.5" for k in range(60))]
    for name, at, r in zip(p.images, *map(np.asarray, (on_map.position, on_map.camera_from_object)), strict=True):
        angles = Rotation.from_matrix(r.T).as_euler("YXZ", degrees=True) / 0.9
        lines.append(" ".join(["ORIA", name, *map(repr, at.tolist()), *map(repr, angles.tolist()), "1"]))
    control = [f"CONT {k} {k}00.5 20.5 3.5 0.02 0.02 0.03" for k in range(9)]
    (folder / "geoin.dat").write_text("\n".join(["* a project", *control]) + "\n")
    (folder / "itera.dat").write_text(change("\n".join(lines) + "\n"))
    return folder


_metre, _angle = st.floats(-2000.0, 2000.0), st.floats(-3.1, 3.1)
poses = st.lists(st.tuples(_metre, _metre, _metre, _angle, st.floats(-1.5, 1.5), _angle), min_size=4, max_size=4)
"""Positions and omega, phi, kappa of four photographs."""


def posed(values, interior):
    """Photographs so oriented, and points anywhere."""
    turn = np.stack([camera_from_object(*row[3:]) for row in values])
    exterior = ExteriorOrientation(np.array(values)[:, :3], turn)
    return photographs("brown", "local")._replace(exterior=exterior, cameras={"one": ProjectCamera(SENSOR, interior)})


def come_back(p, tables, names):
    """Tables that a reader made have the poses and points of `p`; its images are called `names` there."""
    table, points = tables.tables["images"], tables.tables["object_points"]
    order = [names.index(name) for name in table.text("image")]
    position, angles = (np.stack([table.numbers(n) for n in columns], axis=1) for columns in (XYZ, ANGLES))
    np.testing.assert_allclose(position, np.asarray(p.exterior.position)[order], rtol=0, atol=1e-9)
    again = np.stack([camera_from_object(*row) for row in np.deg2rad(angles)])
    np.testing.assert_allclose(again, np.asarray(p.exterior.camera_from_object)[order], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(np.stack([points.numbers(n) for n in XYZ], axis=1), p.xyz)
