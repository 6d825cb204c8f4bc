"""Lidar heights in place of signalised control: paper 000's future work, one flight of it."""

import importlib.util
from pathlib import Path

import pytest

STUDY = Path(__file__).resolve().parents[2] / "experiments" / "lidar_only" / "study.py"


@pytest.mark.slow
def test_lidar_heights_alone_recover_the_interior_orientation():
    spec = importlib.util.spec_from_file_location("lidar_only_study", STUDY)
    study = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(study)
    table = study.layout(11).set_index(["experiment", "quantity"])["value"]
    for experiment in ("third", "fourth"):
        own = table[experiment]
        assert abs(own["error_over_sigma_c_mm"]) < 3
        assert (own[own.index.str.startswith("error_over_sigma")].abs() < 3.5).all()
        assert own["control_heights"] > 0.6 * own["tie_points"]
    beside = study.beside_000(table.reset_index())
    assert set(beside["experiment"]) == {"third", "fourth"}
    assert (beside["quantity"].str.startswith("sigma").sum(), beside["quantity"].str.contains("/").sum()) == (10, 30)
