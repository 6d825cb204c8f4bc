"""A flight rendered as photographs whose truth is known.

python benchmarks/rendered_flight.py FOLDER [--photographs 500] [--width-px 2000] [--judge DIR]

A drone (c 8.8 mm, 13.2 mm wide) flies strips to and fro 100 m over hills of some ten metres that are covered by
blotches of every size down to five centimetres. FOLDER/photographs gets JPEG files with focal length, time and a
position that is off by 2 m (4 m in height); FOLDER/truth.csv the true exterior orientation, in metres east, north and
up of the middle of the flight, and FOLDER/truth.json the true camera.

With `--judge DIR` it renders nothing, but holds what `jaxphoto fly FOLDER/photographs --out DIR` found against the
truth.
"""

import argparse
import functools
import json
import math
import multiprocessing
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pandas as pd
from PIL import Image
from pyproj import CRS, Transformer

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

C_MM, WIDTH_MM, K1 = 8.8, 13.2, -4e-4
XP_MM, YP_MM = 0.04, -0.03
HEIGHT_M, SPEED_M_PER_S = 100.0, 10.0
# Of the format that two photographs of a strip, and two strips, do not share.
_ALONG, _ACROSS = 0.25, 0.35
_STRIP = 25
_TILT_DEG = 2.0
_POSITION_M = (2.0, 2.0, 4.0)
_NOISE_GREY = 2.0
# Of the texture, in m: finer than a pixel on the ground up to 3,000 pixels across.
_GROUND_M = 0.05
_PLACE = (15.0, 47.0)


class Flight(NamedTuple):
    """Names, true positions (m) and angles (omega, phi, kappa in degrees), and the size of the pictures."""

    names: list[str]
    position: np.ndarray
    angles: np.ndarray
    width: int
    height: int

    @property
    def pixel_mm(self) -> float:
        return WIDTH_MM / self.width


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photographs", type=int, default=500)
    parser.add_argument("--width-px", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--judge", type=Path, help="results of `jaxphoto fly` to hold against the truth")
    arguments = parser.parse_args()
    if arguments.judge:
        return judge(arguments.folder, arguments.judge)
    flight = drawn(arguments.photographs, arguments.width_px, arguments.seed)
    photographs = arguments.folder / "photographs"
    if photographs.exists():
        raise SystemExit(f"{photographs} is there already; name another folder")
    photographs.mkdir(parents=True)
    write_truth(flight, arguments.folder)
    texture(flight, arguments.folder, arguments.seed)
    # Not forked: OpenCV's threads would be held for ever in the child.
    with multiprocessing.get_context("spawn").Pool() as pool:
        draw = functools.partial(write_photograph, flight, arguments.folder, arguments.seed)
        for done, _ in enumerate(pool.imap_unordered(draw, range(len(flight.names))), 1):
            if done % 25 == 0:
                print(f"{done} of {len(flight.names)}", flush=True)
    (arguments.folder / "texture.npy").unlink()
    return 0


def drawn(count: int, width: int, seed: int) -> Flight:
    """Where the photographs are taken: strips to and fro, `_STRIP` photographs each."""
    rng, k = np.random.default_rng(seed), np.arange(count)
    strip, place = np.divmod(k, _STRIP)
    long, across = WIDTH_MM / C_MM * HEIGHT_M, WIDTH_MM * 0.75 / C_MM * HEIGHT_M
    back = strip % 2 == 1
    east = np.where(back, _STRIP - 1 - place, place) * _ALONG * across
    position = np.column_stack([east, strip * _ACROSS * long, np.full(count, HEIGHT_M)])
    position += rng.normal(0, (1.0, 1.0, 1.0), position.shape) - [*position[:, :2].mean(axis=0), 0]
    # The top of the pictures looks forward, to the east or the west.
    angles = rng.normal(0, _TILT_DEG, (count, 3)) + np.outer(np.where(back, 90.0, -90.0), (0, 0, 1))
    return Flight([f"DJI_{n + 1:04}" for n in k], position, angles, width, width * 3 // 4)


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the hills, some ten metres, gentle enough that every ray meets them once."""
    return 6 * np.sin(x / 61) * np.cos(y / 83) + 4 * np.cos(x / 37 + 1) + 2 * np.sin((x + 2 * y) / 29)


def texture(flight: Flight, folder: Path, seed: int) -> None:
    """Grey values of the ground under the whole flight, into `texture.npy`: noise of every width, and spots."""
    rng, size = np.random.default_rng(seed + 1), _texture_size(flight)
    grey = np.lib.format.open_memmap(folder / "texture.npy", "w+", np.uint8, size)
    coarse = [(w, rng.normal(size=(size[0] // w + 4, size[1] // w + 4)).astype(np.float32)) for w in (8, 32, 128, 512)]
    step = 1024
    for row in range(0, size[0], step):
        rows = min(step, size[0] - row)
        sum_ = 14 * cv2.GaussianBlur(rng.normal(size=(rows, size[1])).astype(np.float32), (0, 0), 0.8)
        sum_ += 30 * cv2.GaussianBlur(rng.normal(size=(rows, size[1])).astype(np.float32), (0, 0), 2)
        column = np.arange(size[1], dtype=np.float32)
        for width, values in coarse:
            there = np.broadcast_to(column / width, (rows, size[1]))
            down = np.broadcast_to((np.arange(row, row + rows, dtype=np.float32) / width)[:, None], there.shape)
            sum_ += 14 * cv2.remap(values, np.ascontiguousarray(there), np.ascontiguousarray(down), cv2.INTER_CUBIC)
        for _ in range(rows * size[1] // 6000):
            at = (int(rng.integers(size[1])), int(rng.integers(rows)))
            cv2.circle(sum_, at, int(rng.integers(2, 14)), float(rng.normal(0, 45)), -1)
        grey[row : row + rows] = np.clip(128 + sum_, 0, 255).astype(np.uint8)
    grey.flush()


def _texture_size(flight: Flight) -> tuple[int, int]:
    spans = 2 * (np.abs(flight.position[:, :2]).max(axis=0) + 1.1 * HEIGHT_M * WIDTH_MM / C_MM)
    return math.ceil(spans[1] / _GROUND_M), math.ceil(spans[0] / _GROUND_M)


def write_photograph(flight: Flight, folder: Path, seed: int, k: int) -> None:
    """What the camera sees: the ray of each pixel, followed to the ground."""
    from tests.formulas import camera_from_object

    cv2.setNumThreads(1)
    grey = np.load(folder / "texture.npy", mmap_mode="r")
    column, row = np.meshgrid(np.arange(flight.width) + 0.5, np.arange(flight.height) + 0.5)
    x = (column - flight.width / 2) * flight.pixel_mm - XP_MM
    y = (flight.height / 2 - row) * flight.pixel_mm - YP_MM
    # Brown's model gives the ideal coordinates of measured ones in closed form.
    bend = 1 - K1 * (x * x + y * y)
    matrix = camera_from_object(*np.deg2rad(flight.angles[k]))
    rays = [x * bend * matrix[0, i] + y * bend * matrix[1, i] - C_MM * matrix[2, i] for i in range(3)]
    at, rays = flight.position[k], [rays[0] / rays[2], rays[1] / rays[2]]
    east, north = np.zeros((2, *x.shape))
    for _ in range(12):
        up = ground(east, north) - at[2]
        east, north = at[0] + rays[0] * up, at[1] + rays[1] * up
    there, down = grey.shape[1] / 2 - 0.5 + east / _GROUND_M, grey.shape[0] / 2 - 0.5 - north / _GROUND_M
    left, top = int(there.min()) - 2, int(down.min()) - 2
    cut = np.ascontiguousarray(grey[top : int(down.max()) + 3, left : int(there.max()) + 3])
    if not (left >= 0 and top >= 0 and cut.shape[0] < 32767 > cut.shape[1]):
        raise SystemExit(f"photograph {k} looks beyond the texture")
    maps = ((there - left).astype(np.float32), (down - top).astype(np.float32))
    rng = np.random.default_rng([seed, k])
    view = cv2.remap(cut.astype(np.float32), *maps, cv2.INTER_LINEAR) + _NOISE_GREY * rng.normal(size=x.shape)
    picture = Image.fromarray(np.clip(np.round(view), 0, 255).astype(np.uint8))
    told = at + rng.normal(0, _POSITION_M)
    picture.save(folder / "photographs" / f"{flight.names[k]}.jpg", quality=92, exif=_exif(told, k))


def _exif(told: np.ndarray, k: int) -> Image.Exif:
    """EXIF of a drone's camera with the position `told`, as photograph `k` of a flight has it."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "DJI", "FC6310"
    seconds = int(k * _ALONG * HEIGHT_M * WIDTH_MM * 0.75 / C_MM / SPEED_M_PER_S)
    clock = f"2026:06:01 {10 + seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}"
    exif.get_ifd(0x8769).update({0x9003: clock, 0x920A: C_MM, 0xA405: 24})
    around = CRS.from_proj4(f"+proj=aeqd +lon_0={_PLACE[0]} +lat_0={_PLACE[1]} +ellps=WGS84 +units=m")
    longitude, latitude = Transformer.from_crs(around, 4326, always_xy=True).transform(*told[:2])
    gps = {1: "N", 2: _dms(latitude), 3: "E", 4: _dms(longitude), 5: b"\0", 6: float(told[2] + 400.0)}
    exif.get_ifd(0x8825).update(gps)
    return exif


def _dms(degrees: float) -> tuple[float, float, float]:
    minutes = degrees % 1 * 60
    return float(int(degrees)), float(int(minutes)), round(minutes % 1 * 60, 6)


def write_truth(flight: Flight, folder: Path) -> None:
    table = pd.DataFrame(flight.position, columns=["X_m", "Y_m", "Z_m"])
    table[["omega_deg", "phi_deg", "kappa_deg"]] = flight.angles
    table.insert(0, "image", flight.names)
    table.to_csv(folder / "truth.csv", index=False)
    camera = {"c_mm": C_MM, "xp_mm": XP_MM, "yp_mm": YP_MM, "k1": K1, "pixel_mm": flight.pixel_mm}
    (folder / "truth.json").write_text(json.dumps(camera, indent=1))


def judge(folder: Path, results: Path) -> int:
    """Interior orientation in standard deviations, and positions after a similarity, against the truth."""
    from jaxphoto.procedures.orientation.blocks import similarity_between

    truth = json.loads((folder / "truth.json").read_text())
    (sensor,) = tomllib.loads((results / "block" / "block.toml").read_text())["cameras"].values()
    # EXIF tells the size of a pixel by that of a film: what counts is in pixels.
    scale = sensor["pixel_mm"] / truth["pixel_mm"]
    truth = {name: value * scale ** (-2 if name == "k1" else 1) for name, value in truth.items()}
    interior = pd.read_csv(results / "result" / "interior.csv").set_index("parameter")
    for name, row in interior.iterrows():
        off = row["value"] - truth.get(str(name), 0.0)
        print(f"{name}: {row['value']:.6g}, off by {off:.3g}, {off / row['sigma'] if row['sigma'] else 0:.2f} sigma")
    found = pd.read_csv(results / "result" / "exterior.csv").set_index("image")
    true = pd.read_csv(folder / "truth.csv").set_index("image").loc[found.index]
    names = ["X_m", "Y_m", "Z_m"]
    a, b = true[names].to_numpy(), found[names].to_numpy()
    s = similarity_between(a, b)
    off = np.linalg.norm(b - (s.shift + s.scale * a @ s.turn.T), axis=1)
    print(
        f"{len(found)} of {len(pd.read_csv(folder / 'truth.csv'))} photographs; positions after a similarity (scale "
        f"{s.scale:.6f}): median {np.median(off):.3f} m, largest {off.max():.3f} m"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
