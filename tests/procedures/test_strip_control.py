"""Strips go through surveyed points on smooth surfaces, which tell what all strips have in common."""

import dataclasses
import json
import re

import numpy as np
import pandas as pd
import pytest

from jaxphoto import BlockError, InputError
from jaxphoto.block import Frame
from jaxphoto.cloud import Cloud
from jaxphoto.io import clouds
from jaxphoto.lidar.strip_planes import StripSettings
from jaxphoto.procedures.control import SurveyedPoints
from jaxphoto.procedures.lidar import StripAdjustment, adjust_strips
from jaxphoto.procedures.lidar.strip_control import with_control
from jaxphoto.report.strips import strips_verdict, surveyed_table
from jaxphoto.report.tables import Tables
from jaxphoto.simulation import Simulation
from tests.commands import run
from tests.lidar.clouds import gable, ground
from tests.procedures.joint import flown as flown_with_photographs
from tests.procedures.joint import photographs
from tests.procedures.strips import PRIORS, SETTINGS, fitted, flown

COARSE = StripSettings(cell_m=2.0, roughness_m=0.04, returns=8)
SHIFT, COMMON = np.array([0.15, -0.2, 0.1]), np.array([0.3, -0.25, 0.4])
SIGMA_M, SIDE = 0.02, 100.0
# Middles of roof faces: 30 degrees to both sides.
FACES = np.arange(4.0, SIDE, 8.0)


def roofs(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Roofs in rows, in one half along Y and in the other along X."""
    return np.where(y < 48.0, gable(x, y), gable(y, x))


def level(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A place in the middle of the roofs."""
    return np.where(np.hypot(x - 50, y - 50) < 15, 4.0, roofs(x, y))


def two_strips(seed: int, shape=roofs) -> Cloud:
    """Off by COMMON, the second by SHIFT more."""
    parts = [ground(shape, 4.0, 0.02, 0.02, SIDE, 10 * seed + k) for k in (1, 2)]
    strip = np.repeat([0, 1], [len(p) for p in parts])
    return Cloud(np.concatenate([parts[0], parts[1] + SHIFT]) + COMMON, strip=strip, strips=("1", "2"))


def surveyed(xyz: np.ndarray, seed: int = 0, sigma: float = SIGMA_M, check=False) -> SurveyedPoints:
    n = len(xyz)
    off = np.random.default_rng(seed).normal(0, sigma, (n, 3))
    rows = tuple(f"control.csv, row {k + 2}" for k in range(n))
    names = tuple(f"K{k}" for k in range(n))
    return SurveyedPoints("control.csv", names, xyz + off, np.full((n, 3), sigma), np.full(n, check), rows)


def on_roofs(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x, y = rng.choice(FACES, n), rng.choice(FACES, n)
    return np.column_stack([x, y, roofs(x, y)])


def pulls(seed: int) -> np.ndarray:
    """Errors of the six shifts over their standard deviations, found by control on roofs."""
    found = adjust_strips(two_strips(seed), settings=COARSE, control=surveyed(on_roofs(12, seed), seed))
    assert found.converged
    return (found.errors.position - [COMMON, COMMON + SHIFT]).ravel() / np.asarray(found.covariance.shared_sigma)


@pytest.mark.slow
def test_control_determines_common_shifts_without_a_trajectory():
    control = surveyed(on_roofs(24, 3), 3)
    control = control._replace(check=np.arange(24) % 4 == 3)
    control.coordinates[0, 2] += 0.5  # A blunder.
    found = adjust_strips(two_strips(3), settings=COARSE, control=control)
    sigma = np.asarray(found.covariance.shared_sigma)
    off = found.errors.position - [COMMON, COMMON + SHIFT]
    assert found.converged and (np.abs(off.ravel()) < 3.5 * sigma).all() and (sigma < 0.025).all()
    # Both strips stand on the same survey of 18 points, which does not get better by that.
    assert (sigma[2::3] > SIGMA_M / np.sqrt(18)).all()
    told = {(d.one, d.other): d for d in found.differences}
    assert set(told) == {("1", "2"), *((what, k) for what in ("control", "check points") for k in "12")}
    assert found.rounds[-1].control == sum(told["control", k].planes for k in "12")
    for what in ("control", "check points"):
        assert told[what, "1"].rms_before_m > 0.2 and told[what, "1"].rms_m < 2 * told[what, "1"].noise_m
    assert 1 <= found.rounds[-1].left_out <= 4
    gaps = surveyed_table(found)
    assert set(gaps.point[:2]) == {"K0"} and not gaps.used[:2].any() and (gaps.w[:2] > 6).all()
    check, used = gaps[gaps.role == "check"], gaps[gaps.used]
    # Of six points, which both strips have.
    assert (check.sigma_m > check.noise_m).all() and 0.25 < np.sqrt(np.mean(check.w**2)) < 1.9
    assert (used.sigma_m < used.noise_m).all() and len(used) == found.rounds[-1].control


def test_one_strip_is_fitted_to_control():
    both = two_strips(3)
    one = dataclasses.replace(both, xyz=both.xyz[both.strip == 0], strip=both.strip[both.strip == 0], strips=("1",))
    found = adjust_strips(one, settings=COARSE, control=surveyed(on_roofs(24, 3), 3))
    sigma = np.asarray(found.covariance.shared_sigma)
    assert found.converged and found.rounds[-1].planes == 0 and np.isnan(found.rounds[-1].rms_m)
    assert (np.abs(found.errors.position[0] - COMMON) < 3.5 * sigma).all() and (sigma < 0.025).all()
    assert [(d.one, d.other) for d in found.differences] == [("control", "1")]
    assert strips_verdict(found, None).findings[0].severity == "note"
    # What is left of the variances of gaps is the redundancy, and of each along its own three directions.
    told = surveyed_table(found)
    used = told[told.used]
    assert np.sum(used.sigma_m**2 / used.noise_m**2) == pytest.approx(len(used) - 3, abs=1e-3)
    np.testing.assert_allclose(np.linalg.norm(told[["dX_m", "dY_m", "dZ_m"]], axis=1), np.abs(told.gap_m))
    assert 0.6 < np.sqrt(np.mean(used.w**2)) < 1.4 and not told.w.isna().any()


@pytest.mark.slow
def test_on_level_ground_control_determines_heights_only():
    # No more than two points, which would not do for photographs.
    xy = np.array([[42.0, 50.0], [58.0, 50.0]])
    control = surveyed(np.column_stack([xy, level(*xy.T)]))
    found = adjust_strips(two_strips(1, level), settings=COARSE, control=control)
    sigma = np.asarray(found.covariance.shared_sigma).reshape(2, 3)
    assert found.converged
    np.testing.assert_allclose(found.errors.position[0, :2], 0.0, atol=2e-3)
    off = found.errors.position[:, 2] - [COMMON[2], COMMON[2] + SHIFT[2]]
    assert (np.abs(off) < 3.5 * sigma[:, 2]).all() and (sigma[:, 2] < 0.02).all()


@pytest.mark.slow
def test_points_close_together_do_not_count_the_same_returns_again():
    xy = np.stack(np.meshgrid(np.arange(46.0, 54.0, 0.5), np.arange(46.0, 54.0, 0.5)), axis=-1).reshape(-1, 2)
    exact = np.column_stack([xy, level(*xy.T)])
    found = adjust_strips(two_strips(1, level), settings=COARSE, control=surveyed(exact, sigma=1e-4))
    # About 4 returns on the square metre, of 20 mm each.
    sigma = np.asarray(found.covariance.shared_sigma).reshape(2, 3)[:, 2]
    assert (sigma > 0.7 * 0.02 / np.sqrt(2 * 4 * 10.0**2)).all()


@pytest.mark.slow
def test_standard_deviations_are_true():
    w = np.array([pulls(seed) for seed in range(20)])
    # Chi squared of 20 times six, which are correlated by the survey in pairs.
    assert 0.75 < np.sqrt(np.mean(w**2)) < 1.3 and np.mean(np.abs(w) < 1.96) > 0.88


def raised(rise: float = 0.25) -> tuple[Simulation, StripAdjustment, StripAdjustment]:
    """The flight of `strips`, all of it too high by `rise`: as overlaps see it, and with control besides."""
    flight = flown()
    some = flight.cloud.xyz[flight.cloud.classification == 2]
    xy = some[np.random.default_rng(2).choice(len(some), 60, replace=False), :2]
    control = surveyed(np.column_stack([xy, flight.terrain.height(xy)]), 7)
    cloud = dataclasses.replace(flight.cloud, xyz=flight.cloud.xyz + np.array([0.0, 0.0, rise]))
    position = np.asarray(flight.trajectory.position) + np.array([0.0, 0.0, rise])
    path = dataclasses.replace(flight.trajectory, position=position)
    settings = dataclasses.replace(SETTINGS, sigma_position_m=0.2, correlation_s=200.0)
    both = [adjust_strips(cloud, path, settings, PRIORS, control=given) for given in (None, control)]
    return flight, both[0], both[1]


@pytest.mark.slow
def test_with_a_trajectory_control_determines_the_height_of_a_flight():
    flight, alone, found = raised()
    assert found.converged and found.rounds[-1].control > 40

    def off(result: StripAdjustment) -> float:
        ground = np.flatnonzero(result.cloud.classification == 2)[::20]
        return float(np.mean(result.cloud.xyz[ground, 2] - flight.terrain.height(result.cloud.xyz[ground, :2])))

    assert abs(off(alone)) > 0.1 and abs(off(found)) < 0.015
    assert float(found.adjusted.sigma0) == pytest.approx(1.0, abs=0.12)
    assert fitted().rounds[-1].control == 0


def test_control_of_a_block_is_the_same_point_and_counts_once():
    block = flown_with_photographs().block
    tie = surveyed(np.zeros((1, 3)))._replace(ids=(block.points[0],))
    with pytest.raises(InputError, match="is also a point of the block, without being control there"):
        with_control(block, tie)
    given = surveyed(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    whole, number = with_control(block, given)
    assert [whole.points[k] for k in number] == ["K0", "K1"] and len(whole.control) == len(block.control) + 6
    again, same = with_control(whole, given)
    assert again.points == whole.points and len(again.control) == len(whole.control)
    np.testing.assert_array_equal(same, number)
    moved = given._replace(coordinates=given.coordinates + np.array([0.0, 0.0, 0.2]))
    with pytest.raises(InputError, match=r"K0 is also a point of the block, 0\.200 m away"):
        with_control(whole, moved)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda c: c._replace(sigma_m=np.full_like(c.sigma_m, np.nan)), "point K0 has no standard deviations"),
        (lambda c: c._replace(coordinates=c.coordinates + np.array([5000.0, 0, 0])), r"lie 49\d\d m from the strips"),
        (lambda c: c._replace(coordinates=c.coordinates + np.array([0, 0, 47.0])), r"are 4\d\.\d m above the strips"),
        (lambda c: c._replace(coordinates=c.coordinates * np.array([1, 1, np.nan])), "point K0 has no height"),
        (lambda c: c._replace(coordinates=0 * c.coordinates + [8.0, 20.0, 4.6]), "lies on a plane of a strip"),
    ],
)
def test_control_that_cannot_be(change, sentence):
    with pytest.raises((InputError, BlockError), match=sentence):
        adjust_strips(two_strips(1), settings=COARSE, control=change(surveyed(on_roofs(6, 1))))


@pytest.mark.slow
def test_photographs_strips_and_control_at_once():
    """The flight of `joint` and control on its ground."""
    flight = flown_with_photographs()
    some = flight.cloud.xyz[flight.cloud.classification == 2]
    xy = some[np.random.default_rng(2).choice(len(some), 40, replace=False), :2]
    control, given = surveyed(np.column_stack([xy, flight.terrain.height(xy)]), 7), photographs(flight)
    how = {"photographs": given, "control": control, "max_rounds": 2}
    found = adjust_strips(flight.cloud, flight.trajectory, SETTINGS, PRIORS, **how)
    assert found.rounds[-1].control > 30 and float(found.adjusted.sigma0) == pytest.approx(1.0, abs=0.1)
    for what in ("photographs", "control"):
        over = [d for d in found.differences if d.one == what]
        assert [d.other for d in over] == ["1", "2", "3"] and all(d.rms_m < 1.3 * d.noise_m for d in over)
    assert set(control.ids) <= set(found.adjusted.block.points)
    verdict = strips_verdict(found, Tables(found.adjusted, known=found.covariance))
    assert [f.value for f in verdict.findings if f.code == "surveyed_gap" and f.subject == "control"] < [0.1]


def written(control: SurveyedPoints, path, head: str = "") -> None:
    columns = {"point": control.ids, **{f"{x}_m": control.coordinates[:, k] for k, x in enumerate("XYZ")}}
    columns |= {f"sigma_{x}_m": control.sigma_m[:, k] for k, x in enumerate("XYZ")}
    table = pd.DataFrame({**columns, "role": np.where(control.check, "check", "control")})
    path.write_text(head + table.to_csv(index=False), encoding="utf-8")


@pytest.fixture(scope="module")
def on_the_map(tmp_path_factory):
    """Strips on a map."""
    folder, frame = tmp_path_factory.mktemp("map"), Frame("epsg", 32633, origin=(15.4, 47.1, 400.0))
    clouds.write_cloud(two_strips(3), folder / "cloud.laz", frame=frame)
    return folder, frame


@pytest.mark.slow
def test_control_from_a_file(on_the_map, tmp_path, monkeypatch, capsys):
    folder, frame = on_the_map
    control, out = surveyed(on_roofs(24, 3), 3), tmp_path / "out"
    control = control._replace(check=np.arange(24) % 4 == 3)
    on_map = control._replace(coordinates=frame.map.map(control.coordinates))
    written(on_map, folder / "control.csv", "# EPSG:32633\n")
    given = ("--control", folder / "control.csv", "--cell-m", "2", "--roughness-m", "0.04")
    code, output, errors = run(monkeypatch, capsys, "strips", folder / "cloud.laz", "--out", out, *given)
    assert code == 0, errors + output
    assert "gaps of strips" in output and " of control, " in output
    moved = clouds.read_cloud(folder / "cloud.laz").xyz - clouds.read_cloud(out / "cloud.laz").xyz
    strip = clouds.read_cloud(out / "cloud.laz").strip
    for k, shift in enumerate((COMMON, COMMON + SHIFT)):
        np.testing.assert_allclose(moved[strip == k].mean(axis=0), shift, atol=0.05)
    strips = pd.read_csv(out / "strips.csv")
    assert set(strips.one) == {"1", "control", "check points"}
    summary = json.loads((out / "summary.json").read_text())
    assert summary["control"]["rms_m"] < 0.03 < summary["control"]["rms_before_m"] and "check_points" in summary
    page = (out / "report.html").read_text(encoding="utf-8")
    assert re.search("[Cc]heck points: 0.0", page) and "control.csv" in page


@pytest.mark.parametrize(
    ("head", "row", "sentence"),
    [
        ("# EPSG:25833\n", "K1,500000,5000000,3,0.02,0.02,0.02", "is in EPSG:25833"),
        ("", "K1,1,2,,0.02,0.02,0.02", "control.csv, row 2: point K1 has no height"),
        ("", "K1,1,2,3,,,", "control.csv, row 2: point K1 has no standard deviations"),
        ("", "K1,1,2,3,0.02,0.02,0.02\nK1,1,2,4,0.02,0.02,0.02", "is also in control.csv, row 2"),
        ("", "K1,1,2,3,0.02,0.02,0.02", "m from the strips"),
    ],
)
def test_files_of_control_that_cannot_be(on_the_map, tmp_path, monkeypatch, capsys, head, row, sentence):
    folder, _ = on_the_map
    columns = "point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m\n"
    (tmp_path / "control.csv").write_text(head + columns + row + "\n", encoding="utf-8")
    given = (folder / "cloud.laz", "--out", tmp_path / "out", "--control", tmp_path / "control.csv")
    code, _, errors = run(monkeypatch, capsys, "strips", *given)
    assert code == 2 and sentence in " ".join(errors.split()) and not (tmp_path / "out").exists()
