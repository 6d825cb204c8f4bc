"""Boards, block, distortion model, free parameters and initial values of a calibration.

1. OpenCV estimates c, k1 and k2 from views of a flat board (Zhang, 2000), with the principal point in the centre.
2. The coefficients of any distortion model are fitted to this distortion over the format.

Residuals are in the measured image, in pixels; their RMS is defined as in OpenCV.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import (
    AbstractDistortion,
    InteriorOrientation,
    Sensor,
    Smac,
    get_parameter,
    parameter_names,
    set_parameter,
    table_name,
)
from jaxphoto.camera.distortion.open_cv import OpenCv
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError, InputError
from jaxphoto.initial.quaternion_resection import resect_by_quaternions
from jaxphoto.initial.rays import ideal_coordinates, padded_length
from jaxphoto.initial.resection import resect
from jaxphoto.least_squares import least_squares
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints
from jaxphoto.unknowns import FREE, Unknowns, default_priors

# Maximum ratio of the deviation from a plane to the extent of a flat board; beyond, views are not homographies.
_FLAT = 1e-2


class Board(NamedTuple):
    """Targets with known coordinates in the frame of the board; the Z axis of a flat board points to the observer."""

    name: str
    points: tuple[str, ...]
    """Ids of the targets."""
    xyz_m: Float[np.ndarray, "points 3"]
    diameter_m: Float[np.ndarray, "points"]
    """Diameter of circles; 0 for corners of squares."""

    @property
    def plane(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]] | None:
        """Return the centre of a flat board and its axes (columns; right-handed, the third is the normal), or None.

        The normal is arbitrary for a vertical board, otherwise it has Z > 0.
        """
        middle = self.xyz_m.mean(axis=0)
        _, size, axes = np.linalg.svd(self.xyz_m - middle, full_matrices=False)
        if size[2] > _FLAT * size[0]:
            return None
        axes = axes.T * np.where(np.diag(axes.T) < 0, -1.0, 1.0)
        axes[:, 1] = np.cross(axes[:, 2], axes[:, 0])
        return middle, axes


class Detection(NamedTuple):
    """Targets of a board detected in one photograph."""

    image: str
    point: Int[np.ndarray, "n"]
    """Index of the points of the board."""
    column_row: Float[np.ndarray, "n 2"]
    """Pixel coordinates; the centre of the upper-left pixel is (0.5, 0.5)."""
    sigma_px: Float[np.ndarray, "n 2"]
    """Standard deviations of column and row."""

    def take(self, chosen: np.ndarray) -> "Detection":
        """Select targets by index or mask."""
        return Detection(self.image, self.point[chosen], self.column_row[chosen], self.sigma_px[chosen])


CAMERA = "camera"


class TargetRows(NamedTuple):
    """Image points of targets, one per row, sorted by target and image as in a block."""

    images: tuple[str, ...]
    image: Int[np.ndarray, "rows"]
    """Index of `images`."""
    point: Int[np.ndarray, "rows"]
    """Index of the points of the board."""
    xy_mm: Float[np.ndarray, "rows 2"]
    sigma_mm: Float[np.ndarray, "rows 2"]

    @staticmethod
    def of(detections: Sequence[Detection], sensor: Sensor) -> "TargetRows":
        """Convert all `detections` to image points in millimetres."""
        image = np.repeat(np.arange(len(detections)), [len(d.point) for d in detections])
        point = np.concatenate([d.point for d in detections])
        order = np.lexsort((image, point))
        xy_mm = sensor.mm_from_px(np.concatenate([d.column_row for d in detections]))
        sigma_mm = np.concatenate([d.sigma_px for d in detections]) * sensor.pixel_mm
        return TargetRows(tuple(d.image for d in detections), image[order], point[order], xy_mm[order], sigma_mm[order])

    def take(self, chosen: np.ndarray) -> "TargetRows":
        """Select rows by a mask, and the images that still have rows."""
        kept, image = np.unique(self.image[chosen], return_inverse=True)
        images = tuple(self.images[k] for k in kept)
        return TargetRows(images, image, self.point[chosen], self.xy_mm[chosen], self.sigma_mm[chosen])


def calibration_block(
    board: Board,
    rows: TargetRows,
    sensor: Sensor,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    free: Sequence[str],
    board_sigma_m: float | None = None,
) -> Block:
    """Build the block of a calibration from the image points `rows` and initial values.

    The points of the board are fixed, or control with the standard deviation `board_sigma_m` on each axis; points
    without rows are omitted. `free` names the free parameters of the interior orientation (c_mm, k1, ...).
    """
    seen, point = np.unique(rows.point, return_inverse=True)
    xyz = board.xyz_m[seen]
    who, axis = np.repeat(np.arange(len(seen)), 3), np.tile(np.arange(3), len(seen))
    coordinates = ControlCoordinates(who, axis, xyz.ravel(), np.full(len(who), board_sigma_m or 0.0))
    interior = jax.tree.map(lambda v: np.asarray(v, float), interior)
    unknowns = Unknowns({CAMERA: interior}, exterior, xyz, {}, {})
    priors = default_priors(unknowns)
    for name in free:
        priors.interior[CAMERA] = set_parameter(priors.interior[CAMERA], name, FREE)
    n, none = len(rows.images), ("",) * len(rows.images)
    return Block(
        title=f"calibration with {board.name}",
        images=rows.images,
        points=tuple(board.points[k] for k in seen),
        sensors={CAMERA: sensor},
        image_camera=(CAMERA,) * n,
        image_mount=none,
        image_strip=none,
        image_time=np.zeros(n),
        image_points=ImagePoints(rows.image, point, rows.xy_mm, rows.sigma_mm),
        control=ControlCoordinates.none() if board_sigma_m is None else coordinates,
        fixed=coordinates if board_sigma_m is None else ControlCoordinates.none(),
        check=ControlCoordinates.none(),
        stations=CameraPositions.none(),
        attitudes=Attitudes.none(),
        distances=Distances.none(),
        datum=Datum(),
        start=Start(unknowns, np.ones(n, bool), np.ones(len(seen), bool)),
        priors=priors,
    )


def reprojection_residuals(adjusted: Adjustment) -> Float[np.ndarray, "rows 2"]:
    """Return measured minus projected (column, row) in pixels, in the order of the image points of the block.

    Residuals are in the measured image, even for distortions of measured coordinates. Residuals of the ideal image
    would be stretched where the lens compresses.
    """
    block, unknowns = adjusted.block, adjusted.unknowns
    rows = block.image_points
    projected = projections(
        unknowns.interior[CAMERA],
        np.asarray(unknowns.exterior.position)[rows.image],
        np.asarray(unknowns.exterior.camera_from_object)[rows.image],
        np.asarray(unknowns.points)[rows.point],
    )
    pixel = block.sensors[CAMERA].pixel_mm
    return (np.asarray(rows.xy) - projected) / (pixel, -pixel)


def projections(
    interior: InteriorOrientation,
    position: Float[np.ndarray, "rows 3"],
    camera_from_object: Float[np.ndarray, "rows 3 3"],
    point: Float[np.ndarray, "rows 3"],
) -> Float[np.ndarray, "rows 2"]:
    """Project one point (m) per row into one image per row, with distortion; return image coordinates (mm)."""
    n = len(point)
    some = np.arange(padded_length(n)) % n
    numbers = jax.tree.map(lambda v: np.asarray(v, float), interior)
    return np.asarray(call_compiled(_projected, numbers, position[some], camera_from_object[some], point[some]))[:n]


def rms_px(residuals: Float[np.ndarray, "rows 2"]) -> float:
    """Return the RMS of all image points, both axes together: sqrt(sum(dx^2 + dy^2) / n), as in OpenCV."""
    return float(np.sqrt(np.mean(np.sum(np.asarray(residuals) ** 2, axis=1)))) if len(residuals) else 0.0


@eqx.filter_jit
def _projected(interior, position, camera_from_object, point):
    one = lambda x, m, p: project(interior, ExteriorOrientation(x, m), p)  # noqa: E731
    return jax.vmap(one)(position, camera_from_object, point)


def resected(
    board: Board, rows: TargetRows, interior: InteriorOrientation
) -> tuple[ExteriorOrientation, dict[str, str]]:
    """Resect the images; return exterior orientations in the order of the images, and reasons for failures by name."""
    positions, matrices, why = [], [], {}
    for k, name in enumerate(rows.images):
        of_image = rows.image == k
        try:
            sigma_mm = float(np.median(rows.sigma_mm[of_image]))
            exterior = _exterior(interior, rows.xy_mm[of_image], board.xyz_m[rows.point[of_image]], sigma_mm, name)
        except BlockError as error:
            why[name] = f"no resection: {error}"
            continue
        positions.append(np.asarray(exterior.position))
        matrices.append(np.asarray(exterior.camera_from_object))
    none = not positions
    return ExteriorOrientation(
        np.zeros((0, 3)) if none else np.stack(positions),  # type: ignore[arg-type]
        np.zeros((0, 3, 3)) if none else np.stack(matrices),  # type: ignore[arg-type]
    ), why


def _exterior(interior: InteriorOrientation, xy_mm, points, sigma_mm: float, image: str) -> ExteriorOrientation:
    """Resect an image by quaternions (paper 002); if undetermined or inconsistent, from three points with robust
    weights.
    """
    try:
        resection = resect_by_quaternions(interior, xy_mm, points, sigma_mm, image)
    except BlockError:
        return resect(interior, xy_mm, points, image)
    return ExteriorOrientation(jnp.asarray(resection.position), jnp.asarray(resection.camera_from_object))


_CENTRAL = ("c_mm", "xp_mm", "yp_mm")
_USUAL_C = 1.2


def distortion_model(name: str, sensor: Sensor, r0_mm: float = 0.0) -> AbstractDistortion:
    """Return the distortion model `name` of block.toml with zero distortion and constants that suit the sensor
    (`plain`).

    Raises InputError for an unknown name, for R0 of another model than SMAC, and for R0 beyond the format.
    """
    kind, longer = AbstractDistortion.called(name), max(sensor.width_mm, sensor.height_mm)
    if kind is Smac:
        if not 0 <= r0_mm <= longer:
            raise InputError(f"R0 = {r0_mm:g} mm is outside the format of {longer:.4g} mm; give 0 to {longer:.4g}")
        return Smac(r0=r0_mm)
    if r0_mm:
        raise InputError(f"R0 belongs to the model smac; omit it with {name}, or choose smac")
    return kind.plain(sensor)


def free_parameters(name: str, distortion: AbstractDistortion, wanted: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return the parameters to estimate, in the order of the model.

    `wanted` lists names, such as c, xp, k1. The default is c, the principal point, and the coefficients that a
    board determines (`AbstractDistortion.usual`): for SMAC and Brown K1-K3, P1, P2. Raises InputError for unknown
    names, and for a scale coefficient together with c.
    """
    names = parameter_names(InteriorOrientation(1.0, distortion=distortion))
    if wanted is None:
        usual = distortion.usual()
        return tuple(n for n in names if n in (*_CENTRAL, *usual))
    asked = [table_name(n) for n in wanted]
    for parameter in asked:
        if parameter not in names:
            raise InputError(f"unknown parameter {parameter!r} of the model {name}; choose among {', '.join(names)}")
    if both := [scale for scale in distortion.scales if scale in asked and "c_mm" in asked]:
        raise InputError(f"{both[0]} changes the scale as c does: fix one of them")
    return tuple(n for n in names if n in asked)


# Number of grid points along each side of the format for the comparison of two distortions.
_SIDE = 15
# Ratio of the error of a view to the median above which it is not a plane seen by this camera.
_MISFIT = 5.0
# Minimum sine of the tilt of a view that determines c; maximum relative standard deviation of c.
_TILT, _LOOSE = 0.05, 0.1
# Minimum ratio of singular values for which points determine a homography.
_DETERMINED = 1e-3


def rough_interior(
    board: Board, rows: TargetRows, sensor: Sensor, known: InteriorOrientation | None = None
) -> InteriorOrientation:
    """Estimate the initial camera from a flat board, else `known`, else c is 1.2 times the longer side.

    Views without tilt do not determine c, which is then taken from `known`.
    """
    plane, guess = board.plane, InteriorOrientation(_USUAL_C * max(sensor.width_mm, sensor.height_mm))
    if plane is None:
        return guess if known is None else known
    flat = (board.xyz_m - plane[0]) @ plane[1][:, :2]
    of_image = [rows.image == k for k in range(len(rows.images))]
    views = [(flat[rows.point[k]], rows.xy_mm[k]) for k in of_image]
    return flat_start(views, sensor, float((known or guess).c))[0]


def flat_start(
    views: Sequence[tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]], sensor: Sensor, c_mm: float
) -> tuple[InteriorOrientation, bool]:
    """Estimate c, k1 and k2 by OpenCV from views of flat boards: board coordinates (m) and image coordinates (mm).

    Views with collinear points, except for one, are skipped. The second value is False if no view has enough tilt to
    determine c, which is then `c_mm`.
    """
    import cv2

    c_px, size = c_mm / sensor.pixel_mm, (sensor.width_px, sensor.height_px)
    flags = (
        cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
        | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    )  # fmt: skip

    def solved(views, flags):
        matrix = np.array([[c_px, 0, (size[0] - 1) / 2], [0, c_px, (size[1] - 1) / 2], [0, 0, 1]])
        board = [np.column_stack([xy, np.zeros(len(xy))]).astype(np.float32) for xy, _ in views]
        image = [(sensor.px_from_mm(xy) - 0.5).astype(np.float32) for _, xy in views]
        result = cv2.calibrateCameraExtended(board, image, size, matrix, np.zeros(5), flags=flags)
        _, matrix, lens, turns, _, sigma, _, error = result
        tilt = max(float(np.linalg.norm(cv2.Rodrigues(turn)[0][:2, 2])) for turn in turns)
        loose = not (tilt > _TILT and float(sigma[0, 0]) < _LOOSE * matrix[0, 0])
        k1, k2 = lens.ravel()[:2].tolist()
        return InteriorOrientation(float(matrix[0, 0]) * sensor.pixel_mm, distortion=OpenCv(k1=k1, k2=k2)), loose, error

    if not (views := [view for view in views if _determines(view[0])]):
        return InteriorOrientation(c_mm), False
    interior, loose, error = solved(views, flags)
    if (good := error.ravel() <= _MISFIT * np.median(error)).any() and not good.all():
        views = [view for view, k in zip(views, good, strict=True) if k]
        interior, loose, _ = solved(views, flags)
    return (solved(views, flags | cv2.CALIB_FIX_FOCAL_LENGTH)[0], False) if loose else (interior, True)


def _determines(board: Float[np.ndarray, "n 2"]) -> bool:
    """Return True if points of a plane determine a homography: only the identity maps them onto themselves."""
    xy = (board - board.mean(axis=0)) / max(float(np.std(board)), 1e-300)
    point = np.column_stack([xy, np.ones(len(xy))])
    rows = [np.hstack([point, 0 * point, -xy[:, :1] * point]), np.hstack([0 * point, point, -xy[:, 1:] * point])]
    size = np.linalg.svd(np.vstack(rows), compute_uv=False)
    return bool(len(size) > 7 and size[7] > _DETERMINED * size[0])


def nearest_distortion(
    known: InteriorOrientation, model: AbstractDistortion, free: Sequence[str], sensor: Sensor
) -> InteriorOrientation:
    """Fit the coefficients `free` of the distortion `model` to the distortion of `known`; return the resulting camera.

    Least squares of the image residuals at 15 x 15 points of the format.
    """
    x, y = (np.linspace(-0.48, 0.48, _SIDE) * side for side in (sensor.width_mm, sensor.height_mm))
    measured = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    ideal = ideal_coordinates(known, measured)
    source, wanted = (measured - np.asarray(known.principal_point), ideal)
    if model.domain == "ideal":
        source, wanted = wanted, source
    interior = jax.tree.map(lambda v: np.asarray(v, float), InteriorOrientation(known.c, known.xp, known.yp, model))
    names = tuple(name for name in free if name in model.coefficients)
    if names:
        begin = np.array([float(get_parameter(interior, name)) for name in names])
        values = np.asarray(call_compiled(_nearest, begin, interior, source, wanted, names))
        interior = _with(interior, names, values)
    return interior


@eqx.filter_jit
def _nearest(start: Float[Array, "u"], interior: InteriorOrientation, source, wanted, names: tuple[str, ...]):
    def residuals(values, _):
        return (jax.vmap(_with(interior, names, values).closed_form)(source) - wanted).ravel()

    return least_squares(residuals, start).unknowns


def _with(interior: InteriorOrientation, names: tuple[str, ...], values) -> InteriorOrientation:
    for name, value in zip(names, values, strict=True):
        interior = set_parameter(interior, name, value)
    return interior
