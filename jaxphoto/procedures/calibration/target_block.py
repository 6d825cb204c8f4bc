"""Calibration boards, image points of their targets, and the block of a calibration.

Residuals are in the measured image, in pixels; their RMS is defined as in OpenCV.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import InteriorOrientation, Sensor, set_parameter
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError
from jaxphoto.initial.quaternion_resection import resect_by_quaternions
from jaxphoto.initial.rays import padded_length
from jaxphoto.initial.resection import resect
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
