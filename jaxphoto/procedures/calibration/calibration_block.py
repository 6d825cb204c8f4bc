"""The block of a calibration: the photographs of a board, its points known, the interior orientation free."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import InteriorOrientation, Sensor, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints
from jaxphoto.procedures.calibration.board import Board, Detection
from jaxphoto.unknowns import FREE, Unknowns, default_priors

CAMERA = "camera"


class TargetRows(NamedTuple):
    """Image points of targets, one a row, sorted by target and image as in a block."""

    images: tuple[str, ...]
    image: Int[np.ndarray, "rows"]
    """Index into `images`."""
    point: Int[np.ndarray, "rows"]
    """Index into the board's points."""
    xy_mm: Float[np.ndarray, "rows 2"]
    sigma_mm: Float[np.ndarray, "rows 2"]

    @staticmethod
    def of(detections: Sequence[Detection], sensor: Sensor) -> "TargetRows":
        """The image points of all `detections`, in millimetres."""
        image = np.repeat(np.arange(len(detections)), [len(d.point) for d in detections])
        point = np.concatenate([d.point for d in detections])
        order = np.lexsort((image, point))
        xy_mm = sensor.mm_from_px(np.concatenate([d.column_row for d in detections]))
        sigma_mm = np.concatenate([d.sigma_px for d in detections]) * sensor.pixel_mm
        return TargetRows(tuple(d.image for d in detections), image[order], point[order], xy_mm[order], sigma_mm[order])

    def take(self, chosen: np.ndarray) -> "TargetRows":
        """The rows that a mask names, and the images that keep one."""
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
    """The block in which every image point of `rows` is observed, with what starts where.

    The points of the board are fixed, or control with the standard deviation `board_sigma_m` on each axis. Those seen
    in no photograph are left out. `free` names the parameters of the interior orientation that are (c_mm, k1, ...).
    """
    seen, point = np.unique(rows.point, return_inverse=True)
    xyz = board.xyz_m[seen]
    who, axis = np.repeat(np.arange(len(seen)), 3), np.tile(np.arange(3), len(seen))
    known = ControlCoordinates(who, axis, xyz.ravel(), np.full(len(who), board_sigma_m or 0.0))
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
        control=ControlCoordinates.none() if board_sigma_m is None else known,
        fixed=known if board_sigma_m is None else ControlCoordinates.none(),
        check=ControlCoordinates.none(),
        stations=CameraPositions.none(),
        attitudes=Attitudes.none(),
        distances=Distances.none(),
        datum=Datum(),
        start=Start(unknowns, np.ones(n, bool), np.ones(len(seen), bool)),
        priors=priors,
    )
