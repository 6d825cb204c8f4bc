"""Steps of rounded values, and warnings about arrays and files with too few digits."""

import numpy as np
import pytest

from jaxphoto.block import Block, Frame
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.cloud import Cloud
from jaxphoto.io.clouds import read_cloud, write_cloud
from jaxphoto.io.trajectory import Records, trajectory_in
from jaxphoto.rounding import float_step, rounding_error, rounding_step

RNG = np.random.default_rng(20)
HEIGHTS = RNG.normal(140.0, 4.0, 30)


@pytest.mark.parametrize(
    ("step", "unit"),
    [
        (1.0, "m"), (0.5, "m"), (0.1, "m"), (0.3048, "m"),
        (0.25, "m"), (0.0625, "m"), (0.9, "deg"), (1 / 60, "deg"), (0.1, "px"),
    ],
)  # fmt: skip
def test_the_step_of_rounded_values_is_found(step, unit):
    rounded = np.round(HEIGHTS / step) * step
    assert rounding_step(rounded, step / 8, unit) == pytest.approx(step, rel=1e-12)
    # A value between, or a sigma above the step.
    assert rounding_step(np.append(rounded, 140 + step / np.pi), step / 8, unit) == 0
    assert rounding_step(rounded, step, unit) == 0


def test_few_values_may_be_multiples_by_chance():
    rounded = np.round(HEIGHTS)
    n = next(n for n in range(1, 30) if rounding_step(rounded[:n], 0.08, "m"))
    assert n >= 5 and 0.08**n < 1e-6
    # Equal values have no step.
    assert rounding_step(np.full(30, 60.0), 0.08, "m") == 0


def test_values_recorded_in_steps_of_sigma_are_not_rounded():
    for seed in range(2000):
        values = np.random.default_rng(seed).normal(0.0, 50.0, 5 + seed % 20)
        assert rounding_step(np.round(values, 2), 0.01, "m") == 0


def test_the_error_of_rounding_is_that_of_a_uniform_distribution():
    values = RNG.uniform(0.0, 1000.0, 100_000)
    assert np.std(np.round(values) - values) == pytest.approx(rounding_error(1.0), rel=0.01)


def test_float32_matters_where_its_step_reaches_sigma():
    northings = np.float32(5_400_000 + HEIGHTS)
    assert float_step(northings, 0.02) == 0.5
    assert float_step(northings.astype(float), 0.02) == float_step(np.float32(HEIGHTS), 0.02) == 0
    # Widened to 64 bits it remains rounded.
    assert rounding_step(np.float32(5_400_000 + 100 * HEIGHTS).astype(float), 0.02, "m") == 0.5


CAMERAS = {"one": (Sensor(4000, 3000, 0.004), InteriorOrientation(20.0))}
IMAGE_POINTS = {
    "image": np.repeat(["a", "b"], 6), "point": np.tile([f"p{k}" for k in range(6)], 2),
    "x_mm": RNG.uniform(-8, 8, 12), "y_mm": RNG.uniform(-6, 6, 12),
}  # fmt: skip
NORTHING = 5_400_000.0
TABLES = {
    "control": {
        "point": [f"p{k}" for k in range(6)], "X_m": RNG.uniform(0, 90, 6), "Y_m": NORTHING + RNG.uniform(0, 90, 6),
        "Z_m": RNG.uniform(0, 9, 6), "sigma_m": np.full(6, 0.02),
    },
    "stations": {
        "image": ["a", "b"], "X_m": [1.0, 50.0], "Y_m": [NORTHING, NORTHING + 40], "Z_m": [90.0, 91.0],
        "sigma_m": [0.1, 0.1],
    },
    "distances": {"point_a": ["p1"], "point_b": ["p2"], "distance_m": [30.5], "sigma_m": [1e-6]},
    "attitudes": {
        "image": ["a", "b"], "roll_deg": [0.1, 0.2], "pitch_deg": [0.1, 0.2], "yaw_deg": [350.1, 351.2],
        "sigma_deg": [1e-5, 1e-5],
    },
}  # fmt: skip


@pytest.mark.parametrize(
    ("table", "column"),
    [("control", "Y_m"), ("stations", "Y_m"), ("distances", "distance_m"), ("attitudes", "yaw_deg")],
)
def test_a_float32_column_of_a_table_is_named(table, column):
    narrow = {name: np.float32(v) if name == column else v for name, v in TABLES[table].items()}
    with pytest.warns(UserWarning, match=f"{table}, column {column}: float32 has steps of"):
        Block.of(IMAGE_POINTS, CAMERAS, sigma_mm=0.004, **{table: narrow})


def test_float32_columns_with_enough_digits_are_no_warning():
    tables = {name: dict(table) for name, table in TABLES.items() if name in ("control", "stations")}
    for table in tables.values():
        table |= {name: np.float32(table[name]) for name in ("X_m", "Z_m")}
    seen = IMAGE_POINTS | {name: np.float32(IMAGE_POINTS[name]) for name in ("x_mm", "y_mm")}
    Block.of(seen, CAMERAS, sigma_mm=0.004, **tables)


def test_float32_clouds_are_named():
    xyz = np.column_stack([RNG.uniform(0, 90, 50), NORTHING + RNG.uniform(0, 90, 50), RNG.uniform(0, 9, 50)])
    with pytest.warns(UserWarning, match=r"column Y: float32 has steps of 0\.5 m at 54000"):
        Cloud(np.float32(xyz))
    Cloud(xyz)
    Cloud(np.float32(xyz - [0, NORTHING, 0]))


@pytest.mark.parametrize("name", ["a.csv", "a.las"])
def test_a_cloud_of_rounded_heights_is_named(tmp_path, name):
    xyz = np.column_stack([*RNG.uniform(0, 90, (2, 200)), np.round(RNG.uniform(0, 9, 200), 1)])
    write_cloud(Cloud(xyz), tmp_path / name)
    with pytest.warns(UserWarning, match=rf"{name}, column Z: all heights are multiples of 0\.1"):
        read_cloud(tmp_path / name)
    write_cloud(Cloud(xyz + RNG.uniform(0, 0.1, xyz.shape)), tmp_path / name)
    read_cloud(tmp_path / name)


def test_a_rounded_trajectory_is_named():
    n = 200
    time = np.arange(n) * 0.1
    exact = np.column_stack([60 * time, 0.3 * time, 100 + np.cumsum(RNG.normal(0, 0.3, n))])
    records = Records("t.csv", time, exact, False, RNG.normal(0, 1, (n, 3)), *2 * [np.full((n, 3), np.nan)])
    sigmas = np.full((n, 3), 0.05), np.full((n, 3), 1e-4)
    rounded = records._replace(coordinates=np.column_stack([exact[:, :2], np.round(exact[:, 2])]))
    with pytest.warns(UserWarning, match=r"t\.csv, column Z_m: all values are multiples of 1 m, sigma is 0\.05 m"):
        trajectory_in(rounded, Frame(), *sigmas)
    # The track itself advances by multiples of 6 m, exactly.
    trajectory_in(records, Frame(), *sigmas)
