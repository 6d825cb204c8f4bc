"""Estimate the time offset of a camera from a trajectory, image points and little control."""

import jax
import numpy as np
import pytest

import jaxphoto.report
from jaxphoto.georeferencing import NOMINAL
from jaxphoto.io import read_block
from jaxphoto.io.trajectory import Records, write_flight_csv
from jaxphoto.rotation import matrix_from_roll_pitch_yaw

OFFSET = 0.05
TOML = """
[trajectory]
file = "flight.csv"
[sigmas]
image_mm = 0.004
control_m = 0.02
[cameras.kodak]
width_px = 4500
height_px = 3000
pixel_mm = 0.008
distortion = "brown"
[cameras.kodak.interior]
c_mm = 35.0
[mounts.default]
time_offset = "free"
boresight = "free"
"""
"""Boresight is free, because an error in pitch and one of the clock are alike in strips of one direction."""


def pose(t):
    """Two strips, there and back, 30 m/s, with the angles of an aircraft (degrees)."""
    there = t < 70
    sign = np.where(there, 1.0, -1.0)
    position = np.stack(
        [np.where(there, 30 * t, 30 * (140 - t)), np.where(there, 0.0, 300.0), 1000 + np.sin(t / 3)], -1
    )
    angles = np.stack([2 * np.sin(t), 1.5 * np.cos(0.8 * t), 180 - sign * 90 + 2 * np.sin(0.5 * t)], -1)
    return position, angles


@pytest.mark.slow
def test_a_time_offset_is_estimated_with_its_standard_deviation(tmp_path):
    rng = np.random.default_rng(12)
    records = np.r_[np.arange(-5, 45, 0.05), np.arange(95, 145, 0.05)]
    position, angles = pose(records)
    n = len(records)
    noisy = Records(
        "flight.csv", records + 4e5, position + rng.normal(0, 0.002, (n, 3)), False,
        angles + rng.normal(0, 5e-4, (n, 3)), np.full((n, 3), 0.03), np.full((n, 3), 0.003),
    )  # fmt: skip
    write_flight_csv(noisy, tmp_path / "flight.csv")
    times = np.r_[0:41:9.5, 100:141:9.5]
    at, attitude = pose(times)
    at, attitude = at + rng.normal(0, 0.03, at.shape), attitude + rng.normal(0, 0.003, at.shape)
    body = np.asarray(jax.jit(jax.vmap(matrix_from_roll_pitch_yaw))(np.deg2rad(attitude)))
    camera = np.swapaxes(body @ NOMINAL["forward"], 1, 2)
    points = np.column_stack([rng.uniform(-200, 1400, 60), rng.uniform(-200, 500, 60), rng.uniform(0, 120, 60)])

    rows = []
    for i, (rotation, centre) in enumerate(zip(camera, at, strict=True)):
        u, v, w = rotation @ (points - centre).T
        xy = -35.0 * np.stack([u, v], 1) / w[:, None] + rng.normal(0, 0.004, (60, 2))
        rows += [(i, p, *xy[p]) for p in np.flatnonzero((np.abs(xy) < [17.5, 11.5]).all(axis=1))]
    seen = [p for p in range(60) if sum(row[1] == p for row in rows) >= 2]
    measured = "".join(f"i{i},p{p},{float(x)!r},{float(y)!r}\n" for i, p, x, y in rows if p in seen)
    control = "".join("p{},{},{},{}\n".format(p, *(points[p] + rng.normal(0, 0.02, 3))) for p in seen[:8])
    (tmp_path / "block.toml").write_text(TOML)
    (tmp_path / "image_points.csv").write_text("image,point,x_mm,y_mm\n" + measured)
    (tmp_path / "control_points.csv").write_text("point,X_m,Y_m,Z_m\n" + control)
    # The clock of the camera is late: what it records is before the true exposure.
    listed = "".join(f"i{i},kodak,{float(4e5 + t - OFFSET)!r}\n" for i, t in enumerate(times))
    (tmp_path / "images.csv").write_text("image,camera,time_s\n" + listed)

    block = read_block(tmp_path)
    adjusted = jaxphoto.adjust(block)
    table = jaxphoto.report.Tables(adjusted).georeferencing
    print(table)
    offset = table[table.parameter.str.contains("time_offset")].iloc[0]
    assert offset.sigma < 0.005
    assert abs(offset.value - OFFSET) < 3 * offset.sigma
    assert 0.7 < float(adjusted.sigma0) < 1.3
