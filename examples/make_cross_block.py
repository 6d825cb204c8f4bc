"""Make the example block: a simulated flight in the shape of a published one, with known truth.

31 images of a medium-format camera in two crossing pairs of strips, 1000 m above ground; 154 tie points and 33
signalised points, of which 13 are control and 20 are check points; a GNSS position of every exposure. The numbers
are those of a published in-flight calibration (four experiments over a cross block), the points and the noise are drawn
with a fixed seed. Run it from anywhere:

    python examples/make_cross_block.py [FOLDER]

It writes the block folder FOLDER (default: cross_block beside this file) and, beside it, FOLDER_truth.csv with the
interior orientation that an adjustment should find.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxphoto import Brown, ExteriorOrientation, InteriorOrientation, Sensor, project
from jaxphoto.collinearity import camera_coordinates, project_ideal

SEED = 5
TRUTH = InteriorOrientation(34.25, 0.064, 0.273, Brown(k1=-9.12e-5, k2=1.0435e-7))
SENSOR = Sensor(4500, 3000, 0.008)
HEIGHT_M = 1000.0
# The long side of the format lies along the flight: 60 % forward overlap, 50 % between the strips of a pair.
BASE_M = 0.4 * SENSOR.width_mm / 34.25 * HEIGHT_M
SPACING_M = 0.5 * SENSOR.height_mm / 34.25 * HEIGHT_M
SPEED_M_PER_S = 60.0
# Strip: direction of flight (degrees counter-clockwise from east), side of its pair's axis, exposures.
STRIPS = {"A": (15, 0.5, 8), "B": (195, 0.5, 8), "C": (-75, 0.5, 8), "D": (105, 0.5, 7)}
N_TIES, N_TARGETS, N_CONTROL_PER_ARM = 154, 33, 3
SIGMA_IMAGE_MM, SIGMA_CONTROL_M, SIGMA_STATION_M = 0.004, 0.03, 0.10

BLOCK_TOML = f"""\
# Simulated by make_cross_block.py; the truth is in ../cross_block_truth.csv.
title = "Cross block, simulated: two crossing pairs of strips"

[frame]
kind = "local"

[sigmas]
image_mm = {SIGMA_IMAGE_MM}
control_m = {SIGMA_CONTROL_M}
station_m = {SIGMA_STATION_M:.2f}

[cameras.kodak]
width_px = {SENSOR.width_px}
height_px = {SENSOR.height_px}
pixel_mm = {SENSOR.pixel_mm}
distortion = "brown"

[cameras.kodak.interior]
c_mm = 34.0
xp_mm = 0.0
yp_mm = 0.0
k1 = 0.0
k2 = 0.0

[cameras.kodak.unknowns]
c_mm = "free"
xp_mm = "free"
yp_mm = "free"
k1 = "free"
k2 = "free"
"""


def main(folder: Path) -> None:
    """Write the block and its truth."""
    rng = np.random.default_rng(SEED)
    images = fly(rng)
    exterior = ExteriorOrientation.from_angles(
        images[["X_m", "Y_m", "Z_m"]].to_numpy(), np.deg2rad(images[["omega_deg", "phi_deg", "kappa_deg"]].to_numpy())
    )
    points = scatter(rng, exterior)
    image, point, xy = photograph(exterior, points[["X_m", "Y_m", "Z_m"]].to_numpy())
    xy = xy + rng.normal(0, SIGMA_IMAGE_MM, xy.shape)

    noisy = lambda table, sigma: table + rng.normal(0, sigma, table.shape)  # noqa: E731
    position, angles = ["X_m", "Y_m", "Z_m"], ["omega_deg", "phi_deg", "kappa_deg"]
    stations = images[["image"]].join(noisy(images[position], SIGMA_STATION_M))
    targets = points[points["role"] != "tie"]
    surveyed = targets[["point"]].join(noisy(targets[position], SIGMA_CONTROL_M)).assign(role=targets["role"])
    approximate = images.copy()
    approximate[position] = noisy(images[position], 5.0)
    approximate[angles] = noisy(images[angles], 1.0)
    measured = pd.DataFrame(
        {"image": images["image"].to_numpy()[image], "point": points["point"].to_numpy()[point]}
        | {"x_mm": xy[:, 0], "y_mm": xy[:, 1]}
    )

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "block.toml").write_text(BLOCK_TOML, encoding="utf-8")
    write(approximate, folder / "images.csv", 1)
    write(measured, folder / "image_points.csv", 4)
    write(surveyed, folder / "control_points.csv", 3)
    write(stations, folder / "stations.csv", 3)
    truth = {
        "c_mm": TRUTH.c,
        "xp_mm": TRUTH.xp,
        "yp_mm": TRUTH.yp,
        "k1": TRUTH.distortion.k1,
        "k2": TRUTH.distortion.k2,
    }
    table = pd.DataFrame({"camera": "kodak", "parameter": truth.keys(), "value": truth.values()})
    table.to_csv(folder.parent / f"{folder.name}_truth.csv", index=False)


def fly(rng: np.random.Generator) -> pd.DataFrame:
    """Exposure stations and attitudes: the plan, 15 m of wander, 2 degrees of tilt, 3 degrees of crab."""
    rows, clock = [], 0.0
    for strip, (direction, side, n) in STRIPS.items():
        forward = np.array([np.cos(np.deg2rad(direction)), np.sin(np.deg2rad(direction))])
        right = np.array([forward[1], -forward[0]])
        for k, along in enumerate((np.arange(n) - (n - 1) / 2) * BASE_M):
            x, y = along * forward + side * SPACING_M * right + rng.normal(0, 15, 2)
            omega, phi = rng.normal(0, 2, 2)
            kappa = (direction + rng.normal(0, 3) + 180) % 360 - 180
            time = clock + k * BASE_M / SPEED_M_PER_S
            rows.append(
                (f"{strip}{k + 1}", "kodak", strip, time, x, y, HEIGHT_M + rng.normal(0, 15), omega, phi, kappa)
            )
        clock += 300.0
    columns = ["image", "camera", "strip", "time_s", "X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg"]
    return pd.DataFrame(rows, columns=columns)


def scatter(rng: np.random.Generator, exterior: ExteriorOrientation) -> pd.DataFrame:
    """Tie points and targets over both pairs of strips, each seen by two images at least."""
    length, width = 3.5 * BASE_M, 0.95 * (0.5 * SPACING_M + 0.5 * SENSOR.height_mm / 34.25 * HEIGHT_M)
    first = np.deg2rad(STRIPS["A"][0])
    along = np.array([np.cos(first), np.sin(first)])
    across = np.array([-along[1], along[0]])
    places: list[np.ndarray] = []
    while len(places) < N_TIES + N_TARGETS:
        a, b = rng.uniform(-length, length, 2)
        if min(abs(a), abs(b)) > width:
            continue
        x, y = a * along + b * across
        place = np.array([x, y, 14 * np.sin(x / 420) + 10 * np.cos(y / 310) + rng.uniform(-6, 6)])
        if len(photograph(exterior, place[None])[0]) >= 2:
            places.append(place)
    xyz = np.array(places)
    targets = xyz[N_TIES:]
    ids = [f"{k + 1}" for k in range(N_TIES)] + [f"T{k + 1}" for k in range(N_TARGETS)]
    table = pd.DataFrame({"point": ids} | {name: xyz[:, j] for j, name in enumerate(("X_m", "Y_m", "Z_m"))})

    # Control: the outermost targets of each of the four arms, and the one nearest to the centre.
    arms = [targets[:, :2] @ direction for direction in (along, -along, across, -across)]
    control = {int(k) for arm in arms for k in np.argsort(-arm)[:N_CONTROL_PER_ARM]}
    control.add(int(np.argmin(np.hypot(targets[:, 0], targets[:, 1]))))
    table["role"] = ["tie"] * N_TIES + ["control" if k in control else "check" for k in range(N_TARGETS)]
    return table


@jax.jit
def _images_of(exterior: ExteriorOrientation, places: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(images, points, 2) measured coordinates, and which of them mean anything."""

    def of_point(one, place):
        # Far outside the format the distortion cannot be inverted, and behind the camera there is no image.
        seen = TRUTH.valid(project_ideal(TRUTH, one, place)) & (camera_coordinates(one, place)[2] < 0)
        return project(TRUTH, one, place), seen

    return jax.vmap(jax.vmap(of_point, in_axes=(None, 0)), in_axes=(0, None))(exterior, places)


def photograph(exterior: ExteriorOrientation, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, point and coordinates (mm, without noise) of every point that falls on a format."""
    xy, seen = map(np.asarray, _images_of(exterior, jnp.asarray(places)))
    half = np.array([SENSOR.width_mm, SENSOR.height_mm]) / 2
    image, point = np.nonzero(seen & (np.abs(xy) < half).all(-1))
    return image, point, xy[image, point]


def write(table: pd.DataFrame, path: Path, digits: int) -> None:
    """Write a CSV with this number of decimals."""
    table.to_csv(path, index=False, float_format=f"%.{digits}f")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent / "cross_block")
