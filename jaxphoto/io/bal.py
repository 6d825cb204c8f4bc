"""Problem files of "Bundle Adjustment in the Large" (BAL) -> the tables of a block folder.

The file is numbers between blanks: how many cameras, points and observations; per observation camera, point, x and y;
nine numbers per camera (a rotation vector, t, f, k1, k2) and three per point. The camera sees P = R X + t along its -z,
x right and y up as ours does, so `camera_from_object` is R and the projection centre -R't; the distortion is
`BundlerRadial`. Every camera of the file took one image. Source: grail.cs.washington.edu/projects/bal.

Pixels have no size and images no format there. One pixel is written as one micrometre, so that c in um is f in pixels,
and the format of an image is the smallest about its centre that holds its points. Every coordinate has the standard
deviation of one pixel: half the weighted square sum is the cost of that literature.
"""

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.table_layout import ANGLES, XYZ
from jaxphoto.io.text_tables import LARGEST, Table, content_lines, is_number, natural
from jaxphoto.rotation import omega_phi_kappa_from_matrix, small_rotation

_PIXEL_MM = 0.001
_COUNTS = ("cameras", "points", "observations")
_OBSERVATION = ("camera", "point", "x", "y")
_PER_CAMERA, _PER_POINT = 9, 3
# Where f, k1 and k2 stand among the nine of a camera.
_F = 6
# Half a format that no camera has: what is larger is refused as one.
_LARGEST_HALF = 1e9
_FREE = ("c_mm", "k1", "k2")


class _Problem(NamedTuple):
    """The numbers of a file: (n, 9) per camera, (n, 3) per point, and the row at which each of them begins.

    `observed` has the rows of the observations; `camera`, `point` (n,) and `xy` (n, 2) in pixels are their content.
    """

    observed: Table
    camera: np.ndarray
    point: np.ndarray
    xy: np.ndarray
    cameras: np.ndarray
    camera_rows: np.ndarray
    points: np.ndarray
    point_rows: np.ndarray


def recognises(source: Path) -> bool:
    """Whether `source` is such a file, or a folder that holds exactly one."""
    return len(_problems(source)) == 1


def read_bal(source: Path) -> BlockTables:
    """The free-network self-calibration of a BAL problem: c, k1 and k2 of every image, from the values of the file.

    Image and camera have the number of the file's camera as id, points that of the file's point. The datum is inner
    over the points: seven parameters are open, the cost does not depend on them. Points of fewer than two images add
    nothing to the optimum and are left out with a UserWarning.

    Raises InputError for counts, numbers and indices that do not fit together, naming the row.
    """
    problems = [source] if source.is_file() else _problems(source)
    if len(problems) != 1:
        raise InputError(f"{source} holds {len(problems)} BAL problems (*.txt that begin with three counts); name one")
    path = problems[0]
    problem = _read(path)
    images = np.array([str(i) for i in range(len(problem.cameras))], object)
    points = np.array([str(j) for j in range(len(problem.points))], object)
    kept = _seen_twice(path, problem)
    centres, angles = _orientations(problem.cameras)
    x_mm, y_mm = problem.xy.T * _PIXEL_MM
    tables = {
        "images": Table.of(
            path.name,
            {"image": images, "camera": images} | _columns(XYZ, centres) | _columns(ANGLES, np.rad2deg(angles)),
            problem.camera_rows,
        ),
        "image_points": Table.of(
            path.name,
            {"image": images[problem.camera], "point": points[problem.point], "x_mm": x_mm, "y_mm": y_mm},
            problem.observed.rows,
        ).take(kept[problem.point]),
        "object_points": Table.of(
            path.name, {"point": points} | _columns(XYZ, problem.points), problem.point_rows
        ).take(kept),
    }
    settings = {
        "title": path.stem,
        "sigmas": {"image_px": 1.0},
        "cameras": _cameras(images, problem),
        "datum": {"kind": "inner", "over": "points"},
    }
    return BlockTables(settings, tables, path.name)


def _read(path: Path) -> _Problem:
    lines, rows = content_lines(path)
    n_cameras, n_points, n_observations = _counts(path, lines, rows)
    end = 1 + n_observations
    observed = _observations(path, lines[1:end], rows[1:end], n_observations)
    camera, point = _indices(observed, "camera", n_cameras), _indices(observed, "point", n_points)
    xy = np.stack([observed.numbers("x"), observed.numbers("y")], axis=1)
    split = _PER_CAMERA * n_cameras
    values, row_of = _parameters(path, lines[end:], rows[end:], split + _PER_POINT * n_points)
    for k in np.arange(_F, split, _PER_CAMERA)[values[_F:split:_PER_CAMERA] <= 0]:
        raise InputError(
            f"{path.name}, row {row_of[k]}: f of camera {k // _PER_CAMERA} is {values[k]:g}; a focal length is "
            "positive in BAL, where cameras look along -z: correct it"
        )
    return _Problem(
        observed, camera, point, xy,
        values[:split].reshape(-1, _PER_CAMERA), row_of[:split:_PER_CAMERA],
        values[split:].reshape(-1, _PER_POINT), row_of[split::_PER_POINT],
    )  # fmt: skip


def _problems(source: Path) -> list[Path]:
    paths = sorted(source.glob("*.txt")) if source.is_dir() else [source]
    return [path for path in paths if path.is_file() and _opens_as_bal(path)]


def _opens_as_bal(path: Path) -> bool:
    """Three counts, then two indices and two numbers."""
    with path.open("rb") as file:
        first, second = (file.readline(200).split() for _ in range(2))
    return (
        [cell.isdigit() for cell in first] == [True] * 3
        and [cell.isdigit() for cell in second[:2]] == [True] * 2
        and len(second) == 4
    )


def _counts(path: Path, lines: list[str], rows: list[int]) -> list[int]:
    counts = [natural(cell) for cell in lines[0].split()] if lines else []
    known = [count for count in counts if count]
    if len(counts) != len(_COUNTS) or len(known) != len(_COUNTS):
        row = rows[0] if rows else 1
        raise InputError(
            f"{path.name}, row {row}: a BAL problem begins with the numbers of its cameras, points and observations; "
            "write these three, or give a text file of that kind (the published ones are unpacked by bunzip2)"
        )
    return known


def _observations(path: Path, lines: list[str], rows: list[int], count: int) -> Table:
    cells = [line.split() for line in lines]
    for parts, row in zip(cells, rows, strict=True):
        if len(parts) != len(_OBSERVATION):
            raise InputError(
                f"{path.name}, row {row}: {len(parts)} cells instead of {len(_OBSERVATION)} "
                f"({', '.join(_OBSERVATION)}); complete the row, or correct the {count} observations of the first row"
            )
    if len(cells) < count:
        raise InputError(
            f"{path.name}: the file ends after {len(cells)} of {count} observations; complete it or load it again"
        )
    columns = {name: np.array([parts[j] for parts in cells], object) for j, name in enumerate(_OBSERVATION)}
    return Table.of(path.name, columns, np.array(rows, int))


def _indices(observed: Table, column: str, count: int) -> np.ndarray:
    """A column of numbers from 0 to `count` - 1."""
    indices = np.zeros(len(observed), int)
    for line, cell in enumerate(observed.text(column)):
        index = natural(cell)
        if index is None or index >= count:
            raise observed.bad(
                line, f"{column} is {quoted(cell)}; the {count} {column}s are counted from 0 to {count - 1}"
            )
        indices[line] = index
    return indices


def _parameters(path: Path, lines: list[str], rows: list[int], needed: int) -> tuple[np.ndarray, np.ndarray]:
    """All numbers after the observations, and the row of each."""
    split = [line.split() for line in lines]
    cells = [cell for parts in split for cell in parts]
    row_of = np.repeat(np.array(rows, int), [len(parts) for parts in split])
    if len(cells) != needed:
        raise InputError(
            f"{path.name}: {len(cells)} numbers follow the observations, but the cameras and points of the first row "
            f"have {needed} ({_PER_CAMERA} a camera, {_PER_POINT} a point); complete the file or correct that row"
        )
    for cell, row in zip(cells, row_of, strict=True):
        if not is_number(cell):
            raise InputError(f"{path.name}, row {row}: {quoted(cell)} is not a number; write it like 12.34")
    values = np.array(list(map(float, cells)))
    for k in np.flatnonzero(~(np.abs(values) <= LARGEST)):
        raise InputError(
            f"{path.name}, row {row_of[k]}: {quoted(cells[k])} is not finite or too large; give a finite number"
        )
    return values, row_of


def _seen_twice(path: Path, problem: _Problem) -> np.ndarray:
    """Which points two images or more show; a UserWarning names the others."""
    pairs = np.unique(np.stack([problem.point, problem.camera]), axis=1)
    kept = np.bincount(pairs[0], minlength=len(problem.points)) >= 2
    if not kept.all():
        few = np.flatnonzero(~kept)
        listed = ", ".join(map(str, few[:5])) + (", ..." if len(few) > 5 else "")
        warnings.warn(
            f"{path.name}: {len(few)} point(s) are measured in fewer than two images and are not used: {listed}",
            UserWarning,
            stacklevel=2,
        )
    return kept


@jax.jit
def _oriented(vectors, translations):
    # `small_rotation` turns the axes, the vector of the file turns the point: hence the sign.
    matrices = jax.vmap(small_rotation)(-vectors)
    return -jnp.einsum("nji,nj->ni", matrices, translations), jax.vmap(omega_phi_kappa_from_matrix)(matrices)


def _orientations(cameras: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projection centres and omega, phi, kappa in radians, both (n, 3)."""
    centres, angles = _oriented(jnp.asarray(cameras[:, :3]), jnp.asarray(cameras[:, 3:_F]))
    return np.asarray(centres), np.asarray(angles)


def _cameras(names: np.ndarray, problem: _Problem) -> dict[str, dict[str, Any]]:
    """The tables [cameras.X]."""
    # A tenth of f at least, so that few points about the centre leave a format that can be.
    half = np.maximum(1.0, problem.cameras[:, [_F, _F]] / 20)
    np.maximum.at(half, problem.camera, np.abs(problem.xy))
    sizes = (2 * np.ceil(np.minimum(half, _LARGEST_HALF))).astype(int).tolist()
    return {
        name: {
            "width_px": width, "height_px": height, "pixel_mm": _PIXEL_MM, "pixel_assumed": True,
            "distortion": "bundler_radial",
            "interior": {"c_mm": f * _PIXEL_MM, "k1": k1, "k2": k2}, "unknowns": dict.fromkeys(_FREE, "free"),
        }
        for name, (width, height), (f, k1, k2) in zip(names, sizes, problem.cameras[:, _F:].tolist(), strict=True)
    }  # fmt: skip


def _columns(names: tuple[str, ...], values: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(names, values.T, strict=True))
