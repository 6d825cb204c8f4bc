"""A camera that changes with its temperature: recovered, tested, in words, and from files."""

import dataclasses
import functools

import numpy as np
import pytest

from jaxphoto import FREE, BlockError, InputError, Outcome, RankError, Tables, adjust, covariance
from jaxphoto.block import Temperatures, exposures
from jaxphoto.camera import ThermalRates
from jaxphoto.camera.conditions import Conditions
from jaxphoto.io import read_block, write_block
from jaxphoto.io.conditions import write_conditions
from jaxphoto.report.verdict import drift_finding
from jaxphoto.statistics import camera_drifts
from jaxphoto.unknowns import FIXED
from jaxphoto.variants import some_images
from tests.camera.test_camera_rates import TRUE, changing_block

PER_HOUR = 4.0
"""Kelvins in an hour, so that the rates for a kelvin are a quarter of those in an hour."""


def thermal(free=FREE):
    """The camera that changes in an hour, whose block knows temperatures and no times."""
    block = changing_block()
    hours = block.flight_time / 3600
    of = lambda value: {"thermal_rates": {"one": ThermalRates(*[value] * 4)}}  # noqa: E731
    start = dataclasses.replace(block.start.unknowns, more=of(np.zeros(())))
    return dataclasses.replace(
        block,
        flight_time=None,
        temperatures=Temperatures(11.0 + PER_HOUR * hours, 11.0),
        start=dataclasses.replace(block.start, unknowns=start),
        priors=dataclasses.replace(block.priors, more=of(free)),
    )


@functools.cache
def found():
    adjusted = adjust(thermal())
    assert adjusted.outcome is Outcome.CONVERGED
    return adjusted


def test_the_rates_are_recovered():
    own, of = found().unknowns.more["thermal_rates"]["one"], covariance(found())
    sigma = dict(zip(found().structure.labels, np.asarray(of.shared_sigma), strict=True))
    for field, (label,) in ThermalRates.names.items():
        true, known = getattr(TRUE, field) / PER_HOUR, sigma[f"thermal_rates[one].{label}"]
        assert abs(float(getattr(own, field)) - true) < 3 * known < 0.7 * abs(true), field
    assert 0.9 < found().sigma0 < 1.1


def test_it_is_tested_and_told_from_the_coldest_exposure_to_the_warmest():
    (drift,) = camera_drifts(found(), covariance(found()))
    assert (drift.rates, drift.span) == (ThermalRates, pytest.approx(PER_HOUR))
    assert drift.change.rejected
    assert drift_finding(drift).text.startswith("camera one changed with its temperature over 4 K (p ")
    still = drift._replace(change=drift.change._replace(p_value=0.3, detectable=np.array([4e-3, 3e-3, 2e-3, 1e-6])))
    assert (drift_finding(still).code, drift_finding(still).value) == ("no_drift", 0.3)
    table = Tables(found()).camera_drift
    assert list(table.along) == ["temperature_K"] * 4 and list(table.unit) == ["mm", "mm", "mm", ""]


def test_one_temperature_shows_nothing():
    still = dataclasses.replace(thermal(), temperatures=Temperatures(np.full(10, 11.0), 20.0))
    with pytest.raises(RankError, match=r"thermal_rates\[one\]\.c_rate is free, but all images .* one temperature"):
        adjust(still)


def test_it_comes_back_from_a_block_folder(tmp_path):
    write_block(thermal(), tmp_path / "block")
    again = read_block(tmp_path / "block")
    assert again.priors.more == thermal().priors.more
    np.testing.assert_array_equal(again.temperatures.celsius, thermal().temperatures.celsius)
    assert again.temperatures.reference_c == 11.0
    toml = tmp_path / "block/block.toml"
    toml.write_text(toml.read_text().replace("reference_temperature_c = 11.0", ""))
    mean = thermal().temperatures.celsius.mean()
    np.testing.assert_allclose(read_block(tmp_path / "block").temperatures.reference_c, mean, rtol=1e-14)


def test_part_of_a_block_keeps_the_reference():
    part = some_images(thermal(), np.arange(10) < 6)
    np.testing.assert_array_equal(exposures(part).temperature, exposures(thermal()).temperature[:6])


def in_table(folder, change) -> None:
    """images.csv with each row (a dict) changed."""
    path = folder / "images.csv"
    head, *lines = (line.split(",") for line in path.read_text().splitlines())
    rows = [change(dict(zip(head, line, strict=True)), k) for k, line in enumerate(lines)]
    path.write_text("\n".join([",".join(rows[0]), *(",".join(row.values()) for row in rows)]) + "\n")


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        (
            "",
            "row 4: image i2 has no temperature_c, but in .*thermal_rates.* its camera one drifts; add the temperature",
        ),
        ("293.15", r"row 4: temperature_c = 293\.15 is not a plausible camera temperature; give it in degrees Celsius"),
    ],
)
def test_what_is_missing_or_wrong_is_named(tmp_path, cell, words):
    write_block(thermal(), tmp_path / "block")
    in_table(tmp_path / "block", lambda row, k: row | {"temperature_c": cell} if k == 2 else row)
    with pytest.raises((BlockError, InputError), match=words):
        read_block(tmp_path / "block")


def test_photographs_say_their_temperatures(tmp_path):
    """conditions.csv does where images.csv does not, the lens before the air; not where one photograph is missing."""
    folder, block = tmp_path / "block", thermal()
    write_block(block, folder)
    in_table(folder, lambda row, k: {name: cell for name, cell in row.items() if name != "temperature_c"})
    celsius = block.temperatures.celsius
    said = [
        Conditions(name, f"{name}.jpg", "0" * 64, temperature_c=3.0, lens_temperature_c=float(t))
        for name, t in zip(block.images, celsius, strict=True)
    ]
    write_conditions(said, folder, block.images)
    np.testing.assert_array_equal(read_block(folder).temperatures.celsius, celsius)
    write_conditions([said[0]._replace(lens_temperature_c=None), *said[1:]], folder, block.images)
    np.testing.assert_array_equal(read_block(folder).temperatures.celsius, np.full(10, 3.0))
    write_conditions(said[1:], folder, block.images)
    with pytest.raises(BlockError, match="image i0 has no temperature_c"):
        read_block(folder)


def test_a_temperature_that_is_not_known_stays_so(tmp_path):
    write_block(thermal(FIXED), tmp_path / "block")
    in_table(tmp_path / "block", lambda row, k: row | {"temperature_c": ""} if k == 2 else row)
    block = read_block(tmp_path / "block")
    assert np.flatnonzero(np.isnan(block.temperatures.celsius)).tolist() == [2]
    assert np.isfinite(block.temperatures.above).all() and float(block.temperatures.above[2]) == 0
    write_block(block, tmp_path / "again")
    np.testing.assert_array_equal(read_block(tmp_path / "again").temperatures.celsius, block.temperatures.celsius)


def test_rates_that_are_held_need_no_temperature(tmp_path):
    write_block(thermal(FIXED), tmp_path / "block")
    in_table(tmp_path / "block", lambda row, k: row | {"temperature_c": ""})
    assert read_block(tmp_path / "block").temperatures is None
