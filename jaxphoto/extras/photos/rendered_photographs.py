"""Photographs rendered for the examples `board` and `photographs`: their camera and orientations are known."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image

from jaxphoto.camera import Brown, InteriorOrientation, Sensor, Smac
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.extras.photos.targets import read_board, rendered
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.initial.rays import camera_rays
from jaxphoto.procedures.calibration import Board
from jaxphoto.procedures.calibration.start import projections
from jaxphoto.procedures.georeference_photographs import utm_of
from jaxphoto.rotation import matrix_from_omega_phi_kappa

BOARD = "chessboard:8x6:square_mm=30"
SENSOR = Sensor(640, 480, 0.006)
BOARD_CAMERA = InteriorOrientation(3.6, 0.03, -0.02, Smac(k1=-0.002))
FLIGHT_CAMERA = InteriorOrientation(3.6, 0.02, -0.01, Brown(k1=5e-3))
GROUND_M = 0.05
"""Pixel of the ground texture (m)."""
_PLACE = (13.2, 55.7, 100.0)
_VIEWS, _PHOTOGRAPHS = 10, 12
# Standard deviations of recorded positions (m) and of grey values.
_POSITION_M, _NOISE_GREY = 0.03, 2.0
_RTK = '<rdf:Description drone-dji:RtkFlag="50"' + "".join(
    f' drone-dji:RtkStd{axis}="{_POSITION_M}"' for axis in ("Lon", "Lat", "Hgt")
)
_SURVEYED = np.array([[-20.0, -15], [20, -15], [20, 15], [-20, 15], [0, 0], [9, -8]])


def write_board(folder: Path) -> None:
    """Write ten views of a chessboard (`BOARD`) by `BOARD_CAMERA`."""
    pattern = read_board(BOARD)
    for k in range(_VIEWS):
        above = board_view(pattern.board, k, 1.5)
        picture = rendered(pattern, SENSOR, BOARD_CAMERA, above, noise=3.0, rays=13, seed=k)
        _save(folder / f"board_{k + 1:02}.jpg", picture)


def board_view(board: Board, k: int, factor: float = 1.0) -> ExteriorOrientation:
    """Return the orientation of view `k` from `factor` times 0.28 m: tilted by 0.5 rad, rotated about the axis."""
    away = factor * np.array([0.13 * np.cos(1.7 * k + 0.3), 0.13 * np.sin(1.7 * k + 0.3), 0.25])
    z = away / np.linalg.norm(away)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    c, s = np.cos(0.35 * k + 0.2), np.sin(0.35 * k + 0.2)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return ExteriorOrientation(board.xyz_m.mean(axis=0) + away, turn @ np.stack([x, np.cross(z, x), z]))  # type: ignore[arg-type]


def write_flight(folder: Path) -> None:
    """Write a block of twelve photographs of hills by `FLIGHT_CAMERA`, and `gcp_list.txt` with surveyed points.

    EXIF has focal length and pixel size, EXIF and XMP the position with its standard deviation.
    """
    rng, code = np.random.default_rng(1), utm_of(*_PLACE[:2])
    frame, texture = MapFrame(code, None, _PLACE), ground_texture(rng, 2400)
    surveyed = np.column_stack([_SURVEYED, ground_height(*_SURVEYED.T)])
    lines = [f"EPSG:{code}"]
    for k in range(_PHOTOGRAPHS):
        position = np.array([14.0 * (k % 4) - 21, 14.0 * (k // 4) - 14, 60.0 + 8 * (k % 3)])
        angles = np.deg2rad([*rng.uniform(-14, 14, 2), 90.0 * (k % 4)])
        rotation = np.asarray(matrix_from_omega_phi_kappa(angles))  # type: ignore[arg-type]
        picture = rendered_ground(texture, FLIGHT_CAMERA, position, rotation, rng)
        recorded = position + rng.normal(0, _POSITION_M, 3)
        path = folder / f"flight_{k + 1:02}.jpg"
        _save(path, picture, frame.place(frame.map(recorded[None]))[0])
        n = len(surveyed)
        xy = projections(FLIGHT_CAMERA, np.tile(position, (n, 1)), np.tile(rotation, (n, 1, 1)), surveyed)
        marks = SENSOR.px_from_mm(xy) - 0.5 + rng.normal(0, 0.1, (n, 2))
        for point, mark in zip(frame.map(surveyed), marks, strict=True):
            if (mark > 3).all() and (mark < (SENSOR.width_px - 4, SENSOR.height_px - 4)).all():
                lines.append(" ".join(f"{v:.3f}" for v in (*point, *mark)) + f" {path.name}")
    (folder / "gcp_list.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def ground_texture(rng: np.random.Generator, size: int) -> Float[np.ndarray, "size size"]:
    """Return blotches of many sizes, grey values 0 to 255."""
    total = np.zeros((size, size))
    for width in (3, 4, 8, 16, 32):
        total += width * cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), width)
    return (total - total.min()) / np.ptp(total) * 255


def ground_height(x_m, y_m):
    """Return the height (m) of hills of some metres, gentle enough that every ray meets the ground once."""
    return 4 * np.sin(x_m / 9) * np.cos(y_m / 11) + 3 * np.cos(x_m / 17 + 1) + 2.5 * np.sin((x_m + 2 * y_m) / 14)


def rendered_ground(
    texture: Float[np.ndarray, "size size"],
    camera: InteriorOrientation,
    position: Float[np.ndarray, "3"],
    camera_from_object: Float[np.ndarray, "3 3"],
    rng: np.random.Generator,
) -> np.ndarray:
    """Render a photograph of the hills: intersect the ray of each pixel of `SENSOR` with the ground."""
    column, row = np.meshgrid(np.arange(SENSOR.width_px) + 0.5, np.arange(SENSOR.height_px) + 0.5)
    ray = camera_rays(camera, SENSOR.mm_from_px(np.column_stack([column.ravel(), row.ravel()]))) @ camera_from_object
    x, y = np.zeros((2, len(ray)))
    for _ in range(25):
        along = (ground_height(x, y) - position[2]) / ray[:, 2]
        x, y = position[0] + along * ray[:, 0], position[1] + along * ray[:, 1]
    middle = len(texture) / 2 - 0.5
    right, down = ((middle + v / GROUND_M).reshape(column.shape).astype(np.float32) for v in (x, -y))
    grey = cv2.remap(texture.astype(np.float32), right, down, cv2.INTER_CUBIC)
    return np.clip(np.round(grey + _NOISE_GREY * rng.normal(size=grey.shape)), 0, 255).astype(np.uint8)


def _save(path: Path, picture: np.ndarray, place: np.ndarray | None = None) -> None:
    """Write a JPEG with focal length and pixel size in EXIF, and its `place` (degrees, m) in EXIF and XMP."""
    exif = Image.Exif()
    exif.update({0x010F: "Maker", 0x0110: "Camera"})
    # FocalLength in mm; FocalPlaneXResolution and YResolution in pixels per cm.
    exif.get_ifd(0x8769).update({0x920A: 3.6, 0xA20E: 10 / SENSOR.pixel_mm, 0xA20F: 10 / SENSOR.pixel_mm, 0xA210: 3})
    xmp = b""
    if place is not None:
        longitude, latitude, height = map(float, place)
        parts = [(int(v), int(v % 1 * 60), v * 60 % 1 * 60) for v in (latitude, longitude)]
        exif.get_ifd(0x8825).update({1: "N", 2: parts[0], 3: "E", 4: parts[1], 5: b"\0", 6: height})
        xmp = _RTK.encode()
    Image.fromarray(picture).save(path, quality=97, exif=exif, xmp=xmp)
