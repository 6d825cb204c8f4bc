"""A shift of the whole flight beside biases of its strips: both are recovered, and named."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxphoto import FIXED, FREE, Outcome, Weighted, adjust, covariance
from jaxphoto.georeferencing import FlightBias, StripBias
from jaxphoto.io import read_block, write_block
from jaxphoto.parameters import AbstractParameters
from jaxphoto.variants import strips, without_stations
from tests.blocks import simulated

SHIFT, DRIFT = np.array([14.0, -9.0, 7.0]), np.array([1.1, 0.6, -0.8])
# Of the strips' shift (m) and drift (m/s).
SIGMA = 0.02, 0.003


class HourBias(AbstractParameters):
    """A shift of each hour of the flight."""

    kind = "hours"
    owner = "hour"
    names = {"shift": ("shift_X_m", "shift_Y_m", "shift_Z_m")}  # noqa: RUF012

    shift: np.ndarray


def test_a_position_is_shifted_and_drifts():
    class Exposure:
        in_flight = 4.0

    bias = FlightBias(np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.0, -0.25]))
    np.testing.assert_array_equal(bias.station(np.array([10.0, 10.0, 10.0]), Exposure), [13.0, 12.0, 12.0])
    assert bias.labels("")[0] == "flight_bias.shift_X_m"
    assert bias.labels("")[-1] == "flight_bias.drift_Z_m_per_s"


@pytest.fixture(scope="module")
def flight():
    """Two strips with biases known to centimetres, and a bias of the flight that only control can tell from them."""
    block, truth = simulated("strips")
    rng, stations = np.random.default_rng(4), block.stations
    axis, time = np.asarray(stations.axis), np.asarray(block.image_time)[stations.who]
    flown = dataclasses.replace(stations, value=np.asarray(stations.value) + SHIFT[axis] + DRIFT[axis] * time)
    known = {
        name: StripBias(
            *(
                Weighted(v + sigma * rng.normal(size=3), sigma)
                for v, sigma in zip((b.shift, b.drift), SIGMA, strict=True)
            )
        )
        for name, b in truth.strips.items()
    }
    start, zero = block.start, np.zeros(3)
    # A calibrated camera: its c and principal point would take up most of a shift.
    held = jax.tree.map(lambda _: FIXED, truth.interior)
    unknowns = dataclasses.replace(
        start.unknowns, interior=truth.interior, more={"flight_bias": {"": FlightBias(zero, zero)}}
    )
    more = {"flight_bias": {"": FlightBias(FREE, FREE)}}
    return dataclasses.replace(
        block,
        stations=flown,
        start=dataclasses.replace(start, unknowns=unknowns),
        priors=dataclasses.replace(block.priors, interior=held, strips=known, more=more),
    ), truth


def test_bias_of_a_flight_and_weighted_biases_of_its_strips_are_recovered(flight):
    block, truth = flight
    found = adjust(block)
    assert found.outcome is Outcome.CONVERGED
    sigma = dict(zip(found.structure.labels, np.asarray(covariance(found).shared_sigma), strict=True))
    true = {"flight_bias": (FlightBias(SHIFT, DRIFT), found.unknowns.more["flight_bias"][""])}
    true |= {f"strips[{name}]": (bias, found.unknowns.strips[name]) for name, bias in truth.strips.items()}
    for place, (want, got) in true.items():
        for field, unit in (("shift", "m"), ("drift", "m_per_s")):
            at = np.array([sigma[f"{place}.{field}_{axis}_{unit}"] for axis in "XYZ"])
            off = np.asarray(getattr(got, field)) - getattr(want, field)
            assert np.all(np.abs(off) < 3 * at), (place, field)
            # Far less than what was to be found, so that nothing else passes.
            assert np.all(at < 0.1 * np.linalg.norm(SHIFT if field == "shift" else DRIFT))


def test_it_comes_back_from_a_block_folder(flight, tmp_path):
    block, _ = flight
    write_block(block, tmp_path / "block")
    again = read_block(tmp_path / "block")
    assert again.start.unknowns.more["flight_bias"].keys() == {""}
    assert again.priors.more == block.priors.more
    np.testing.assert_array_equal(again.stations.value, block.stations.value)


def test_without_stations_nothing_sees_it(flight):
    block, _ = flight
    held = without_stations(block).priors.more["flight_bias"][""]
    assert (held.shift, held.drift) == (FIXED, FIXED)


def test_a_part_of_the_block_keeps_what_is_its_own(flight):
    block, _ = flight
    part = dataclasses.replace(block, partitions={"hour": ("8",) * 5 + ("9",) * 5})
    hours = {"hours": {name: HourBias(np.zeros(3)) for name in "89"}}
    start = part.start.unknowns
    start = dataclasses.replace(start, more=start.more | hours)
    part = strips(dataclasses.replace(part, start=dataclasses.replace(part.start, unknowns=start)), ["b"])
    assert {kind: list(owners) for kind, owners in part.start.unknowns.more.items()} == {
        "flight_bias": [""],
        "hours": ["9"],
    }
    assert part.partitions == {"hour": ("9",) * 5}
