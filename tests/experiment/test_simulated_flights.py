"""Studies of many simulated flights: errors, coverage, resumption, workers."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from jaxphoto import InputError, adjust, covariance, read_recipe
from jaxphoto.experiment.simulated_flights import SimulatedFlights, coverage_table, simulate_flights
from jaxphoto.simulation import simulate
from jaxphoto.workers import connected
from tests.experiment.test_runner import RECIPE


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    file = tmp_path_factory.mktemp("recipe") / "small.toml"
    file.write_text(RECIPE)
    return read_recipe(file)


@pytest.fixture(scope="module")
def whole(recipe, tmp_path_factory):
    directory = tmp_path_factory.mktemp("flights") / "run"
    return directory, simulate_flights(recipe, 10, 3, directory)


def test_rows_are_those_of_each_flight_simulated_and_adjusted_alone(recipe, whole):
    found = pd.read_parquet(whole[0] / "draws.parquet")
    assert sorted(set(found["flight"])) == list(range(3, 13))
    simulation = simulate(recipe, 5)
    adjusted = adjust(simulation.block)
    row = found[(found["flight"] == 5) & (found["parameter"] == "interior[small].c_mm")].iloc[0]
    c, label = adjusted.unknowns.interior["small"].c, "interior[small].c_mm"
    assert row["estimate"] == pytest.approx(float(c), abs=1e-9)
    assert (row["truth"], row["error"]) == pytest.approx((34.25, float(c) - 34.25), abs=1e-9)
    sigma = np.asarray(covariance(adjusted).shared_sigma)[adjusted.structure.labels.index(label)]
    assert row["sigma"] == pytest.approx(sigma, rel=1e-6)


def test_the_table_counts_covered_errors():
    rng = np.random.default_rng(1)
    sigma = np.exp(rng.normal(size=4000))
    found = pd.DataFrame(
        {"problem": "", "parameter": "a", "error": 2 * sigma * rng.normal(size=4000), "sigma": sigma, "unit": "mm"}
    ).assign(ratio=lambda t: t["error"] / t["sigma"])
    (row,) = coverage_table(found).to_dict("records")
    # Sigmas are half the true ones: P(|x| < 0.98) = 67.3 %.
    assert row["inside_percent"] == pytest.approx(67.3, abs=4 * row["sigma_inside_percent"])
    assert row["sigma_inside_percent"] == pytest.approx(100 * np.sqrt(0.673 * 0.327 / 4000), rel=0.02)
    assert row["rms_ratio"] == pytest.approx(2.0, rel=0.05)


def test_a_stopped_study_continues_and_workers_give_the_same(recipe, whole, tmp_path):
    class Stop(Exception):
        pass

    def stop(done: int) -> None:
        raise Stop

    with pytest.raises(Stop):
        simulate_flights(recipe, 10, 3, tmp_path / "run", stop)
    assert len(set(pd.read_parquet(tmp_path / "run" / "parts")["flight"])) == 4
    pytest.importorskip("distributed", reason="distributed is not installed (extra cluster)")
    with connected(1, None) as client:
        simulate_flights(recipe, 10, 3, tmp_path / "run", client=client)
    for name in ("draws.parquet", "summary.csv"):
        assert (tmp_path / "run" / name).read_bytes() == (whole[0] / name).read_bytes()


def test_flights_that_cannot_be_adjusted_are_listed(recipe, tmp_path):
    # No control, no stations: the datum is undetermined.
    free = dataclasses.replace(recipe, targets=(), stated=dataclasses.replace(recipe.stated, station_m=None))
    found = SimulatedFlights(free).compute(range(2))
    assert found["problem"].str.len().all() and found["estimate"].isna().all()
    with pytest.raises(InputError, match="no flight could be adjusted"):
        simulate_flights(free, 2, 0, tmp_path / "run")
