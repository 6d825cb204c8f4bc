"""`jaxphoto lidar-control` and `jaxphoto simultaneous`, from a simulated folder to results."""

import json

import laspy
import numpy as np
import pandas as pd
import pytest

from jaxphoto import adjust
from jaxphoto.io import read_block, write_simulation
from jaxphoto.io.clouds import read_cloud
from jaxphoto.writing import MARKER
from tests.commands import run
from tests.procedures.lidar import misaligned

SIGMAS = ("--sigma-z-m", "0.1", "--sigma-xy-m", "0.3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("lidar") / "block"
    write_simulation(misaligned(), path)
    return path


def test_lidar_control(folder, tmp_path, monkeypatch, capsys):
    out = tmp_path / "controlled"
    code, said, _ = run(
        monkeypatch, capsys, "lidar-control", folder, folder / "cloud.laz", "--out", out, *SIGMAS, "--class", "2,6"
    )
    assert code == 0
    heights = pd.read_csv(out / "lidar_heights.csv", dtype={"point": str}, keep_default_na=False)
    block = read_block(out)
    used = heights[heights["used"]]
    said = " ".join(said.split())
    assert f"{len(used)} of {len(heights)} tie points have a control height" in said
    assert [block.points[p] for p in block.control.who] == used["point"].tolist()
    np.testing.assert_allclose(block.control.value, used["height_m"].astype(float), atol=1e-9)
    assert (block.control.axis == 2).all()
    page = (out / "report.html").read_text(encoding="utf-8")
    assert f"{len(used)} of {len(heights)} tie points" in page and "cloud.laz" in page and "<svg" in page
    rounds = pd.read_csv(out / "lidar_rounds.csv")
    assert rounds["largest_change"].iloc[-1] < 0.1
    # Whoever adjusts it stays where it is.
    again = adjust(block)
    assert bool(again.converged)
    position = block.start.unknowns.exterior.position
    np.testing.assert_allclose(again.unknowns.exterior.position, position, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_simultaneous(folder, tmp_path, monkeypatch, capsys):
    out, cloud = tmp_path / "both", folder / "cloud.laz"
    given = ("--trajectory", folder / "trajectory.csv", "--shift", "2", *SIGMAS)
    code, said, _ = run(monkeypatch, capsys, "simultaneous", folder, cloud, "--out", out, *given)
    assert code == 0 and "converged after" in said
    names = {MARKER, "moved.csv", "rounds.csv", "surfaces.csv", "scanner_correlation.csv", "summary.json"}
    assert names | {"cloud.laz", "trajectory.csv", "adjustment", "report.html"} == {path.name for path in out.iterdir()}
    moved = pd.read_csv(out / "moved.csv").set_index("what")
    found = moved.loc[moved.index.str.startswith("scanner.boresight")]
    truth = np.rad2deg(np.asarray(misaligned().truth.scanner.boresight))
    assert (np.abs(found["after"] - truth) < 3 * found["sigma"]).all()
    before, after = moved.loc["points above the surface, RMSE", ["before", "after"]]
    surfaces = pd.read_csv(out / "surfaces.csv")
    assert np.sqrt((surfaces["above_m"] ** 2).mean()) == pytest.approx(after)
    assert after < before
    assert json.loads((out / "summary.json").read_text())["iteration_converged"] is True
    # The corrected cloud: the same points, moved.
    raw, mended = read_cloud(cloud), read_cloud(out / "cloud.laz")
    np.testing.assert_array_equal(mended.classification, raw.classification)
    rms = np.sqrt(((mended.xyz - raw.xyz) ** 2).mean(axis=0))
    np.testing.assert_allclose(rms, [moved.loc[f"laser points, {a}", "moved"] for a in "XYZ"], rtol=1e-2)


@pytest.mark.parametrize(
    ("command", "arguments", "said"),
    [
        ("lidar-control", ("--method", "magic"), "'magic' is not one of 'plane'"),
        ("lidar-control", ("--sigma-z-m", "-1"), "'--sigma-z-m': -1 is not a positive number"),
        ("lidar-control", ("--class", "ground"), "--class ground: give class numbers"),
        ("lidar-control", ("--class", "9"), "9"),
        ("simultaneous", ("--shift", "much"), "--shift much: give free, fixed, or a standard deviation"),
        ("simultaneous", ("--method", "image"), "'image' is not one of"),
        ("simultaneous", ("--trajectory", "nowhere.csv"), "nowhere.csv"),
    ],
)
def test_bad_options(folder, tmp_path, monkeypatch, capsys, command, arguments, said):
    given = (command, folder, folder / "cloud.laz", "--out", tmp_path / "out", *arguments)
    code, _, error = run(monkeypatch, capsys, *given)
    assert code == 2 and said in error and "Traceback" not in error
    assert not (tmp_path / "out").exists()


def test_a_trajectory_of_another_day(folder, tmp_path, monkeypatch, capsys):
    late = pd.read_csv(folder / "trajectory.csv")
    late["time_s"] += 86400.0
    late.to_csv(tmp_path / "late.csv", index=False)
    given = ("--trajectory", tmp_path / "late.csv", "--out", tmp_path / "out")
    cloud = folder / "cloud.laz"
    for command in (("simultaneous", folder, cloud, *SIGMAS), ("strips", cloud)):
        code, _, error = run(monkeypatch, capsys, *command, *given)
        assert code == 2 and "where the trajectory has no records" in error
        assert "--trajectory-shift-s +86400" in error


def test_a_cloud_elsewhere(folder, tmp_path, monkeypatch, capsys):
    with laspy.open(folder / "cloud.laz") as reader:
        las = reader.read()
    las.x = las.x + 1e5
    las.write(tmp_path / "far.laz")
    given = ("lidar-control", folder, tmp_path / "far.laz", "--out", tmp_path / "out")
    code, _, error = run(monkeypatch, capsys, *given)
    assert code == 2 and "over the block" in error and error.count(" to ") >= 4


@pytest.mark.filterwarnings("always::UserWarning")
def test_a_cloud_that_contradicts_the_images_is_reported(folder, tmp_path, monkeypatch, capsys):
    """Easting and northing exchanged: most points still have a surface below them, at a wrong height."""
    las = laspy.read(folder / "cloud.laz")
    las.x, las.y = np.array(las.y), np.array(las.x)
    las.write(tmp_path / "cloud.laz")
    given = ("lidar-control", folder, tmp_path / "cloud.laz", "--out", tmp_path / "out", *SIGMAS)
    code, _, error = run(monkeypatch, capsys, *given)
    assert code == 0 and "the cloud contradicts" in error
