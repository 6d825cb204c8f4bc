"""Paper 002: its printed numbers, the map of R0 between its sets, Table 7, and the simulated twins."""

import importlib.util
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from jaxphoto.camera import get_parameter, rebalance
from jaxphoto.experiment import compare, load_experiment, read_published, run_experiment, simulated
from jaxphoto.procedures.adjust import adjust
from jaxphoto.report import Tables
from jaxphoto.stability import analyse, bundle_offsets

FOLDER = Path(__file__).resolve().parents[2] / "experiments" / "002"
PARAMETERS = {"xp": "xp_mm", "yp": "yp_mm", "c": "c_mm", "K1": "k1_mm-2", "K2": "k2_mm-4", "K3": "k3_mm-6"}


@pytest.fixture(scope="module")
def paper():
    """experiment.py as a module."""
    spec = importlib.util.spec_from_file_location("paper_002", FOLDER / "experiment.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_is_called_published_is_what_the_paper_prints(data_dir):
    tables = data_dir.parent / "papers" / "tables"
    if not tables.is_dir():
        pytest.skip(f"no papers' tables in {tables}")
    published = read_published(FOLDER).set_index(["table", "row", "column"])["published"]
    checked = 0
    for path in tables.glob("paper_002_table[3-6]*.csv"):
        name = path.stem.removeprefix("paper_002_")
        for line in pd.read_csv(path).itertuples():
            row, column = f"R0 = {line.R0_mm}", PARAMETERS[line.parameter]
            assert published[name, row, column] == line.value
            assert published[name, row, f"sigma_{column}"] == line.sigma
            checked += 2
    for line in pd.read_csv(tables / "paper_002_table7_rmse_offset.csv").itertuples():
        for column in ("rmse_offset_R0_0_mm", "rmse_offset_R0_3_mm"):
            assert published["table7_rmse_offset", f"{line.iop1}/{line.iop2}", column] == getattr(line, column)
            checked += 1
    for line in pd.read_csv(tables / "paper_002_table2_sigma0.csv").itertuples():
        for column in ("sigma0_R0_0_mm", "sigma0_R0_3_mm"):
            assert published["table2_sigma0", line.dataset, column] == getattr(line, column)
            checked += 1
    assert checked == len(published)


@pytest.mark.parametrize("dataset", ["target1", "target2", "uav"])
def test_the_two_printed_sets_are_one_camera_by_the_exact_map(paper, dataset):
    """c and the radial coefficients, within three printed standard deviations; and the map itself to rounding."""
    published = read_published(FOLDER).set_index(["table", "row", "column"])["published"]
    for here, there in ((0, 3), (3, 0)):
        mapped = rebalance(paper.printed(dataset, there), float(here))
        for name, column in paper.IOPS.items():
            if name in ("xp_mm", "yp_mm"):
                continue
            key = paper.TABLES[dataset], f"R0 = {here}"
            off = float(get_parameter(mapped, name)) - published[(*key, column)]
            assert abs(off) < 3 * published[(*key, f"sigma_{column}")], (name, here)
    again = rebalance(rebalance(paper.printed(dataset, 0), 3.0), 0.0)
    assert float(bundle_offsets(paper.printed(dataset, 0), again, paper.GRID).rmse_mm) < 1e-12


def test_the_indoor_sets_are_two_solutions(paper):
    """Two cameras whose principal points are 0.11 mm apart: no R0 makes them one."""
    mapped = rebalance(paper.printed("indoor", 3), 0.0)
    assert float(bundle_offsets(paper.printed("indoor", 0), mapped, paper.GRID).rmse_mm) > 0.005


def test_table_7_of_the_sets_without_the_indoor_one(paper):
    """0.69, 1.02 and 0.88 um by ROT over 15 x 11 points; the paper prints 0.68, 1.14 and 0.92."""
    published = read_published(FOLDER).set_index(["table", "row", "column"])["published"]
    ours = {("target1", "target2"): 0.695, ("target1", "uav"): 1.027, ("target2", "uav"): 0.885}
    for (one, other), rmse_um in ours.items():
        found = analyse(paper.printed(one, 0), paper.printed(other, 0), paper.GRID)["rot"]
        assert 1e3 * float(found.offsets.rmse_mm) == pytest.approx(rmse_um, abs=0.001)
        printed = published["table7_rmse_offset", f"{one}/{other}", "rmse_offset_R0_0_mm"]
        assert float(found.offsets.rmse_mm) == pytest.approx(printed, rel=0.15)
        assert found.similar(paper.SENSOR.pixel_mm)


def off_in_sigmas(tables, simulation):
    """(estimate - truth) / sigma of every IOP, and the sigmas by name."""
    truth = simulation.truth.interior["gopro"]
    off = [(s.value - float(get_parameter(truth, s.parameter))) / s.sigma for s in tables.significance]
    return np.array(off), {s.parameter: s.sigma for s in tables.significance}


@pytest.mark.slow
def test_the_target_twin_finds_its_truth_with_sigmas_like_those_printed(paper):
    simulation = simulated(load_experiment(FOLDER), FOLDER, "target1")
    assert (len(simulation.block.images), len(simulation.block.points)) == (18, 35)
    tables = Tables(adjust(simulation.block))
    off, sigmas = off_in_sigmas(tables, simulation)
    assert len(off) == 6
    assert np.abs(off).max() < 3
    published = read_published(FOLDER).set_index(["table", "row", "column"])["published"]
    for name, column in paper.IOPS.items():
        ratio = sigmas[name] / published["table3_iops_target1", "R0 = 0", f"sigma_{column}"]
        assert 0.4 < ratio < 2.5, (name, ratio)
    assert np.sqrt(paper.covariance(tables, 0)[0, 0]) == pytest.approx(sigmas["c_mm"], rel=1e-6)


@pytest.fixture(scope="module")
def all_twins():
    """The whole experiment: 25 images of 14,047 points and 38 images of 157,321 points among its twins."""
    experiment = load_experiment(FOLDER)
    run = run_experiment(experiment, FOLDER)
    assert not run.failures
    return experiment, run


@pytest.mark.slow
def test_every_promise_is_kept_over_all_twins(all_twins):
    experiment, run = all_twins
    counts = {name: (len(t.adjusted.block.images), len(t.adjusted.block.points)) for name, t in run.first.items()}
    assert counts == {"target1": (18, 35), "target2": (18, 35), "indoor": (25, 14047), "uav": (38, 157321)}
    for name in ("target1", "target2"):
        assert np.abs(off_in_sigmas(run.first[name], simulated(experiment, FOLDER, name))[0]).max() < 3
    table = compare(run, FOLDER)
    bad = table[table["within"] == "no"]
    assert bad.empty, bad[["table", "row", "column", "published", "ours"]].to_string()
    assert (table["within"] != "").sum() == 27


@pytest.mark.slow
@pytest.mark.parametrize("dataset", ["indoor", "uav"])
def test_the_feature_twins_find_their_truth(all_twins, dataset):
    experiment, run = all_twins
    assert np.abs(off_in_sigmas(run.first[dataset], simulated(experiment, FOLDER, dataset))[0]).max() < 3
