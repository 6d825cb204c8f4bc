"""Bundler and "Bundle Adjustment in the Large" (BAL): one camera per image, with parameters f, k1 and k2.

    bundle.out of Bundler, Metashape                   problem-N-M-pre.txt of BAL
    # Bundle file v0.3                                  cameras points observations
    cameras points                                      camera point x y           of every observation
    f k1 k2, three rows of R, t   of every camera       rotation vector, t, f, k1, k2  of every camera
    X Y Z, R G B, n (camera feature x y) ...            X Y Z                      of every point
                                  of every point

Camera coordinates P = R X + t have x right, y up and view along -z, like ours. With p = -P / P_z the image point is f
(1 + k1 |p|^2 + k2 |p|^4) p pixels from the image centre. In Bundler f = 0 marks an image without orientation; names of
photographs are in list.txt of the same folder (OpenSfM: list_r000.out for bundle_r000.out). Neither file contains the
image format: the smallest centred format that contains the image points is used. Image points exported as BAL are
computed from the rays of the adjusted camera: the geometry is preserved exactly. Sources: N. Snavely,
Bundler v0.4 User's Manual, "Output format and scene representation"; grail.cs.washington.edu/projects/bal.
"""

from collections.abc import Mapping
from pathlib import Path

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
from jaxphoto.errors import InputError
from jaxphoto.extras.formats.files import Format, by_content, content_rows, row_numbers, warn
from jaxphoto.extras.formats.project import CameraModel, Project, ProjectCamera, pixels_of, translations
from jaxphoto.io.camera_files import ASSUMED_PIXEL_MM
from jaxphoto.io.text_files import has_words, read_text
from jaxphoto.io.text_tables import LARGEST

LIST = "list.txt"
RADIAL = CameraModel(BundlerRadial, (), Perspective())
_HEAD = "# Bundle file v0.3"
# Minimum half format as a fraction of f (for images with central points only), and maximum half format (px).
_LEAST_HALF, _LARGEST_HALF = 0.05, 1e6


def _project(
    path: Path,
    names: list[str],
    rotations: Float[np.ndarray, "images 3 3"],
    moved: Float[np.ndarray, "images 3"],
    values: Float[np.ndarray, "images 3"],
    xyz: Float[np.ndarray, "points 3"],
    observed: Float[np.ndarray, "n 4"],
) -> Project:
    """Build a project from names, R, t, (f, k1, k2) of the images, object points, and rows of image, point, x, y."""
    (image, point), xy = observed[:, :2].T.astype(int), observed[:, 2:]
    half = np.maximum(1.0, np.tile(_LEAST_HALF * values[:, :1], 2))
    np.maximum.at(half, image, np.abs(xy))
    size = 2 * np.ceil(np.minimum(half, _LARGEST_HALF)).astype(int)
    cameras = {}
    for k, ((width, height), (f, k1, k2)) in enumerate(zip(size.tolist(), values.tolist(), strict=True)):
        interior = InteriorOrientation(f * ASSUMED_PIXEL_MM, 0.0, 0.0, BundlerRadial(k1, k2))
        sensor = Sensor(width, height, ASSUMED_PIXEL_MM, pixel_assumed=True)
        cameras[str(k)] = ProjectCamera(sensor, jax.tree.map(as_jax_array, interior), ("c_mm", "k1", "k2"))
    exterior = ExteriorOrientation(translations(np.swapaxes(rotations, 1, 2), moved), rotations)  # type: ignore[arg-type]
    return Project(
        path.stem, cameras, (), names, list(cameras), exterior, [str(k) for k in range(len(xyz))], xyz, image, point,
        size[image] / 2 + xy * [1.0, -1.0], file=path.name,
    )  # fmt: skip


# Bundler ------------------------------------------------------------------------------------------------------


def read_bundler(path: Path) -> Project:
    """Read a bundle file; images without orientation are skipped."""
    lines = read_text(path).split("\n")
    numbers = np.array(" ".join(line for line in lines if not line.startswith("#")).split(), float)
    if not (np.abs(numbers) <= LARGEST).all():
        raise InputError(f"{path.name}: a number is not finite or too large. Export it again")
    at = 0

    def take(many: int, what: str) -> np.ndarray:
        nonlocal at
        if many < 0 or at + many > len(numbers):
            raise InputError(f"{path.name}: the file ends within {what}. Export it again")
        at += many
        return numbers[at - many : at]

    n_cameras, n_points = take(2, "its header").astype(int).tolist()
    cameras = take(15 * n_cameras, f"its {n_cameras} cameras").reshape(-1, 5, 3)
    xyz, rows = np.zeros((max(n_points, 0), 3)), [np.zeros((0, 4))]
    for k in range(n_points):
        xyz[k] = take(7, f"point {k} of {n_points}")[:3]
        measured = take(4 * int(numbers[at - 1]), f"point {k} of {n_points}").reshape(-1, 4)
        rows.append(np.column_stack([measured[:, 0], np.full(len(measured), k), measured[:, 2:]]))
    observed = np.concatenate(rows)
    if not np.isin(observed[:, 0], np.arange(n_cameras)).all():
        raise InputError(f"{path.name}: a point has a camera outside 0 to {n_cameras - 1}. Export it again")
    oriented = np.flatnonzero(cameras[:, 0, 0] > 0)
    observed = observed[np.isin(observed[:, 0], oriented)]
    observed[:, 0] = np.searchsorted(oriented, observed[:, 0])
    names, cameras = _listed_names(path, n_cameras), cameras[oriented]
    project = _project(
        path, [names[k] for k in oriented.tolist()], cameras[:, 1:4], cameras[:, 4], cameras[:, 0], xyz, observed
    )
    return project._replace(title=path.resolve().parent.name)


def _listed_names(path: Path, number: int) -> list[str]:
    """Return photograph names: the first word of each row of list.txt, otherwise the camera indices."""
    stem = path.stem.replace("bundle", "list", 1)
    for file in (path.with_name(name) for name in (f"{stem}.txt", f"{stem}.out", LIST)):
        if file != path and file.is_file():
            names = [line.split()[0] for line in read_text(file).split("\n") if line.strip()]
            if len(names) != number:
                raise InputError(
                    f"{file.name} has {len(names)} photographs, but {path.name} has {number} cameras; complete it"
                )
            return names
    warn(f"{path.name}: list.txt not found; photographs are numbered")
    return [str(k) for k in range(number)]


# BAL ----------------------------------------------------------------------------------------------------------


def _is_bal(path: Path) -> bool:
    """Return True if the first row has three counts and the second two indices and two coordinates."""
    with path.open("rb") as file:
        first, second = (file.readline(200).split() for _ in range(2))
    return len(first) == 3 and len(second) == 4 and all(cell.isdigit() for cell in (*first, *second[:2]))


def read_bal(path: Path) -> Project:
    """Read a problem; ids of images and points are their indices."""
    rows = content_rows(path)
    counts = row_numbers(path, rows[0][0], rows[0][1].split(), 3) if rows else [0.0]
    if not all(count > 0 and count == int(count) for count in counts):
        raise InputError(f"{path.name}, row 1: write the positive counts of cameras, points and observations")
    n_cameras, n_points, n = map(int, counts)
    if len(rows) <= n:
        raise InputError(f"{path.name}: the file ends after {len(rows) - 1} of {n} observations. Complete it")
    observed = np.array([row_numbers(path, row, line.split(), 4) for row, line in rows[1 : n + 1]])
    for k, (what, count) in enumerate((("camera", n_cameras), ("point", n_points))):
        for wrong in np.flatnonzero(~np.isin(observed[:, k], np.arange(count))):
            raise InputError(f"{path.name}, row {rows[wrong + 1][0]}: {what} is not an integer from 0 to {count - 1}")
    rest = [(row, line.split()) for row, line in rows[n + 1 :]]
    values = np.array([number for row, words in rest for number in row_numbers(path, row, words, len(words))])
    needed = 9 * n_cameras + 3 * n_points
    if len(values) != needed:
        raise InputError(
            f"{path.name}: {len(values)} numbers follow the observations, but {n_cameras} cameras and {n_points} "
            f"points need {needed} (9 per camera, 3 per point). Complete the file or correct row {rows[0][0]}"
        )
    cameras = values[: 9 * n_cameras].reshape(-1, 9)
    for camera in np.flatnonzero(cameras[:, 6] <= 0).tolist():
        raise InputError(f"{path.name}: f of camera {camera} is {cameras[camera, 6]:g}. Give a positive focal length")
    rotations = scipy.spatial.transform.Rotation.from_rotvec(cameras[:, :3]).as_matrix()
    names, xyz = [str(k) for k in range(n_cameras)], values[9 * n_cameras :].reshape(-1, 3)
    return _project(path, names, rotations, cameras[:, 3:6], cameras[:, 6:], xyz, observed)


def write_bal(p: Project, folder: Path) -> None:
    """Write problem-N-M-pre.txt of N images and M points; object points without image points are omitted."""
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
    """Return the image points (px) of the converted cameras for the rays of `p`.

    Raises InputError for image points where a distortion is not invertible.
    """
    column_row, of_row = p.column_row.copy(), np.array(p.image_camera, object)[p.image]
    for name, (sensor, interior, _) in p.cameras.items():
        rows = np.flatnonzero(of_row == name)
        if cameras[name].max_px == 0 or not len(rows):
            continue
        xy = sensor.mm_from_px(column_row[rows])
        moved, good = map(np.asarray, call_compiled(_moved, interior, cameras[name].interior, xy))
        for k in rows[~good]:
            raise InputError(
                f"point {p.points[p.point[k]]} in image {p.images[p.image[k]]} is where the distortion of camera "
                f"{name} is not invertible. Delete the image point, or correct the camera"
            )
        column_row[rows] = sensor.px_from_mm(moved)
    return column_row


@eqx.filter_jit
def _moved(one: InteriorOrientation, other: InteriorOrientation, xy):
    """Map image points (mm) of camera `one` to `other` by their rays; the mask is True where both are invertible."""

    def of_one(at):
        ideal = one.ideal_from_measured(at)
        there = other.ideal_from_direction(*one.direction_from_ideal(ideal))
        back = jnp.max(jnp.abs(one.measured_from_ideal(ideal) - at))
        good = one.invertible(ideal) & other.invertible(there) & (back < 1e-9 * one.c)
        return other.measured_from_ideal(there), good

    return jax.vmap(of_one)(xy)


def _from_middle(p: Project) -> Float[np.ndarray, "n 2"]:
    """Return image points in pixels relative to the principal point, x right, y up."""
    middle = {name: pixels_of(camera.interior, camera.sensor)[2:] for name, camera in p.cameras.items()}
    of_image = np.array([middle[name] for name in p.image_camera]).reshape(-1, 2)
    return (p.column_row - of_image[p.image]) * [1.0, -1.0]


def _radial_values(p: Project) -> Float[np.ndarray, "images 3"]:
    """Return f in pixels, k1 and k2 of each image."""
    values = {
        name: [pixels_of(c.interior, c.sensor)[1], *c.terms(("k1", "k2")).values()] for name, c in p.cameras.items()
    }
    return np.array([values[name] for name in p.image_camera]).reshape(-1, 3)


FORMATS = (
    Format(
        "bundler", "bundle.out of Bundler, with list.txt: f, k1, k2",
        by_content("*.out", lambda path: has_words(path, _HEAD)), read_bundler,
    ),
    Format(
        "bal", "problem of bundle adjustment in the large: f, k1, k2", by_content("*.txt", _is_bal), read_bal,
        write=write_bal, plane=RADIAL, endings=(".txt",), keeps_rays=True,
    ),
)  # fmt: skip
