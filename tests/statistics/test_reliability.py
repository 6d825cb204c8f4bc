"""External reliability by adjusting with errors; residuals, check points, differences, normalised residuals."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import adjust, angle_differences, correlated, covariance, point_differences
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.observations import CameraPositions, Correlated, exponential_covariance
from jaxphoto.simulation import image_coordinates
from jaxphoto.statistics import (
    a_priori_sigmas,
    check_discrepancies,
    largest_interior_effects,
    mdb_effects,
    minimal_detectable_biases,
    normalised_residuals,
    physical_residuals,
    redundancy_numbers,
    residual_spread,
)
from tests.blocks import adjusted, covariance_of, simulated


@pytest.fixture(scope="module")
def external():
    a = adjusted("cross")
    q = covariance_of("cross")
    r = redundancy_numbers(a, q)
    return a, q, minimal_detectable_biases(a, r), mdb_effects(a, q, r)


@pytest.mark.parametrize("group, field", [("stations", "stations"), ("control_points", "control")])
def test_the_interior_orientation_moves_as_said_with_an_error_that_no_test_finds(external, group, field):
    a, q, mdbs, e = external
    row = int(np.argmax(e.interior["c_mm"][group]))
    rows = getattr(a.block, field)
    moved = []
    for sign in (1, -1):
        value = np.array(rows.value)
        value[row] += sign * 0.1 * mdbs[group][row]
        with_error = adjust(dataclasses.replace(a.block, **{field: dataclasses.replace(rows, value=value)}))
        camera = with_error.unknowns.interior["one"]
        moved.append([float(camera.c), float(camera.xp), float(camera.yp)])
    change = np.abs(np.subtract(*moved)) / 0.2
    sigmas = np.sqrt(np.diagonal(q.of_interior("one", ("c_mm", "xp_mm", "yp_mm"))) / float(q.variance_factor))
    predicted = [e.interior[name][group][row] for name in ("c_mm", "xp_mm", "yp_mm")]
    np.testing.assert_allclose(change / sigmas, predicted, rtol=0.02, atol=2e-3)


def test_nothing_moves_by_more_than_said(external):
    _, _, _, e = external
    for moved in e.interior.values():
        for group, most in e.most.items():
            finite = np.isfinite(most)
            assert (moved[group][finite] <= most[finite] * (1 + 1e-6)).all()


def test_the_worst_of_each_parameter_is_found(external):
    a, _, _, e = external
    result = largest_interior_effects(a, e)
    assert [f.parameter for f in result] == ["c_mm", "xp_mm", "yp_mm"]
    for f in result:
        assert f.moved == max(np.nanmax(v) for v in e.interior[f.parameter].values())


def test_image_rows_are_told_of_their_own_camera():
    a = adjusted("two_cameras")
    q = covariance_of("two_cameras")
    e = mdb_effects(a, q, redundancy_numbers(a, q))
    assert np.isfinite(e.interior["c_mm"]["image_points"]).all()


def joined():
    """The block with its stations in two correlated groups: within each image, and heights along strips."""
    block = simulated("cross").block
    gnss, n, rng = block.stations, len(block.images), np.random.default_rng(4)
    factor = rng.normal(0, 0.02, (n, 3, 3)) + 0.1 * np.eye(3)
    times = np.array([np.linspace(-6, 6, n // 2), np.linspace(-7, 7, n // 2)])
    along = np.stack([exponential_covariance(t, 0.08, 5.0) for t in times])
    more = (
        correlated(gnss, np.arange(3 * n).reshape(n, 3), factor @ factor.transpose(0, 2, 1)),
        correlated(gnss.take(gnss.axis == 2), np.arange(n).reshape(2, -1), along),
    )
    return dataclasses.replace(block, stations=CameraPositions.none(), more=more)


def test_of_rows_that_a_covariance_joins_it_holds_too():
    a = adjust(joined())
    q = covariance(a)
    r = redundancy_numbers(a, q)
    e, mdbs = mdb_effects(a, q, r), minimal_detectable_biases(a, r)
    sigma = np.sqrt(q.of_interior("one", ("c_mm",))[0, 0] / float(q.variance_factor))
    joint = [name for name, rows in a.block.named_observations.items() if isinstance(rows, Correlated)]
    for name in joint:
        assert (e.interior["c_mm"][name] <= e.most[name] * (1 + 1e-6)).all()
        number = np.unravel_index(np.argmax(e.interior["c_mm"][name]), e.most[name].shape)
        rows, result = a.block.named_observations[name], []
        for sign in (1, -1):
            value = np.array(rows.observation).reshape(len(rows), -1)
            value[number[1], number[0]] += sign * 0.1 * mdbs[name][number]
            changed = rows.with_observation(value.reshape(np.shape(rows.observation)))
            result.append(float(adjust(a.block.with_observations({name: changed})).unknowns.interior["one"].c))
        assert abs(np.subtract(*result)) / 0.2 / sigma == pytest.approx(e.interior["c_mm"][name][number], rel=0.02)
    assert len(joint) == 2


def test_physical_residuals_are_observed_minus_computed():
    a = adjusted("everything")
    v, u, block = physical_residuals(a), a.unknowns, a.block
    points = np.asarray(u.points)
    np.testing.assert_allclose(
        v["control_points"], block.control.value - points[block.control.who, block.control.axis], atol=1e-9
    )
    ends = points[block.distances.points]
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    np.testing.assert_allclose(v["distances"], block.distances.value - length, atol=1e-9)
    # Image residuals are of ideal coordinates; to first order those of the measured ones, scaled by the distortion.
    measured = (np.asarray(block.image_points.xy) - np.asarray(image_coordinates(block, u))).T
    np.testing.assert_allclose(v["image_points"], measured, atol=0.2 * np.abs(measured).max())
    assert np.corrcoef(np.ravel(v["image_points"]), np.ravel(measured))[0, 1] > 0.999
    sigmas = a_priori_sigmas(a)
    square = sum(float(np.sum((v[group] / sigmas[group]) ** 2)) for group in v)
    assert square == pytest.approx(float(a.sum_of_squares), rel=1e-12)
    assert float(a.sigma0) == pytest.approx(np.sqrt(square / a.redundancy), rel=1e-12)


def test_residual_spread():
    a = adjusted("everything")
    v, spreads = physical_residuals(a), residual_spread(a)
    assert [(s.group, s.axis) for s in spreads] == [
        *(("image_points", axis) for axis in "xy"),
        *(("stations", axis) for axis in "XYZ"),
        *(("attitudes", axis) for axis in ("roll", "pitch", "yaw")),
        *(("control_points", axis) for axis in "XYZ"),
        ("distances", ""),
    ]
    by_axis = {(s.group, s.axis): s for s in spreads}
    z = v["control_points"][np.asarray(a.block.control.axis) == 2]
    s = by_axis["control_points", "Z"]
    assert (s.n, s.unit) == (8, "m")
    assert s.mean == pytest.approx(z.sum() / 8)
    assert s.rmse == pytest.approx(np.sqrt((z**2).sum() / 8))
    assert s.max_abs == pytest.approx(np.abs(z).max())
    assert by_axis["attitudes", "yaw"].n == 6
    assert by_axis["image_points", "y"].rmse == pytest.approx(np.sqrt(np.mean(v["image_points"][1] ** 2)))
    assert sum(s.n for s in spreads) == sum(a.n_observations.values()) - a.n_observations["priors"]


def test_check_points_are_surveyed_minus_computed():
    a, truth = adjusted("cross"), simulated("cross").truth
    rows = check_discrepancies(a)
    assert len(rows.who) == 6
    computed = np.asarray(a.unknowns.points)[rows.who, rows.axis]
    np.testing.assert_allclose(rows.value, truth.points[rows.who, rows.axis] - computed, atol=1e-9)
    sigma = np.asarray(covariance_of("cross").point_sigma)[rows.who, rows.axis]
    assert (np.abs(rows.value) < 4 * sigma).all()


def test_check_points_do_not_take_part():
    """An error of 1 m of a check point changes its discrepancy by 1 m and nothing else."""
    block = simulated("cross").block
    wrong = eqx.tree_at(lambda b: b.check.value, block, np.asarray(block.check.value) + 1.0)
    a = adjust(wrong, wrong.start.unknowns)
    one = adjusted("cross")
    assert float(a.sum_of_squares) == float(one.sum_of_squares)
    np.testing.assert_allclose(
        check_discrepancies(a).value, np.asarray(check_discrepancies(one).value) + 1.0, atol=1e-12
    )


def test_point_differences_are_first_minus_second_of_the_common():
    one, other = adjusted("cross"), adjusted("fixed_interior")
    fewer = eqx.tree_at(lambda x: x.unknowns.points, other, np.asarray(other.unknowns.points)[2:])
    fewer = dataclasses.replace(fewer, block=dataclasses.replace(other.block, points=other.block.points[2:]))
    names, difference = point_differences(one, fewer)
    assert names == one.block.points[2:]
    np.testing.assert_allclose(difference, np.asarray(one.unknowns.points)[2:] - np.asarray(other.unknowns.points)[2:])
    assert np.abs(difference).max() > 1e-3


def test_angle_differences_are_small_across_the_half_turn():
    """kappa = +179.9 and -179.9 degrees differ by 0.2 degrees."""
    a = adjusted("cross")
    n = len(a.block.images)

    def with_angles(degrees):
        exterior = ExteriorOrientation.from_angles(np.zeros((n, 3)), np.tile(np.deg2rad(degrees), (n, 1)))
        return eqx.tree_at(lambda x: x.unknowns.exterior, a, exterior)

    names, difference = angle_differences(with_angles([1.0, 2.0, 179.9]), with_angles([0.5, 2.5, -179.9]))
    assert names == a.block.images
    np.testing.assert_allclose(np.rad2deg(difference), np.tile([0.5, -0.5, -0.2], (n, 1)), atol=1e-9)


def test_normalised_residuals():
    a = adjusted("everything")
    numbers = redundancy_numbers(a, covariance_of("everything"))
    w = normalised_residuals(a, numbers)
    for v, r, w_group in zip(*(of.named.values() for of in (a.residuals, numbers, w)), strict=True):
        np.testing.assert_allclose(w_group, np.asarray(v) / (float(a.sigma0) * np.sqrt(np.asarray(r))), rtol=1e-9)
    everything = np.concatenate([np.ravel(x) for x in w.named.values()])
    # Standard normal, apart from correlations.
    assert 0.9 < np.std(everything) < 1.1
    assert np.abs(everything).max() < 4.5


def test_observations_that_nothing_checks_have_no_normalised_residual():
    a = adjusted("inner")
    numbers = redundancy_numbers(a, covariance_of("inner"))
    (place,) = (k for k, name in enumerate(numbers.numbers.names) if name == "distances")
    unchecked = eqx.tree_at(lambda r: r.numbers.others[place], numbers, np.zeros(3))
    assert np.isnan(normalised_residuals(a, unchecked)["distances"]).all()
    assert np.isfinite(normalised_residuals(a, numbers)["distances"]).all()
