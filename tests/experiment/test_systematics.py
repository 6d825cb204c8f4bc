"""Systematic errors are estimated if modelled, and otherwise propagate as first-order theory predicts."""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from jaxphoto.experiment import Run, effects, load_experiment, named, recovered, run_experiment

FOLDER = Path(__file__).parents[2] / "experiments" / "systematics"
WHOLE = load_experiment(FOLDER)
C_MM, SPEED, HEIGHTS = 34.25, 60.0, (1000.0, 1300.0)
IGNORED = ["none", *(name for name in WHOLE.variants if name.endswith("ignored"))]
# What is free is compiled for itself: two of them, and all others in the last test of what is recovered.
FREE = ["time offset, free", "datum offset, free"]


def part(names, tables) -> Run:
    """One layout of some variants of the experiment, with fewer tie points."""
    variants = {
        name: dataclasses.replace(WHOLE.variants[name], recipe={**WHOLE.variants[name].recipe, "points": {"ties": 60}})
        for name in names
    }
    run = run_experiment(dataclasses.replace(WHOLE, variants=variants, tables=tables), FOLDER, layouts=1)
    assert not run.failures
    return run


def table(run: Run, name: str) -> pd.DataFrame:
    cells = run.cells[run.cells["table"] == name]
    return cells.pivot_table(index=["row", "layout"], columns="column", values="value")


@pytest.fixture(scope="module")
def effect() -> pd.DataFrame:
    found = table(part(IGNORED, {"effect": effects(named(IGNORED), "none")}), "effect")
    return found.droplevel("layout").rename(index=lambda row: row.removesuffix(", ignored"))


def check_recovered(found: pd.DataFrame) -> None:
    # The largest of n normal deviates in size is below this in 99 of 100 sets: 3.0 for 4 of them, 3.8 for 68.
    assert found["ratio"].max() < stats.norm.isf(0.01 / len(found) / 2)
    # What is found is no news unless zero would not have done.
    assert (found["truth"].abs() / found["sigma"]).min() > 3.5
    ratio = (found["estimate"] - found["truth"]).abs() / found["sigma"]
    np.testing.assert_allclose(found["ratio"], ratio, rtol=1e-12)


@pytest.mark.slow
def test_errors_are_recovered_where_their_parameters_are_free():
    axes = {f"strips[block].shift_{axis}_m": f"datum_offset_{axis}_m" for axis in "XYZ"}
    found = table(part(FREE, {"recovered": recovered(named(FREE), axes)}), "recovered")
    assert len(found) == 1 + 3
    check_recovered(found)
    truth = found["truth"].droplevel("layout")
    assert truth["time offset, free/mounts[default].time_offset_s"] == 0.02
    assert truth.filter(like="datum offset").tolist() == [-0.6, 0.5, 0.9]


@pytest.mark.slow
def test_every_error_that_can_be_simulated_is_recovered():
    run = run_experiment(WHOLE, FOLDER, layouts=2)
    assert not run.failures
    found = table(run, "recovered")
    components = found.index.get_level_values("row").str.split("/").str[0].value_counts() // 2
    assert components.to_dict() == {
        "lever arm": 3, "boresight": 3, "time offset": 1, "shift": 12, "drift": 12, "datum offset": 3,
    }  # fmt: skip
    check_recovered(found)
    # Components of one adjustment are correlated, so this is wider than the chi-square of 68.
    assert 0.6 < np.sqrt((found["ratio"] ** 2).mean()) < 1.4


def within(change: float, displacement_m: float) -> None:
    """`change` (mm) is c / H a metre of displacement along the camera's axis, with H somewhere between those flown."""
    least, most = sorted(C_MM / height * displacement_m for height in HEIGHTS)
    assert least < change < most


def test_stations_displaced_with_the_camera_go_into_the_interior_orientation(effect):
    # The camera turns with the aircraft, and the errors with it: opposite and crossing strips do not tell them apart.
    # A station v tau behind, or an arm forward, shifts x_p; an arm to the right y_p (camera y is left); one up c.
    within(effect.loc["time offset", "change_xp_mm"], -SPEED * 0.02)
    within(effect.loc["lever arm", "change_xp_mm"], -0.9)
    within(effect.loc["lever arm", "change_yp_mm"], -0.6)
    within(effect.loc["lever arm", "change_c_mm"], 1.3)
    assert abs(effect.loc["time offset", "change_yp_mm"]) < 0.003
    assert abs(effect.loc["time offset", "change_c_mm"]) < 0.01


def test_stations_displaced_in_the_object_frame_do_not_go_into_the_principal_point(effect):
    # (-0.6, 0.5) m would be 0.02 mm in one strip; in the opposite one it is the other way round.
    assert abs(effect.loc["datum offset", "change_xp_mm"]) < 0.003
    assert abs(effect.loc["datum offset", "change_yp_mm"]) < 0.003
    # It strains the block against its control instead; and height, which has no opposite, goes into c.
    assert effect.loc["datum offset", "rmse_dX_m"] > 2 * effect.loc["none", "rmse_dX_m"]
    assert effect.loc["datum offset", "change_c_mm"] > 0.01


def test_what_is_ignored_shows_in_sigma_naught(effect):
    assert set(effect.index) == {"none", "lever arm", "boresight", "time offset", "shift", "drift", "datum offset"}
    assert (effect.loc["none", [c for c in effect.columns if c.startswith("change_")]] == 0).all()
    assert effect.loc["none", "sigma0"] == pytest.approx(1, abs=0.1)
    assert (effect["sigma0"].drop("none") > effect.loc["none", "sigma0"] + 0.05).all()
