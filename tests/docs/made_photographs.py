"""Photographs for the shell blocks of the pages, made in seconds: `python -m tests.docs.made_photographs KIND FOLDER`.

`board`: a chessboard. `blank`: a grey picture of the example block's format. `flight`: flat ground from the air,
with positions and all that EXIF says of a camera; beside the folder FOLDER.txt, a gcp_list.txt of points on the ground
with their marks, and FOLDER.toml, the camera. Photographs of all folders are of one format and size of pixel.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from jaxphoto.camera import InteriorOrientation, Smac
from jaxphoto.extras.photos.targets import read_board, rendered
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.procedures.georeference_photographs import utm_of
from tests.photos.ground import C_MM, SENSOR, mapped, photograph, texture
from tests.photos.test_targets import view

BOARD = "chessboard:8x6:square_mm=30"
LENS = InteriorOrientation(C_MM, 0.03, -0.02, Smac(k1=-0.002))
PLACE = (13.2, 55.7, 0.0)
PHOTOGRAPHS = 12


def _saved(path: Path, picture: np.ndarray, place: np.ndarray | None = None) -> None:
    """As JPEG, with focal length and size of a pixel in its EXIF, and where it was taken."""
    exif = Image.Exif()
    exif.update({0x010F: "Maker", 0x0110: "Camera"})
    # FocalLength in mm; FocalPlaneXResolution and YResolution in pixels per cm.
    exif.get_ifd(0x8769).update({0x920A: C_MM, 0xA20E: 10 / SENSOR.pixel_mm, 0xA20F: 10 / SENSOR.pixel_mm, 0xA210: 3})
    if place is not None:
        longitude, latitude, height = map(float, place)
        parts = [(int(v), int(v % 1 * 60), v * 60 % 1 * 60) for v in (latitude, longitude)]
        exif.get_ifd(0x8825).update({1: "N", 2: parts[0], 3: "E", 4: parts[1], 5: b"\0", 6: height})
    Image.fromarray(picture).save(path, quality=97, exif=exif)


def board(folder: Path, rng: np.random.Generator) -> None:
    """Five views of the board, other ones for another folder."""
    pattern = read_board(BOARD)
    for k in rng.permutation(9)[:5]:
        above = view(pattern.board, int(k))
        away = above.position - pattern.board.xyz_m.mean(axis=0)
        farther = type(above)(above.position + 0.5 * away, above.camera_from_object)
        _saved(folder / f"p{k}.jpg", rendered(pattern, SENSOR, LENS, farther, noise=3.0, rays=13, seed=int(k)))


def flight(folder: Path, rng: np.random.Generator) -> None:
    """Photographs of one place from three heights, turned, with positions good to 3 cm."""
    frame = MapFrame(utm_of(*PLACE[:2]), None, PLACE)
    ground = texture(rng, 2400).astype(np.float32)
    corners = np.array([[-18.0, -14], [18, -14], [18, 14], [-18, 14], [0, 0]])
    surveyed = frame.map(np.column_stack([corners, np.zeros(len(corners))]))
    lines = [f"EPSG:{utm_of(*PLACE[:2])}"]
    for k in range(PHOTOGRAPHS):
        at = np.array([14.0 * (k % 4) - 21, 14.0 * (k // 4) - 14, 60.0 + 8 * (k % 3)])
        path = folder / f"a{k:02}.png"
        matrix = photograph(path, ground, at, (*rng.uniform(-14, 14, 2), 90.0 * (k % 4)), rng)
        recorded = at + rng.normal(0, 0.03, 3)
        _saved(path.with_suffix(".jpg"), cv2.imread(str(path)), frame.place(frame.map(recorded[None]))[0])
        path.unlink()
        for (x, y, z), (column, row) in zip(surveyed, mapped(matrix, corners), strict=True):
            if 0 < column < SENSOR.width_px - 1 and 0 < row < SENSOR.height_px - 1:
                lines.append(f"{x:.4f} {y:.4f} {z:.4f} {column:.3f} {row:.3f} {path.stem}.jpg")
    folder.with_suffix(".txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    sensor = f"width_px = {SENSOR.width_px}\nheight_px = {SENSOR.height_px}\npixel_mm = {SENSOR.pixel_mm}"
    camera = f'[cameras.drone]\n{sensor}\ndistortion = "brown"\ninterior = {{ c_mm = {C_MM} }}\n'
    folder.with_suffix(".toml").write_text(camera, encoding="utf-8")


if __name__ == "__main__":
    kind, name = sys.argv[1:]
    if kind == "blank":
        Image.new("L", (4500, 3000), 120).save(name, "jpeg")
    else:
        Path(name).mkdir()
        {"board": board, "flight": flight}[kind](Path(name), np.random.default_rng(len(name)))
