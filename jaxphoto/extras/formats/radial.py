"""Bundler and "Bundle Adjustment in the Large" (BAL): cameras of f, k1 and k2 alone, one an image.

    bundle.out of Bundler, VisualSFM, Metashape        problem-N-M-pre.txt of BAL
    # Bundle file v0.3                                  cameras points observations
    cameras points                                      camera point x y           of every observation
    f k1 k2, three rows of R, t   of every camera       rotation vector, t, f, k1, k2  of every camera
    X Y Z, R G B, n (camera feature x y) ...            X Y Z                      of every point
                                  of every point

The camera sees P = R X + t along its -z, x right and y up, as ours; p = -P / P_z is seen at f (1 + k1 |p|^2 + k2 |p|^4)
p pixels from the middle of the image. f = 0 in Bundler marks an image that is not oriented; names of photographs are in
list.txt beside it (OpenSfM: list_r000.out beside bundle_r000.out). Neither has the format of an image: the smallest
about its middle that holds its points is taken. Written image points lie where the camera of f, k1 and k2 sees the rays
of the adjusted one, so nothing of the geometry is lost. Sources: N. Snavely, Bundler v0.4 User's Manual, "Output format
and scene representation"; grail.cs.washington.edu/projects/bal.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.arrays import as_jax_array
from jaxphoto.camera import BundlerRadial, InteriorOrientation, Perspective, Sensor
from jaxphoto.camera.conversion import Conversion
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.camera_models import CameraModel, ProjectCamera
from jaxphoto.extras.formats.files import Format, begins_with, by_content, content_rows, row_numbers, warn
from jaxphoto.extras.formats.project import Project, translations
from jaxphoto.io.camera_files import ASSUMED_PIXEL_MM
from jaxphoto.io.text_files import read_legacy_text
from jaxphoto.io.text_tables import LARGEST

BUNDLE, LIST = "bundle.out", "list.txt"
RADIAL = CameraModel(BundlerRadial, (), Perspective())
_HEAD = "# Bundle file v0.3"
# Least half format in f, for images with few points about the middle, and largest half format (px).
_LEAST_HALF, _LARGEST_HALF = 0.05, 1e6


class _Scene(NamedTuple):
    names: list[str]
    rotations: Float[np.ndarray, "images 3 3"]
    translations: Float[np.ndarray, "images 3"]
    values: Float[np.ndarray, "images 3"]
    """f (px), k1, k2."""
    xyz: Float[np.ndarray, "points 3"]
    image: np.ndarray
    point: np.ndarray
    xy: Float[np.ndarray, "n 2"]


def _project(path: Path, title: str, s: _Scene) -> Project:
    half = np.maximum(1.0, np.tile(_LEAST_HALF * s.values[:, :1], 2))
    np.maximum.at(half, s.image, np.abs(s.xy))
    size = 2 * np.ceil(np.minimum(half, _LARGEST_HALF)).astype(int)
    cameras = {}
    for k, ((width, height), (f, k1, k2)) in enumerate(zip(size.tolist(), s.values.tolist(), strict=True)):
        interior = InteriorOrientation(f * ASSUMED_PIXEL_MM, 0.0, 0.0, BundlerRadial(k1, k2))
        sensor = Sensor(width, height, ASSUMED_PIXEL_MM, pixel_assumed=True)
        cameras[str(k)] = ProjectCamera(sensor, jax.tree.map(as_jax_array, interior), ("c_mm", "k1", "k2"))
    return Project(
        title,
        cameras,
        (),
        s.names,
        list(cameras),
        ExteriorOrientation(translations(np.swapaxes(s.rotations, 1, 2), s.translations), s.rotations),  # type: ignore[arg-type]
        [str(k) for k in range(len(s.xyz))],
        s.xyz,
        s.image,
        s.point,
        size[s.image] / 2 + s.xy * [1.0, -1.0],
        file=path.name,
    )


# Bundler ------------------------------------------------------------------------------------------------------


def read_bundler(path: Path) -> Project:
    """Read a bundle file; images that are not oriented are skipped."""
    lines = read_legacy_text(path).split("\n")
    numbers = np.array(" ".join(line for line in lines if not line.startswith("#")).split(), float)
    if not (np.abs(numbers) <= LARGEST).all():
        raise InputError(f"{path.name}: a number is not finite or too large. Export it again")
    n_cameras, n_points = (_count(path, numbers, k, what) for k, what in enumerate(("cameras", "points")))
    at = 2 + 15 * n_cameras
    if len(numbers) < at + 7 * n_points:
        raise InputError(f"{path.name}: the file ends before its {n_cameras} cameras and {n_points} points do")
    cameras, xyz = numbers[2:at].reshape(n_cameras, 5, 3), np.zeros((n_points, 3))
    rows, point = [np.zeros((0, 4))], [np.zeros(0, int)]
    for k in range(n_points):
        many = _count(path, numbers, at + 6, f"measurements of point {k}")
        xyz[k], at = numbers[at : at + 3], at + 7
        if at + 4 * many > len(numbers):
            raise InputError(f"{path.name}: the file ends within point {k} of {n_points}. Export it again")
        rows.append(numbers[at : at + 4 * many].reshape(-1, 4))
        point.append(np.full(many, k))
        at += 4 * many
    measured = np.concatenate(rows)
    if not np.isin(measured[:, 0], np.arange(n_cameras)).all():
        raise InputError(f"{path.name}: a point is measured in a camera that is none of 0 to {n_cameras - 1}")
    oriented = np.flatnonzero(cameras[:, 0, 0] > 0)
    number = np.full(n_cameras, -1)
    number[oriented] = np.arange(len(oriented))
    image = number[measured[:, 0].astype(int)]
    kept = image >= 0
    names = _listed_names(path, n_cameras)
    scene = _Scene(
        [names[k] for k in oriented.tolist()], cameras[oriented, 1:4], cameras[oriented, 4], cameras[oriented, 0], xyz,
        image[kept], np.concatenate(point)[kept], measured[kept, 2:],
    )  # fmt: skip
    return _project(path, path.resolve().parent.name, scene)


def _listed_names(path: Path, number: int) -> list[str]:
    """Names of photographs: the first word of each row of list.txt, else their numbers."""
    stem = path.stem.replace("bundle", "list", 1)
    for name in (f"{path.stem}.txt", f"{stem}.txt", f"{stem}.out", LIST, "bundle.out.list.txt"):
        file = path.with_name(name)
        if file != path and file.is_file():
            names = [line.split()[0] for line in read_legacy_text(file).split("\n") if line.strip()]
            if len(names) != number:
                raise InputError(f"{file.name} names {len(names)} photographs and {path.name} has {number} cameras")
            return names
    warn(f"{path.name}: photographs have numbers, as no list.txt names them")
    return [str(k) for k in range(number)]


def _count(path: Path, numbers: np.ndarray, at: int, what: str) -> int:
    value = numbers[at] if at < len(numbers) else np.nan
    if not 0 <= value <= len(numbers) or value != int(value):
        raise InputError(f"{path.name}: the number of {what} is {value:g}, which cannot be. Export it again")
    return int(value)


def write_bundler(p: Project, folder: Path) -> None:
    """Write bundle.out and list.txt; points without image points are left out."""
    for file in p.files:
        if len(file.split()) != 1:
            raise InputError(f"{LIST} ends names at blanks, and {quoted(file)} has one; rename the photograph")
    words = lambda values: " ".join(map(repr, values))  # noqa: E731
    rotations, values = np.asarray(p.exterior.camera_from_object), _radial_values(p).tolist()
    moved = translations(rotations, p.exterior.position).tolist()
    shown = [rows for rows in p.rows_of_points if len(rows)]
    lines = [_HEAD, f"{len(p.files)} {len(shown)}"]
    for camera, rotation, translation in zip(values, rotations.tolist(), moved, strict=True):
        lines += [words(camera), *map(words, rotation), words(translation)]
    xy, image, key, xyz = (a.tolist() for a in (_from_middle(p), p.image, p.number_in_image, np.asarray(p.xyz)))
    for rows in shown:
        seen = " ".join(f"{image[k]} {key[k]} {words(xy[k])}" for k in rows.tolist())
        lines += [words(xyz[p.point[rows[0]]]), "0 0 0", f"{len(rows)} {seen}"]
    (folder / BUNDLE).write_text("\n".join(lines) + "\n", encoding="utf-8")
    listed = "".join(f"{file} 0 {camera[0]!r}\n" for file, camera in zip(p.files, values, strict=True))
    (folder / LIST).write_text(listed, encoding="utf-8")


# BAL ----------------------------------------------------------------------------------------------------------


def _is_bal(path: Path) -> bool:
    """Return True for three counts, then two indices and two numbers."""
    with path.open("rb") as file:
        first, second = (file.readline(200).split() for _ in range(2))
    indices = [cell.isdigit() for cell in (*first, *second[:2])]
    return len(first) == 3 and len(second) == 4 and all(indices)


def read_bal(path: Path) -> Project:
    """Read a problem; images and points have its numbers as ids."""
    rows = content_rows(path)
    counts = row_numbers(path, rows[0][0], rows[0][1].split(), 3) if rows else [0.0]
    if not all(count > 0 and count == int(count) for count in counts):
        raise InputError(
            f"{path.name}, row {rows[0][0] if rows else 1}: a BAL problem begins with the positive numbers of its "
            "cameras, points and observations. Write these three"
        )
    n_cameras, n_points, n = map(int, counts)
    if len(rows) <= n:
        raise InputError(f"{path.name}: the file ends after {len(rows) - 1} of {n} observations. Complete it")
    observed = np.array([row_numbers(path, row, line.split(), 4) for row, line in rows[1 : n + 1]])
    for k, (what, count) in enumerate((("camera", n_cameras), ("point", n_points))):
        for wrong in np.flatnonzero(~np.isin(observed[:, k], np.arange(count))):
            raise InputError(
                f"{path.name}, row {rows[wrong + 1][0]}: {what} is {observed[wrong, k]:g}; the {count} {what}s are "
                f"counted from 0 to {count - 1}"
            )
    pairs, times = np.unique(observed[:, :2], axis=0, return_counts=True)
    for camera, point in pairs[times > 1].astype(int).tolist():
        last = np.flatnonzero((observed[:, :2] == (camera, point)).all(axis=1))[-1]
        raise InputError(f"{path.name}, row {rows[last + 1][0]}: point {point} is measured twice in image {camera}.")
    words = [(row, word) for row, line in rows[n + 1 :] for word in line.split()]
    needed = 9 * n_cameras + 3 * n_points
    if len(words) != needed:
        raise InputError(
            f"{path.name}: {len(words)} numbers follow the observations, but {n_cameras} cameras and {n_points} points "
            f"have {needed} (9 a camera, 3 a point). Complete the file or correct row {rows[0][0]}"
        )
    values = np.array([row_numbers(path, row, [word], 1)[0] for row, word in words])
    cameras = values[: 9 * n_cameras].reshape(-1, 9)
    for camera in np.flatnonzero(cameras[:, 6] <= 0).tolist():
        raise InputError(
            f"{path.name}, row {words[9 * camera + 6][0]}: f of camera {camera} is {cameras[camera, 6]:g}. Give a "
            "positive focal length"
        )
    rotations = scipy.spatial.transform.Rotation.from_rotvec(cameras[:, :3]).as_matrix()
    index = observed[:, :2].astype(int)
    scene = _Scene(
        [str(k) for k in range(n_cameras)], rotations, cameras[:, 3:6], cameras[:, 6:],
        values[9 * n_cameras :].reshape(-1, 3), index[:, 0], index[:, 1], observed[:, 2:],
    )  # fmt: skip
    return _project(path, path.stem, scene)


def write_bal(p: Project, folder: Path) -> None:
    """Write problem-N-M-pre.txt of N images and M points, without points that have no image points."""
    rotations = np.asarray(p.exterior.camera_from_object)
    vectors = scipy.spatial.transform.Rotation.from_matrix(rotations).as_rotvec()
    cameras = np.hstack([vectors, translations(rotations, p.exterior.position), _radial_values(p)])
    points, number = np.unique(p.point, return_inverse=True)
    order = np.lexsort((p.image, number))
    rows = zip(p.image[order].tolist(), number[order].tolist(), _from_middle(p)[order].tolist(), strict=True)
    lines = [f"{len(p.files)} {len(points)} {len(order)}", *(f"{i} {j} {x!r} {y!r}" for i, j, (x, y) in rows)]
    lines += map(repr, [*cameras.ravel().tolist(), *np.asarray(p.xyz)[points].ravel().tolist()])
    path = folder / f"problem-{len(p.files)}-{len(points)}-pre.txt"
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


# Rays ---------------------------------------------------------------------------------------------------------


def on_same_rays(p: Project, cameras: Mapping[str, Conversion]) -> Float[np.ndarray, "n 2"]:
    """Return the image points (px) at which converted cameras see the rays of `p`.

    Raises InputError for an image point without ray, where a distortion is not invertible.
    """
    column_row, of_row = p.column_row.copy(), np.array(p.image_camera, object)[p.image]
    for name, (sensor, interior, _) in p.cameras.items():
        rows = np.flatnonzero(of_row == name)
        if cameras[name].max_px == 0 or not len(rows):
            continue
        # To a power of two: one program serves many cameras.
        xy = np.zeros((1 << (len(rows) - 1).bit_length(), 2))
        xy[: len(rows)] = sensor.mm_from_px(column_row[rows])
        moved, good = (np.asarray(v)[: len(rows)] for v in call_compiled(_moved, interior, cameras[name].interior, xy))
        for k in rows[~good]:
            raise InputError(
                f"point {p.points[p.point[k]]} in image {p.images[p.image[k]]} lies where the distortion of camera "
                f"{name} is not invertible. Delete the image point, or correct the camera"
            )
        column_row[rows] = sensor.px_from_mm(moved)
    return column_row


@eqx.filter_jit
def _moved(one: InteriorOrientation, other: InteriorOrientation, xy):
    """Where `other` sees the rays that `one` has at image points (mm), and whether these have any."""

    def of_one(at):
        ideal = one.ideal_from_measured(at)
        u, v, w = one.direction_from_ideal(ideal)
        there = other.ideal_from_direction(u, v, w)
        back = jnp.max(jnp.abs(one.measured_from_ideal(ideal) - at))
        good = one.invertible(ideal) & other.invertible(there) & (back < 1e-9 * one.c)
        return other.measured_from_ideal(there), good

    return jax.vmap(of_one)(xy)


def _from_middle(p: Project) -> Float[np.ndarray, "n 2"]:
    """Image points in pixels from the principal point, x right and y up."""
    middle = {
        name: sensor.px_from_mm(np.array([[float(interior.x_p), float(interior.y_p)]]))[0]
        for name, (sensor, interior, _) in p.cameras.items()
    }
    of_image = np.array([middle[name] for name in p.image_camera]).reshape(-1, 2)
    return (p.column_row - of_image[p.image]) * [1.0, -1.0]


def _radial_values(p: Project) -> Float[np.ndarray, "images 3"]:
    """f in pixels, k1 and k2 of each image."""
    values = {
        name: [float(c.interior.c) / c.sensor.pixel_mm, *c.terms(("k1", "k2")).values()]
        for name, c in p.cameras.items()
    }
    return np.array([values[name] for name in p.image_camera]).reshape(-1, 3)


FORMATS = (
    Format(
        "bundler", "bundle.out of Bundler, with list.txt: f, k1, k2",
        by_content("*.out", lambda path: begins_with(path, _HEAD)), read_bundler, write=write_bundler, plane=RADIAL,
        endings=(".out", ".txt"), keeps_rays=True,
    ),
    Format(
        "bal", "problem of bundle adjustment in the large: f, k1, k2", by_content("*.txt", _is_bal), read_bal,
        write=write_bal, plane=RADIAL, endings=(".txt",), keeps_rays=True,
    ),
)  # fmt: skip
