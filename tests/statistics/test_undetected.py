"""What an undetected error does: by adjusting with it."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import adjust, correlated, covariance
from jaxphoto.observations import Correlated, StationRows, exponential_covariance
from jaxphoto.statistics import largest_interior_effects, mdb_effects, minimal_detectable_biases, redundancy_numbers
from tests.blocks import adjusted, covariance_of, simulated


@pytest.fixture(scope="module")
def external():
    a = adjusted("cross")
    q = covariance_of("cross")
    r = redundancy_numbers(a, q)
    return a, q, minimal_detectable_biases(a, r), mdb_effects(a, q, r)


@pytest.mark.parametrize("group, field", [("stations", "stations"), ("control_points", "control")])
def test_the_interior_orientation_moves_as_said_with_an_error_that_no_test_finds(external, group, field):
    a, q, detectable, e = external
    row = int(np.argmax(e.interior["c_mm"][group]))
    rows = getattr(a.block, field)
    moved = []
    for sign in (1, -1):
        value = np.array(rows.value)
        value[row] += sign * 0.1 * detectable[group][row]
        with_error = adjust(dataclasses.replace(a.block, **{field: dataclasses.replace(rows, value=value)}))
        camera = with_error.unknowns.interior["one"]
        moved.append([float(camera.c), float(camera.x_p), float(camera.y_p)])
    change = np.abs(np.subtract(*moved)) / 0.2
    sigmas = np.sqrt(np.diagonal(q.of_interior("one", ("c_mm", "xp_mm", "yp_mm"))) / float(q.variance_factor))
    said = [e.interior[name][group][row] for name in ("c_mm", "xp_mm", "yp_mm")]
    np.testing.assert_allclose(change / sigmas, said, rtol=0.02, atol=2e-3)


def test_nothing_moves_by_more_than_said(external):
    _, _, _, e = external
    for moved in e.interior.values():
        for group, most in e.most.items():
            known = np.isfinite(most)
            assert (moved[group][known] <= most[known] * (1 + 1e-6)).all()


def test_the_worst_of_each_parameter_is_found(external):
    a, _, _, e = external
    found = largest_interior_effects(a, e)
    assert [f.parameter for f in found] == ["c_mm", "xp_mm", "yp_mm"]
    for f in found:
        assert f.moved == max(np.nanmax(v) for v in e.interior[f.parameter].values())


def test_image_rows_are_told_of_their_own_camera():
    a = adjusted("two_cameras")
    q = covariance_of("two_cameras")
    e = mdb_effects(a, q, redundancy_numbers(a, q))
    assert np.isfinite(e.interior["c_mm"]["image_points"]).all()


def joined():
    """The block with its stations in two groups of joined rows: each image's by itself, and heights along strips."""
    block = simulated("cross").block
    gnss, n, rng = block.stations, len(block.images), np.random.default_rng(4)
    factor = rng.normal(0, 0.02, (n, 3, 3)) + 0.1 * np.eye(3)
    times = np.array([np.linspace(-6, 6, n // 2), np.linspace(-7, 7, n // 2)])
    along = np.stack([exponential_covariance(t, 0.08, 5.0) for t in times])
    more = (
        correlated(gnss, np.arange(3 * n).reshape(n, 3), factor @ factor.transpose(0, 2, 1)),
        correlated(gnss.take(gnss.axis == 2), np.arange(n).reshape(2, -1), along),
    )
    return dataclasses.replace(block, stations=StationRows.none(), more=more)


def test_of_rows_that_a_covariance_joins_it_holds_too():
    a = adjust(joined())
    q = covariance(a)
    r = redundancy_numbers(a, q)
    e, detectable = mdb_effects(a, q, r), minimal_detectable_biases(a, r)
    sigma = np.sqrt(q.of_interior("one", ("c_mm",))[0, 0] / float(q.variance_factor))
    joint = [name for name, rows in a.block.named_observations.items() if isinstance(rows, Correlated)]
    for name in joint:
        assert (e.interior["c_mm"][name] <= e.most[name] * (1 + 1e-6)).all()
        number = np.unravel_index(np.argmax(e.interior["c_mm"][name]), e.most[name].shape)
        rows, found = a.block.named_observations[name], []
        for sign in (1, -1):
            value = np.array(rows.observation).reshape(len(rows), -1)
            value[number[1], number[0]] += sign * 0.1 * detectable[name][number]
            changed = rows.with_observation(value.reshape(np.shape(rows.observation)))
            found.append(float(adjust(a.block.with_observations({name: changed})).unknowns.interior["one"].c))
        assert abs(np.subtract(*found)) / 0.2 / sigma == pytest.approx(e.interior["c_mm"][name][number], rel=0.02)
    assert len(joint) == 2
