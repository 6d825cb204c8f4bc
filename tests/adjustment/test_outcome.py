"""How an adjustment ends: true values recovered, or an outcome or an error that says why not."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest
from scipy import stats

from jaxphoto import (
    FIXED,
    FREE,
    Mount,
    Outcome,
    RankError,
    Weighted,
    adjust,
    covariance,
    rebalance,
    rebalance_covariance,
)
from jaxphoto.block import Motion
from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.rotation import small_angles
from jaxphoto.statistics import normalised_residuals, redundancy_numbers
from tests.blocks import (
    SMAC,
    adjusted,
    aerial,
    all_stations,
    bare,
    covariance_of,
    free,
    measured,
    rows,
    simulated,
    with_priors,
)
from tests.marks import slow_but


def true_value(truth, label):
    """The true value of a shared unknown, by its label."""
    owner, parameter = label.split("].")
    kind, name = owner.split("[")
    if kind == "interior":
        return float(get_parameter(truth.interior[name], parameter))
    field, axis = parameter.removesuffix("_m").removesuffix("_rad").removesuffix("_m_per_s").rsplit("_", 1)
    vector = getattr(getattr(truth, kind)[name], field)
    axes = {"lever_arm": ("right", "forward", "up"), "boresight": "xyz"}.get(field, "XYZ")
    return float(vector[list(axes).index(axis)])


@pytest.mark.parametrize(
    "name",
    slow_but(
        ("cross", "two_cameras", "everything"),
        ("cross", "two_cameras", "three_models", "mount", "strips", "everything"),
    ),
)
def test_truth_is_recovered(name):
    """Interior orientation, lever arm, boresight, shift, drift, exterior orientation, points: within sigmas."""
    a, truth = adjusted(name), simulated(name).truth
    cov = covariance_of(name)
    a_priori = 1 / float(a.sigma0)
    shared = np.asarray(a.values.shared)[a.structure.free]
    true = np.array([true_value(truth, label) for label in a.structure.labels])
    start = np.array([true_value(simulated(name).block.start.unknowns, label) for label in a.structure.labels])
    sigma = np.asarray(cov.shared_sigma) * a_priori
    assert len(shared) >= 5
    assert (np.abs(shared - true) < 4 * sigma).all(), dict(
        zip(a.structure.labels, (shared - true) / sigma, strict=True)
    )
    # It started elsewhere.
    assert np.max(np.abs(start - true) / sigma) > 10

    moved = np.asarray(a.unknowns.exterior.position) - truth.exterior.position
    matrices = zip(np.asarray(a.unknowns.exterior.camera_from_object), truth.exterior.camera_from_object, strict=True)
    turned = [small_angles(one @ two.T) for one, two in matrices]
    # Exterior orientation and shared unknowns together: a quadratic form that is chi-square distributed.
    error = np.concatenate([np.hstack([moved, np.array(turned)]).ravel(), shared - true])
    q = np.asarray(cov.matrix)
    d = 1 / np.sqrt(np.diag(q))
    chi2 = (error * d) @ np.linalg.solve(q * np.outer(d, d), error * d)
    assert 1e-4 < stats.chi2.cdf(chi2, len(error)) < 1 - 1e-4
    points = np.asarray(a.unknowns.points) - truth.points
    sigma = np.asarray(cov.point_sigma) * a_priori
    assert (points[sigma == 0] == 0).all()
    assert np.abs(points[sigma > 0] / sigma[sigma > 0]).max() < 4.5


def smac(r0):
    """A block of a SMAC camera balanced at r0, observed through one balanced at 9 mm."""
    block, truth = bare(aerial(), {"one": SMAC}, ("one",) * 10)
    block = dataclasses.replace(block, control=rows((3, 4, 20, 36, 37)), stations=all_stations(block))
    block = measured(type(simulated("cross"))(free(block, "one", NAMES), truth)).block
    camera = rebalance(block.start.unknowns.interior["one"], r0)
    return eqx.tree_at(lambda b: b.start.unknowns.interior["one"], block, camera)


NAMES = ("c_mm", "xp_mm", "yp_mm", "k1", "k2", "p1")


@pytest.fixture(scope="module")
def balanced():
    """The same block adjusted with R0 = 0 and with R0 = 3 mm; residuals of measured coordinates depend on neither."""
    return [adjust(b, b.start.unknowns) for b in map(smac, (0.0, 3.0))]


def test_the_balance_radius_does_not_change_the_bundle(balanced):
    zero, three = balanced
    assert float(three.sigma0) == pytest.approx(float(zero.sigma0), rel=2e-5)
    np.testing.assert_allclose(three.residuals.image, zero.residuals.image, atol=2e-3)
    mapped, found = rebalance(zero.unknowns.interior["one"], 3.0), three.unknowns.interior["one"]
    cov = [covariance(a) for a in balanced]
    n = 6 * cov[0].n_images
    names = parameter_names(found)
    place = [names.index(label.removeprefix("interior[one].")) for label in cov[0].labels[n:]]
    assert [names[k] for k in place] == list(NAMES)
    full = np.zeros((len(names), len(names)))
    full[np.ix_(place, place)] = np.asarray(cov[0].matrix)[n:, n:]
    transported = np.asarray(rebalance_covariance(zero.unknowns.interior["one"], 3.0, full))[np.ix_(place, place)]
    theirs = np.asarray(cov[1].matrix)[n:, n:]
    sigma = np.sqrt(np.diag(theirs))
    np.testing.assert_allclose(transported / np.outer(sigma, sigma), theirs / np.outer(sigma, sigma), atol=1e-4)
    for name, s in zip(NAMES, sigma, strict=True):
        assert abs(float(get_parameter(mapped, name)) - float(get_parameter(found, name))) < 1e-2 * s, name
    # They are different numbers.
    assert abs(float(found.c) - float(zero.unknowns.interior["one"].c)) > sigma[0]


def test_k0_and_c_are_one_scale():
    block = free(smac(0.0), "one", ("k0",))
    with pytest.raises(RankError) as caught:
        adjust(block, block.start.unknowns)
    for word in ("interior[one].c_mm", "interior[one].k0", "fix"):
        assert word in str(caught.value)


@pytest.mark.slow
def test_unknowns_that_nothing_tells_apart_are_named():
    """A time offset at one velocity everywhere is a shift of every strip, and these are free too."""
    block = simulated("strips").block
    n, zero = len(block.images), np.zeros(3)
    block = dataclasses.replace(
        block, image_mount=("imu",) * n, motion=Motion(np.tile([60.0, 20.0, 0.0], (n, 1)), np.zeros((n, 3)))
    )
    mounts = lambda b: (b.start.unknowns.mounts, b.priors.mounts)  # noqa: E731
    block = eqx.tree_at(mounts, block, ({"imu": Mount(zero, zero)}, {"imu": Mount(FIXED, FIXED, FREE)}))
    with pytest.raises(RankError, match=r"mounts\[imu\]\.time_offset_s.*not separable") as caught:
        adjust(block, block.start.unknowns)
    assert "strips[a].shift_X_m" in str(caught.value)


def test_the_step_limit_is_an_outcome():
    block = simulated("cross").block
    a = adjust(block, block.start.unknowns, max_steps=1)
    assert not bool(a.converged)
    assert a.outcome is Outcome.STEPS
    assert "step limit" in a.outcome.value
    assert int(a.steps) == 1


def test_another_number_of_steps_is_the_same_program(monkeypatch):
    block = simulated("cross").block
    adjust(block, block.start.unknowns, max_steps=3)
    monkeypatch.delattr("jaxphoto.compiling.run._program_of")
    a = adjust(block, block.start.unknowns, max_steps=2)
    assert int(a.steps) == 2 and a.outcome is Outcome.STEPS


def test_infinite_numbers_are_an_outcome():
    """A point at a projection centre: the collinearity equations divide by zero."""
    block = simulated("cross").block
    u = block.start.unknowns
    image, point = block.image_points.image[0], block.image_points.point[0]
    points = u.points.copy()
    points[point] = u.exterior.position[image]
    a = adjust(block, eqx.tree_at(lambda t: t.points, u, points))
    assert not bool(a.converged)
    assert a.outcome is Outcome.DIVERGED
    assert "behind" in a.outcome.value


def test_a_gross_error_is_found_by_its_normalised_residual():
    block = simulated("cross").block
    xy = np.array(block.image_points.xy)
    row = int(np.flatnonzero(np.bincount(block.image_points.point)[block.image_points.point] > 6)[0])
    xy[row, 1] += 0.06
    a = adjust(eqx.tree_at(lambda b: b.image_points.xy, block, xy), block.start.unknowns)
    w = np.abs(normalised_residuals(a, redundancy_numbers(a, covariance(a))).image)
    assert np.unravel_index(np.nanargmax(w), w.shape) == (1, row)
    assert w[1, row] > 4


def test_sigma0_is_that_of_the_observations():
    """All sigmas doubled: sigma0 halves, unknowns and their a posteriori sigmas stay."""
    block = simulated("cross").block
    where = lambda b: (b.image_points.sigma, b.control.sigma, b.stations.sigma)  # noqa: E731
    a = adjust(eqx.tree_at(where, block, tuple(2 * np.asarray(s) for s in where(block))), block.start.unknowns)
    one = adjusted("cross")
    assert float(a.sigma0) == pytest.approx(0.5 * float(one.sigma0), rel=1e-8)
    np.testing.assert_allclose(covariance(a).shared_sigma, covariance_of("cross").shared_sigma, rtol=1e-6)
    assert float(a.unknowns.interior["one"].c) == pytest.approx(float(one.unknowns.interior["one"].c), abs=1e-6)


def test_counts():
    a = adjusted("everything")
    n = len(a.block.image_points.image)
    assert a.n_observations == {
        "image_points": 2 * n,
        "stations": 30,
        "attitudes": 18,
        "control_points": 18,
        "surfaces": 0,
        "distances": 3,
        "priors": 2 + 3 + 3 + 3,
    }
    assert a.n_unknowns == {
        "interior": 4 + 2 + 5,
        "scanner": 0,
        "mounts": 6,
        "strips": 9,
        "exterior": 60,
        "points": 3 * 41 - 2,
    }
    assert a.redundancy == sum(a.n_observations.values()) - sum(a.n_unknowns.values())
    assert a.n_constraints == 0


def test_weighted_unknowns_become_fixed_or_free_at_the_ends():
    """A prior with a tiny sigma holds its unknown, one with a huge sigma does nothing."""
    block, truth = simulated("cross")
    true_c = float(truth.interior["one"].c)
    held = with_priors(block, "one", c_mm=Weighted(true_c + 0.01, 1e-7))
    loose = with_priors(block, "one", c_mm=Weighted(true_c + 5.0, 1e6))
    a, b = (adjust(x, x.start.unknowns) for x in (held, loose))
    assert float(a.unknowns.interior["one"].c) == pytest.approx(true_c + 0.01, abs=1e-7)
    assert float(b.unknowns.interior["one"].c) == pytest.approx(
        float(adjusted("cross").unknowns.interior["one"].c), abs=1e-7
    )
