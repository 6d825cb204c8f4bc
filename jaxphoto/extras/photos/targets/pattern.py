"""Calibration boards: known target coordinates, detection in photographs, and rendered photographs."""

import abc
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.extras.photos.features import read_grey
from jaxphoto.extras.photos.targets.patches import TargetPlaces
from jaxphoto.initial.rays import camera_rays
from jaxphoto.io.photographs import Photograph
from jaxphoto.procedures.calibration import Board, Detection


class FoundBoard(NamedTuple):
    """Detected targets of a board in an image."""

    point: Int[np.ndarray, "n"]
    """Indices of the board's points."""
    places: TargetPlaces


class Pattern(abc.ABC):
    """Kind of calibration board; `board` contains the target coordinates."""

    board: Board

    @abc.abstractmethod
    def find(self, picture: np.ndarray) -> FoundBoard | None:
        """Detect the targets in grey values (rows, columns) of 0 to 255; None if the board is not found."""

    @abc.abstractmethod
    def reflectance(self, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the reflectance at points of the board (m, in the frame of `board`): 0 black, 1 white."""

    def hint(self, pictures: Sequence[np.ndarray]) -> str | None:
        """Describe any similar board in images without this board; None if there is none."""
        return None


# Maximum number of photographs searched for another board.
_LOOKED_AT = 5


class Targets(NamedTuple):
    """Detections of a board in photographs."""

    detections: list[Detection]
    left_out: dict[str, str]
    """Reason by image name of each photograph without detection."""


def find_targets(
    photographs: Sequence[Photograph], pattern: Pattern, progress: Callable[[str], None] = lambda image: None
) -> Targets:
    """Detect the board in all photographs; `progress` is called with each image name.

    Raises InputError for a file that OpenCV cannot read, and if the board is not found in any photograph.
    """
    detections: list[Detection] = []
    left_out: dict[str, str] = {}
    for photograph in photographs:
        progress(photograph.name)
        picture = read_grey(photograph.path)
        seen = pattern.find(picture)
        if seen is None:
            left_out[photograph.name] = "board not found"
            continue
        good, places = seen.places.found, seen.places
        # OpenCV's origin is the centre of the upper left pixel, (0.5, 0.5) in our convention.
        column_row = places.column_row[good] + 0.5
        detections.append(Detection(photograph.name, seen.point[good], column_row, places.sigma_px[good]))
    if not detections:
        hint = pattern.hint([read_grey(photograph.path) for photograph in photographs[:_LOOKED_AT]])
        raise InputError(
            f"the board ({pattern.board.name}) was not found in any of {len(photographs)} photographs; "
            + (hint or "check its description, lighting and focus, and show the whole board")
        )
    return Targets(detections, left_out)


_BACKGROUND = 0.55
_GOLDEN = (5**0.5 - 1) / 2


def rendered(
    pattern: Pattern,
    sensor: Sensor,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    *,
    noise: float = 0.0,
    blur_px: float = 0.6,
    rays: int = 34,
    margin_m: float = 0.03,
    seed: int = 0,
) -> np.ndarray:
    """Render a photograph of the board in the plane Z = 0: grey values (rows, columns) of 0 to 255.

    Each pixel is the mean of `rays` rays, traced through the lens to the plane. The image is blurred by a Gaussian of
    `blur_px`; `noise` is the standard deviation of the grey values. The board extends `margin_m` beyond its outermost
    targets on a grey background.
    """
    column, row = np.meshgrid(np.arange(sensor.width_px), np.arange(sensor.height_px))
    corner = np.stack([column.ravel(), row.ravel()], axis=1)
    interior = jax.tree.map(lambda v: np.asarray(v, float), interior)
    position, turn = np.asarray(exterior.position), np.asarray(exterior.camera_from_object)
    low, high = (f(pattern.board.xyz_m[:, :2], axis=0) for f in (np.min, np.max))
    total = np.zeros(len(corner))
    step = next(n for n in range(round(_GOLDEN * rays), 2 * rays) if math.gcd(n, rays) == 1)
    for k in range(rays):
        # Lattice in which no two rays of a pixel have the same column or row, to sample edges along them finely.
        inside = (np.array([k, k * step % rays]) + 0.5) / rays
        ray = camera_rays(interior, sensor.mm_from_px(corner + inside)) @ turn
        along = -position[2] / np.where(ray[:, 2] == 0, 1e-300, ray[:, 2])
        place = position[:2] + along[:, None] * ray[:, :2]
        on = (along > 0) & np.all((place > low - margin_m) & (place < high + margin_m), axis=1)
        total += _BACKGROUND * ~on
        total[on] += pattern.reflectance(place[on])
    # Use grey values from 30 to 225 to avoid clipping of noise.
    grey = 30 + 195 * total.reshape(sensor.height_px, sensor.width_px) / rays
    grey = cv2.GaussianBlur(grey, (0, 0), blur_px) + noise * np.random.default_rng(seed).standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
