"""`jaxphoto strips`, as a shell calls it."""

import json

import laspy
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from jaxphoto import adjust, read_block
from jaxphoto.block import Frame
from jaxphoto.camera import get_parameter
from jaxphoto.cloud import Cloud
from jaxphoto.georeferencing import Trajectory
from jaxphoto.io import clouds
from jaxphoto.io.clouds import EVERY_CLASS
from jaxphoto.io.recipe.truth import write_simulation
from jaxphoto.io.trajectory import (
    FIELDS,
    positions_in,
    read_sbet,
    records_of,
    sbet_records,
    with_poses,
    with_records,
    write_sbet,
)
from jaxphoto.lidar.correction import correct_flight
from jaxphoto_command.lidar import write_corrected
from tests.commands import run
from tests.lidar.clouds import SURFACES, ground
from tests.procedures.joint import BORESIGHT_DEG, flown

SHIFT = np.array([0.15, -0.2, 0.1])
OPTIONS = ("--cell-m", "2", "--roughness-m", "0.04")
POSITIVE = (
    "--cell-m", "--roughness-m", "--knots-s", "--correlation-s", "--sigma-position-m", "--sigma-attitude-deg",
    "--sigma-heading-deg", "--sigma-exposure-m", "--sigma-exposure-deg",
)  # fmt: skip


@pytest.fixture(scope="module")
def cloud_file(tmp_path_factory):
    parts = [ground(SURFACES["rolling"], 5.0, 0.02, 0.02, 100.0, seed) for seed in (1, 2)]
    strip = np.repeat([0, 1], [len(p) for p in parts])
    # Flown along X at 50 m/s, the second strip ten seconds after the first.
    time = np.concatenate(parts)[:, 0] / 50.0 + 10.0 * strip
    path = tmp_path_factory.mktemp("strips") / "both.laz"
    xyz = np.concatenate([parts[0], parts[1] + SHIFT])
    # One of them is a blunder far below, which makes no plane.
    xyz[7, 2] -= 50.0
    kind = np.where(np.arange(len(xyz)) == 7, 7, 2).astype(np.uint8)
    clouds.write_cloud(Cloud(xyz, classification=kind, time=time, strip=strip, strips=("1", "2")), path)
    # Some are not to be used, and would be seen if they were.
    las = laspy.read(path)
    unused = np.arange(len(xyz)) % 50 == 0
    las.withheld = unused
    las.z = np.where(unused, las.z + 30.0, las.z)
    las.write(path)
    return path


def test_shifts_are_taken_off_the_cloud(cloud_file, tmp_path, monkeypatch, capsys):
    code, output, errors = run(monkeypatch, capsys, "strips", cloud_file, "--out", tmp_path / "out", *OPTIONS)
    assert code == 0, errors
    assert "gaps of strips" in output
    out = tmp_path / "out"
    before, after = clouds.read_cloud(cloud_file), clouds.read_cloud(out / "both.laz")
    moved = before.xyz - after.xyz
    np.testing.assert_allclose(moved[before.strip == 0], 0.0, atol=1e-3)
    np.testing.assert_allclose(moved[before.strip == 1], np.tile(SHIFT, ((before.strip == 1).sum(), 1)), atol=0.03)
    np.testing.assert_allclose(after.time, before.time, atol=1e-9)
    every, written = (clouds.read_cloud(f, classes=EVERY_CLASS) for f in (cloud_file, out / "both.laz"))
    assert len(written) == len(every) == len(before) + 1 and (written.classification == every.classification).all()
    given, written = laspy.read(cloud_file), laspy.read(out / "both.laz")
    for name in set(given.point_format.dimension_names) - {"X", "Y", "Z"}:
        np.testing.assert_array_equal(written[name], given[name])
    unused = (given.withheld == 1) & (given.point_source_id == 2)
    assert unused.sum() > 50
    off = (given.xyz - written.xyz)[unused]
    np.testing.assert_allclose(off, np.tile(SHIFT, (len(off), 1)), atol=0.03)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.index("sigma Z [m]") < page.index("<h2") and "Errors of the trajectory" not in page
    strips = pd.read_csv(out / "strips.csv")
    assert strips.rms_m[0] < 0.2 * strips.rms_before_m[0]
    knots = pd.read_csv(out / "trajectory_errors.csv")
    assert (knots.sigma_X_m[1] > 0) and (knots.sigma_X_m[0] == 0)
    gaps = pd.read_csv(out / "differences.csv")
    # On rolling ground a shift in X and Y makes gaps of both signs about that in Z.
    assert gaps.before_m.median() == pytest.approx(SHIFT[2], abs=0.03) and gaps.before_m.std() > 0.01
    assert np.sqrt((gaps.after_m**2).mean()) < 0.015
    assert gaps.notna().mean().min() > 0.9
    assert {f.name for f in out.iterdir() if f.suffix == ".csv"} == {
        "strips.csv", "rounds.csv", "scanner.csv", "trajectory_errors.csv", "correlation.csv",
        "differences.csv",
    }  # fmt: skip


@pytest.mark.slow
def test_a_trajectory_is_mended_with_the_cloud(cloud_file, tmp_path, monkeypatch, capsys):
    """The second strip's shift is one of its trajectory; the first is held."""
    time = np.concatenate([start + np.arange(-1.0, 4.0, 0.1) for start in (0.0, 10.0)])
    columns = {"X_m": 50.0 * (time % 10 - 10 * (time % 10 > 5)), "Y_m": 50.0, "Z_m": 500.0}
    flown = {"time_s": time, **columns, "roll_deg": 0.0, "pitch_deg": 0.0, "yaw_deg": 90.0}
    pd.DataFrame(flown).to_csv(tmp_path / "flight.csv", index=False)
    given = ("--trajectory", tmp_path / "flight.csv", "--adjust", "none", "--hold", "1", "--sigma-position-m", "0.3")
    code, output, errors = run(monkeypatch, capsys, "strips", cloud_file, "--out", tmp_path / "out", *given, *OPTIONS)
    assert code == 0, errors + output
    before, after = pd.read_csv(tmp_path / "flight.csv"), pd.read_csv(tmp_path / "out" / "trajectory.csv")
    moved = before[["X_m", "Y_m", "Z_m"]].to_numpy() - after[["X_m", "Y_m", "Z_m"]].to_numpy()
    np.testing.assert_allclose(moved[time < 3], 0.0, atol=1e-6)
    middle = (time > 10.2) & (time < 11.8)
    np.testing.assert_allclose(moved[middle, 2].mean(), SHIFT[2], atol=0.05)
    np.testing.assert_allclose(after.time_s, before.time_s)
    assert pd.read_csv(tmp_path / "out" / "strips.csv").rms_m[0] < 0.02
    # Known by a five-hundredth of that, it cannot be off so, though the strips fit as well.
    known = (*given[:-1], "0.0005")
    code, output, errors = run(monkeypatch, capsys, "strips", cloud_file, "--out", tmp_path / "red", *known, *OPTIONS)
    assert code == 1 and "strip 2 fits the others only with a trajectory error of" in " ".join(output.split())


@pytest.fixture(scope="module")
def on_the_map(cloud_file, tmp_path_factory):
    """The same cloud in UTM, and its trajectory as SBET."""
    frame = Frame("epsg", 32633, origin=(15.4, 47.1, 400.0))
    folder = tmp_path_factory.mktemp("map")
    clouds.write_cloud(clouds.read_cloud(cloud_file), folder / "both.laz", frame=frame)
    clouds.write_cloud(clouds.read_cloud(cloud_file), folder / "both.csv", frame=frame)
    clouds.write_cloud(clouds.read_cloud(cloud_file), folder / "nowhere.laz")
    time = np.concatenate([start + np.arange(-1.0, 4.0, 0.1) for start in (0.0, 10.0)])
    xyz = np.column_stack([50.0 * (time % 10 - 10 * (time % 10 > 5)), np.full((len(time), 2), [50.0, 500.0])])
    level = Rotation.from_euler("z", 0.0).as_quat()[[3, 0, 1, 2]]
    flown = Trajectory(time, xyz, np.tile(level, (len(time), 1)), np.zeros_like(xyz), np.zeros_like(xyz))
    records = with_poses(records_of(flown, "sbet")._replace(geographic=True), flown, frame)
    empty = np.zeros((len(time), len(FIELDS)))
    empty[:, FIELDS.index("time")] = time
    empty[:, FIELDS.index("wander_angle")] = 0.3
    write_sbet(with_records(empty, records), folder / "flight.sbet")
    return folder, frame


@pytest.mark.slow
def test_a_cloud_on_the_map_and_a_trajectory_in_sbet(on_the_map, tmp_path, monkeypatch, capsys):
    folder, frame = on_the_map
    given = ("--trajectory", folder / "flight.sbet", "--adjust", "none", "--hold", "1", "--sigma-position-m", "0.3")
    cloud, out = folder / "both.laz", tmp_path / "out"
    code, output, errors = run(monkeypatch, capsys, "strips", cloud, "--out", out, *given, *OPTIONS)
    assert code == 0, errors + output
    before, after = (read_sbet(of / "flight.sbet") for of in (folder, out))
    kept = [k for k, name in enumerate(FIELDS) if name in ("time", "wander_angle", "x_velocity", "z_rate")]
    np.testing.assert_array_equal(after[:, kept], before[:, kept])
    local = [positions_in(sbet_records(values, ""), frame) for values in (before, after)]
    time, moved = before[:, 0], local[0] - local[1]
    np.testing.assert_allclose(moved[time < 3], 0.0, atol=1e-6)
    middle = (time > 10.2) & (time < 11.8)
    np.testing.assert_allclose(moved[middle, 2].mean(), SHIFT[2], atol=0.05)
    # The cloud stays where it was on the map.
    first = clouds.read_cloud(cloud).strip == 0
    corrected = clouds.read_cloud(out / "both.laz")
    np.testing.assert_allclose(corrected.xyz[first], clouds.read_cloud(cloud).xyz[first], atol=2e-3)
    page, summary = (out / "report.html").read_text(encoding="utf-8"), json.loads((out / "summary.json").read_text())
    assert "Errors of the trajectory" in page and f'class="verdict {summary["verdict"]}"' in page
    assert summary["iteration_converged"] and summary["verdict"] in ("green", "amber")

    # A table comes back as the file counts, too.
    options = ("--cloud-epsg", "32633", *given, *OPTIONS)
    code, _, errors = run(monkeypatch, capsys, "strips", folder / "both.csv", "--out", tmp_path / "table", *options)
    assert code == 0, errors
    table = clouds.read_cloud(tmp_path / "table" / "corrected_both.csv").xyz[first]
    np.testing.assert_allclose(table, clouds.read_cloud(folder / "both.csv").xyz[first], atol=2e-3)

    code, _, errors = run(
        monkeypatch, capsys, "strips", folder / "nowhere.laz", "--out", tmp_path / "no", *given, *OPTIONS
    )
    assert code == 2 and "give it (--cloud-epsg)" in " ".join(errors.split()) and not (tmp_path / "no").exists()


def test_withheld_points_that_nothing_says_anything_of_stay(cloud_file, tmp_path):
    """Of a strip that has no others, met first in the file, or flown where the trajectory has no records."""
    las = laspy.read(cloud_file)
    first, unflown = np.arange(len(las)) == 0, np.arange(len(las)) == 50
    assert (las.withheld[first | unflown] == 1).all()
    las.point_source_id = np.where(first, 9, las.point_source_id)
    las.gps_time = np.where(unflown, -50.0, las.gps_time)
    (tmp_path / "given").mkdir()
    las.write(tmp_path / "given" / "both.laz")
    time = np.arange(-1.0, 15.0, 0.1)
    path = Trajectory(time, np.zeros((160, 3)), np.ones((160, 4)) / 2, np.zeros((160, 3)), np.zeros((160, 3)))

    def corrected(part: Cloud) -> np.ndarray:
        return part.xyz + np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]])[part.strip]

    with pytest.warns(UserWarning, match=r"both\.laz: 2 points marked as withheld cannot be corrected"):
        write_corrected(tmp_path / "given" / "both.laz", tmp_path, corrected, ("1", "2"), path, None)
    lifted = laspy.read(tmp_path / "both.laz").xyz[:, 2] - las.xyz[:, 2]
    np.testing.assert_allclose(lifted, np.where(first | unflown, 0.0, las.point_source_id), atol=1e-3)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--adjust", "boresight,mirror"), "--adjust 'mirror': choose from boresight, lever-arm"),
        (("--adjust", ","), "--adjust ',': choose from boresight"),
        (("--most-planes", "0"), "'--most-planes'"),
        (("--pattern", "circle"), "without a trajectory only strip shifts are estimated"),
        (("--adjust", "boresight"), "without a trajectory only strip shifts are estimated"),
        (("--pattern", "zigzag"), "'zigzag' is not one of 'line', 'circle'"),
        (("--hold", "3"), "unknown strip 3; choose among 1, 2"),
        *(((option, "nan"), f"'{option}': nan is not a positive number") for option in POSITIVE),
        (("--cell-m", "0"), "'--cell-m': 0 is not a positive number"),
        (("--sigma-heading-deg", "inf"), "'--sigma-heading-deg': inf is not a positive number"),
        (("--trajectory-shift-s", "nan"), "'--trajectory-shift-s': nan is not a finite number"),
        (("--exposure-shift-s", "inf"), "'--exposure-shift-s': inf is not a finite number"),
        (("--cell-m", "0.3"), "strip 1 has fewer than 10 planes in common"),
    ],
)
def test_bad_input_is_one_sentence_and_nothing_is_written(cloud_file, tmp_path, monkeypatch, capsys, options, sentence):
    code, _, errors = run(monkeypatch, capsys, "strips", cloud_file, "--out", tmp_path / "out", *options)
    assert code == 2
    assert sentence in " ".join(errors.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_photographs_are_adjusted_with_the_strips(tmp_path, monkeypatch, capsys):
    """From files; the same flight as of `test_joint_adjustment`."""
    folder, out = tmp_path / "flight", tmp_path / "out"
    write_simulation(flown(), folder)
    drifts = ("--knots-s", "5", "--correlation-s", "60", "--sigma-position-m", "0.05", "--sigma-attitude-deg", "0.003")
    given = ("--trajectory", folder / "trajectory.csv", "--block", folder, "--adjust", "boresight,angle-scale")
    fine = (*drifts, "--sigma-heading-deg", "0.006", "--cell-m", "8")
    code, output, errors = run(monkeypatch, capsys, "strips", folder / "cloud.laz", "--out", out, *given, *fine)
    assert code == 0, errors + output
    assert "photographs" in output
    interior = pd.read_csv(out / "adjustment" / "interior.csv").set_index("parameter")
    assert abs(interior.value["c_mm"] - 34.25) < 4 * interior.sigma["c_mm"] < 0.02
    scanner = pd.read_csv(out / "scanner.csv").set_index("parameter")
    turned = [f"mounts[default].boresight_{axis}_deg" for axis in "xyz"]
    assert (np.abs(scanner.value[turned] - BORESIGHT_DEG) < 4 * scanner.sigma[turned]).all()
    rho = pd.read_csv(out / "correlation.csv", index_col="parameter")
    assert {"scanner.boresight_up_rad", "interior[kodak].c_mm", "mounts[default].boresight_x_rad"} <= set(rho.columns)
    # Scanner 4, camera 5, mount 3, and six of each of 21 knots.
    assert rho.shape == (138, 138) and np.allclose(np.diagonal(rho), 1.0)
    # On disk, too: adjusted anew it is the same.
    anew = adjust(read_block(out / "block"))
    of_c = float(get_parameter(anew.unknowns.interior["kodak"], "c_mm"))
    assert of_c == pytest.approx(interior.value["c_mm"], abs=1e-7)
    # The trajectory is mended: where it truly went, but for what strips and photographs do not tell.
    true = correct_flight(flown().trajectory, flown().errors)
    before, after = (pd.read_csv(f / "trajectory.csv")[["X_m", "Y_m", "Z_m"]].to_numpy() for f in (folder, out))
    off = [np.sqrt(np.mean((v - np.asarray(true.position)) ** 2)) for v in (before, after)]
    assert off[1] < 0.8 * off[0]


def test_photographs_without_times_are_refused(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "flight"
    write_simulation(flown(), folder)
    images = pd.read_csv(folder / "images.csv")
    images.loc[2, "time_s"] = np.nan
    images.to_csv(folder / "images.csv", index=False)
    given = ("--block", folder, "--trajectory", folder / "trajectory.csv")
    code, _, errors = run(monkeypatch, capsys, "strips", folder / "cloud.laz", "--out", tmp_path / "out", *given)
    assert code == 2
    assert "image A_03 has no time_s" in " ".join(errors.split())
    assert not (tmp_path / "out").exists()
