"""Rounded observations and impossible standard deviations in the verdict, and no false alarms."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxphoto import adjust
from jaxphoto.block import Frame
from jaxphoto.observations import correlated
from jaxphoto.simulation import remeasure
from jaxphoto.statistics import covariance, redundancy_numbers
from jaxphoto.statistics.input_precision import rounded_columns, small_sigmas
from tests.blocks import adjusted, simulated


def rounded_to(rows, step, axis):
    """The rows, with the values along one axis rounded."""
    values = np.array(rows.observation)
    at = np.asarray(rows.axis) == axis if values.ndim == 1 else (slice(None), axis)
    values[at] = np.round(values[at] / step) * step
    return rows.with_observation(values)


def columns(block):
    result = adjust(block)
    return {(c.table, c.column): c for c in rounded_columns(result, redundancy_numbers(result, covariance(result)))}


@pytest.mark.parametrize("name", ["cross", "mount", "two_cameras", "surfaces", "inner", "minimal", "fixed_control"])
def test_blocks_with_all_digits_have_no_finding(name):
    block = simulated(name).block
    assert not columns(block) and not small_sigmas(adjusted(name))


@pytest.mark.parametrize(
    ("field", "axis", "unit", "column"),
    [
        ("stations", 2, 1.0, "Z_m"), ("stations", 0, 0.3048, "X_m"), ("control", 1, 0.5, "Y_m"),
        ("attitudes", 2, np.pi / 180, "yaw_deg"), ("image_points", 1, 0.008, "row_px"),
        ("image_points", 0, 0.01, "x_mm"),
    ],
)  # fmt: skip
def test_every_kind_of_rounded_observations_is_named_with_column_and_step(field, axis, unit, column):
    block = simulated("mount").block
    rows = getattr(block, field)
    sigma = float(np.median(rows.sigma))
    # As if the digits were there.
    fine = dataclasses.replace(rows, sigma=np.full(np.shape(rows.sigma), min(sigma, unit / 50)))
    found = columns(dataclasses.replace(block, **{field: rounded_to(fine, unit, axis)}))
    assert list(found) == [(rows.group, column)]
    (one,) = found.values()
    scale = {"deg": np.pi / 180, "px": 0.008}.get(one.unit, 1.0)
    assert one.step * scale == pytest.approx(unit, rel=1e-9)


def test_rounding_is_the_first_cause_of_what_it_does():
    block = simulated("cross").block
    stations = dataclasses.replace(block.stations, sigma=np.full(len(block.stations), 0.02))
    exact = remeasure_stations(block, stations)
    findings = adjust(exact).verdict().findings
    assert not any(f.code == "rounded" for f in findings) and findings[0].severity == "note"
    findings = adjust(dataclasses.replace(exact, stations=rounded_to(exact.stations, 5.0, 2))).verdict().findings
    assert findings[0].code == "rounded" and findings[0].severity == findings[1].severity != "note"
    assert findings[1].code != "rounded"


def remeasure_stations(block, stations):
    """Stations around their truth with their standard deviations."""
    true = np.asarray(simulated("cross").truth.exterior.position)[stations.who, stations.axis]
    noise = np.random.default_rng(4).normal(0.0, np.asarray(stations.sigma))
    return dataclasses.replace(block, stations=dataclasses.replace(stations, value=true + noise))


def test_an_honest_standard_deviation_is_a_note_only():
    block = simulated("cross").block
    # A sigma of half a pixel and more includes the error of whole pixels, 0.29.
    rows = dataclasses.replace(block.image_points, sigma=np.full(block.image_points.sigma.shape, 0.005))
    whole = rounded_to(rounded_to(rows, 0.008, 0), 0.008, 1)
    found = [
        f for f in adjust(dataclasses.replace(block, image_points=whole)).verdict().findings if f.code == "rounded"
    ]
    assert [f.severity for f in found] == ["note", "note"]


def test_exact_multiples_that_the_images_confirm_are_not_rounded():
    """Points of a board are multiples of its pitch: the residuals are smaller than rounding would cause."""
    block = simulated("cross").block
    truth = np.array(simulated("cross").truth.points)
    board = np.round(truth / 20) * 20
    unknowns = dataclasses.replace(simulated("cross").truth, points=board)
    measured = remeasure(block, unknowns, jax.random.key(1))
    control = measured.control
    exact = dataclasses.replace(measured, control=dataclasses.replace(control, value=board[control.who, control.axis]))
    assert not columns(exact)


def test_map_coordinates_are_rounded_in_the_system_of_the_files():
    block = simulated("cross").block
    on_map = dataclasses.replace(block, frame=Frame("epsg", 32633, None, origin=(13.2, 55.7, 0.0)))
    z = np.asarray(block.stations.axis) == 2
    xyz = np.asarray(block.stations.value).reshape(-1, 3)
    files = on_map.frame.map.map(xyz)
    back = on_map.frame.map.local(np.column_stack([files[:, :2], np.round(files[:, 2])]))
    stations = dataclasses.replace(block.stations, value=back.ravel(), sigma=np.where(z, 0.08, block.stations.sigma))
    found = columns(dataclasses.replace(on_map, stations=stations))
    assert [(key, c.step) for key, c in found.items()] == [(("stations", "Z_m"), 1.0)]


@pytest.mark.parametrize(
    ("field", "sigma", "unit"),
    [("stations", 1e-13, "m"), ("control", 1e-6, "m"), ("image_points", 1e-6, "px"), ("attitudes", 1e-8, "deg")],
)
def test_standard_deviations_that_no_instrument_reaches_are_named(field, sigma, unit):
    result = adjusted("mount")
    rows = getattr(result.block, field)
    sigmas = np.array(rows.sigma)
    sigmas[:4] = sigma
    changed = dataclasses.replace(result.block, **{field: dataclasses.replace(rows, sigma=sigmas)})
    (found,) = small_sigmas(dataclasses.replace(result, block=changed))
    assert (found.table, found.unit, found.n) == (rows.group, unit, sigmas[:4].size)
    assert found.sigma < found.limit


def test_correlated_stations_are_checked_too():
    block = simulated("cross").block
    stations = rounded_to(block.stations, 1.0, 2)
    sets = np.arange(len(stations)).reshape(-1, 3)
    covariances = np.broadcast_to(0.08**2 * (np.eye(3) + 0.2), (len(sets), 3, 3))
    rows = correlated(stations, sets, covariances)
    empty = stations.take(np.zeros(0, int))
    found = columns(dataclasses.replace(block, stations=empty, more=(rows,)))
    assert ("correlated_stations", "Z_m") in found
