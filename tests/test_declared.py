"""Every declared kind of observation and unknown works in the adjustment, its statistics and tables.

All tests share one adjustment of every kind (`tests.declared`).
"""

import dataclasses
import functools

import equinox as eqx
import jax
import numpy as np
import pytest
import scipy.linalg
from jax.flatten_util import ravel_pytree

import jaxphoto.observations
from jaxphoto import FIXED, FREE, AbstractObservations, JaxphotoError, Tables, Weighted, adjust, covariance, monte_carlo
from jaxphoto.adjustment.adjust import _residuals
from jaxphoto.adjustment.layout.rays import sizes_of
from jaxphoto.adjustment.model.block_values import with_start
from jaxphoto.adjustment.model.numbers import state_at, zero_increments
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.adjustment.right_hand_sides import solve_many
from jaxphoto.adjustment.solver.optimum import typical_scale
from jaxphoto.compiling import run_compiled
from jaxphoto.compiling.quickly import jit_quickly
from jaxphoto.observations import Correlated, KnownParameters
from jaxphoto.parameters import numbers_of
from jaxphoto.report import Verdict, write_results
from jaxphoto.report.formatting import in_file_unit
from jaxphoto.sensitivity import noise, sensitivity
from jaxphoto.sensitivity.sweep import prepare_design
from jaxphoto.statistics import observation_groups, redundancy_numbers
from tests.adjustment.dense import in_order, own_order, rows_of
from tests.declared import OWN, adjusted, own_alone, own_priors, residuals_of, simulated

# Observation classes and their groups in the block.
SHOWN = {
    "ImagePoints": ("image_points",),
    "CameraPositions": ("stations",),
    "Attitudes": ("attitudes",),
    "ControlCoordinates": ("control_points",),
    "SurfaceRows": ("surfaces",),
    "StripPlanes": ("strip_planes",),
    "StripPoints": ("strip_points",),
    "TrajectoryStations": ("trajectory_stations",),
    "TrajectoryAttitudes": ("trajectory_attitudes",),
    "PositionSteps": ("position_steps",),
    "AttitudeSteps": ("attitude_steps",),
    "StripCameraSteps": ("strip_camera_steps",),
    "RigPlaces": ("rig_places",),
    "RigTurns": ("rig_turns",),
    "RelativePositions": ("relative_positions",),
    "RelativeAttitudes": ("relative_attitudes",),
    "Distances": ("distances",),
    "HeightDifferences": ("height_differences",),
    "Baselines": ("baselines",),
    "Correlated": ("correlated_stations", "correlated_stations#2", "priors_together"),
    "PositionRows": ("prior_positions",),
    "RotationRows": ("prior_rotations",),
    "PointRows": ("prior_points",),
    "ParameterRows": ("priors",),
}
GROUPS = tuple(name for names in SHOWN.values() for name in names)
each_group = pytest.mark.parametrize("group", GROUPS)


def concrete(cls: type) -> set[type]:
    """Concrete subclasses."""
    below = {c for one in cls.__subclasses__() for c in {one, *concrete(one)}}
    return {c for c in below if not c.__name__.startswith("Abstract")}


def test_no_class_of_observations_is_forgotten():
    declared = {c.__name__ for c in concrete(AbstractObservations) if c.__module__.startswith("jaxphoto.")}
    declared |= {"HeightDifferences", "Baselines"}
    assert set(SHOWN) == declared
    assert {c for c in declared if hasattr(jaxphoto.observations, c)} == declared - {"HeightDifferences", "Baselines"}
    assert set(adjusted().residuals.named) == set(GROUPS)


@functools.cache
def dense():
    return rows_of(adjusted())


@functools.cache
def rows_of_groups() -> dict[str, slice]:
    """Places of the residuals of each group among all."""
    ends = np.cumsum([0, *(np.size(v) for v in adjusted().residuals.named.values())])
    return {name: slice(*ends[k : k + 2]) for k, name in enumerate(adjusted().residuals.named)}


@functools.cache
def differences() -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of all residuals along eight random directions, by the Jacobian and by central differences."""
    a = adjusted()
    equations = a.equations
    values, s = equations.values, equations.structure
    scale, back = typical_scale(values, s), ravel_pytree(zero_increments(s))[1]

    moved = jit_quickly(lambda increments: state_at(back(increments), scale, values, s))

    def at(increments) -> np.ndarray:
        """By the program of the residuals alone, which contains no derivative."""
        there = with_start(values, moved(increments))
        return in_order(a.padded.crop_residuals(run_compiled(_residuals, (there, s), {}, "residuals")))

    unknowns = own_order(values, a.padded)[0]
    rng, n = np.random.default_rng(3), np.size(ravel_pytree(zero_increments(s))[0])
    directions = np.zeros((8, n))
    directions[:, unknowns] = rng.normal(size=(8, len(unknowns)))
    h = _STEP * directions
    found = [(at(-2 * d) - 8 * at(-d) + 8 * at(d) - at(2 * d)) / (12 * _STEP) for d in h]
    return dense().jacobian @ directions[:, unknowns].T, np.stack(found, axis=1)


# In typical increments of an unknown: fourth-order differences then have eight correct digits.
_STEP = 1e-3


@each_group
def test_derivatives_of_the_rows_are_central_differences(group):
    found, expected = (v[rows_of_groups()[group]] for v in differences())
    scale = np.abs(expected).max()
    assert scale > 1e-3, "nothing depends on anything: the check would pass for any derivative"
    np.testing.assert_allclose(found, expected, atol=1e-7 * scale)


@each_group
def test_every_row_weighs_in_the_normal_equations(group):
    """The sums of the structured solver contain every group."""
    d = dense()
    own = rows_of_groups()[group]
    terms = np.abs(d.jacobian).T @ np.abs(d.residuals)
    np.testing.assert_allclose(d.sums, d.jacobian.T @ d.residuals, atol=1e-12 * terms.max())
    part = d.jacobian[own].T @ d.residuals[own]
    assert np.abs(part).max() > 1e-9 * terms.max()


def test_elimination_solves_the_dense_normal_equations():
    d, equations = dense(), adjusted().equations
    j = d.jacobian[:, d.free]
    n = j.T @ j
    unknowns = own_order(equations.values, adjusted().padded)[0]
    flat, back = ravel_pytree(zero_increments(equations.structure))
    right = np.zeros(len(flat))
    right[unknowns] = np.sin(1.0 + np.arange(len(unknowns))) * d.free
    (x,) = jax.vmap(lambda tree: ravel_pytree(tree)[0])(
        solve_many(equations.on_one_device.weighed, jax.tree.map(lambda v: np.asarray(v)[None], back(right)), {})
    )
    expected = scipy.linalg.cho_solve(scipy.linalg.cho_factor(n), right[unknowns][d.free])
    error = np.asarray(x)[unknowns][d.free] - expected
    assert np.sqrt(error @ n @ error) < 1e-9 * np.sqrt(expected @ n @ expected)


@functools.cache
def redundancy():
    return redundancy_numbers(adjusted(), covariance_of())


@functools.cache
def covariance_of():
    return covariance(adjusted())


@functools.cache
def dense_cofactors() -> np.ndarray:
    """Cofactors of the whitened residuals, I - J N^-1 J'."""
    j = dense().jacobian[:, dense().free]
    return np.eye(len(j)) - j @ np.linalg.solve(j.T @ j, j.T)


@pytest.mark.slow
@each_group
def test_redundancy_numbers_are_those_of_the_dense_matrix(group):
    found, own = redundancy().named[group], rows_of_groups()[group]
    expected, rows = dense_cofactors()[own, own], observation_groups(adjusted())[group]
    if isinstance(rows, Correlated):
        # Of the observations: the diagonal of Q_vv P = L (I - J N^-1 J') L^-1.
        factor = np.linalg.cholesky(np.asarray(rows.covariance))
        sets, n = factor.shape[:2]
        expected = expected.reshape(n, sets, n, sets)
        whole = [factor[k] @ expected[:, k, :, k] @ np.linalg.inv(factor[k]) for k in range(sets)]
        expected = np.stack([np.diagonal(one) for one in whole], axis=1)
    else:
        expected = np.diagonal(expected)
        assert (found > -1e-6).all()
        assert (found < 1 + 1e-9).all()
    np.testing.assert_allclose(np.ravel(found), np.ravel(expected), atol=1e-6)


@pytest.mark.slow
def test_redundancy_numbers_sum_to_the_redundancy():
    total = sum(float(np.sum(v)) for v in redundancy().named.values())
    assert abs(total - adjusted().redundancy) < 1e-5


@pytest.mark.slow
def test_larger_sizes_change_nothing():
    a = adjusted()
    sizes = sizes_of(a.structure)
    more = tuple((name, 2 * n + 3) for name, n in sizes.rows)
    wide = sizes._replace(images=40, point_groups=40, chunks=80, pair_chunks=500, rows=more)
    again = adjust(a.block, a.block.start.unknowns, sizes=wide)
    for name, v in a.residuals.named.items():
        np.testing.assert_allclose(again.residuals[name], v, atol=1e-6, err_msg=name)
    sigma = np.asarray(covariance_of().shared_sigma)
    of_shared = lambda x: np.asarray(x.values.shared)[a.structure.free]  # noqa: E731
    np.testing.assert_array_less(np.abs(of_shared(again) - of_shared(a)) / sigma, 1e-6)
    np.testing.assert_allclose(again.unknowns.points, a.unknowns.points, atol=1e-6)


@functools.cache
def whitened_by_noise() -> dict[str, np.ndarray]:
    """Derivatives of the residuals by unit errors of `noise`, by group."""
    a = adjusted()
    errors, nominal = noise(a.block), residuals_of(a.block, a.unknowns)[0]
    step = 1e-3
    rng = np.random.default_rng(8)
    draws = []
    for z in rng.choice([-1.0, 1.0], (24, len(errors.sigma))):
        moved = errors.applied(step * z * errors.sigma, a.block)
        moved = jax.tree.map(lambda v: np.asarray(v) if eqx.is_array(v) else v, moved)
        found = residuals_of(moved, a.unknowns)[0]
        draws.append({k: np.ravel((v - nominal[k]) / step) for k, v in found.named.items()})
    return {k: np.stack([d[k] for d in draws]) for k in draws[0]}


@each_group
def test_noise_moves_every_number_by_its_own_standard_deviation(group):
    """Under errors of one standard deviation uncorrelated residuals move by one, correlated ones by unit variance."""
    moved = whitened_by_noise()[group]
    assert (np.abs(moved).max(0) > 0.1).all(), "a number has no noise"
    if group.startswith(("correlated", "priors_together")):
        np.testing.assert_allclose((moved**2).sum(1), moved.shape[1], rtol=1e-6)
    else:
        np.testing.assert_allclose(np.abs(moved), 1.0, atol=_BENT.get(group, 1e-3))


# Residuals differ from errors: they are of ideal coordinates, of small rotations of a tilted aircraft (errors of two
# angles meet in one axis), of small rotations from a start that is 2 mrad off.
_BENT = {
    "image_points": 0.1, "attitudes": 0.15, "relative_attitudes": 0.15, "trajectory_attitudes": 0.15,
    "prior_rotations": 0.01,
}  # fmt: skip


def test_noise_knows_each_number_once():
    assert len(noise(adjusted().block).sigma) == sum(np.size(v) for v in adjusted().residuals.named.values())


N_DRAWS = 300


@pytest.mark.slow
def test_scatter_of_re_adjustments_is_the_covariance():
    """Cameras, scanner, mounts and a user's own unknowns: within four times the sampling error, alone and together."""
    a = adjusted()
    found, cov = monte_carlo(a, noise(a.block), N_DRAWS, seed=2), covariance_of()
    assert found.converged.all()
    at = np.array([found.labels.index(label) for label in a.structure.labels])
    n = len(at)
    expected = np.asarray(cov.matrix)[-n:, -n:]
    off = found.shared[:, at] - np.asarray(a.values.shared)[a.structure.free]
    ratio = off.std(0) / np.sqrt(np.diag(expected))
    np.testing.assert_allclose(ratio, 1.0, atol=4 / np.sqrt(2 * N_DRAWS))
    unit = np.linalg.solve(np.linalg.cholesky(expected), off.T)
    assert abs((unit**2).sum() / (n * N_DRAWS) - 1) < 4 * np.sqrt(2 / (n * N_DRAWS))


@functools.cache
def from_optimum():
    """Adjustment restarted at its optimum."""
    return adjust(adjusted().block, adjusted().unknowns)


@functools.cache
def derivatives():
    return sensitivity(from_optimum())


# The second number of a group is changed.
_PLACES = {
    "stations": ("stations", "value"), "attitudes": ("attitudes", "roll_pitch_yaw"),
    "control_points": ("control", "value"), "surfaces": ("surfaces", "rise"), "distances": ("distances", "value"),
    "height_differences": 0, "baselines": 1,
    "correlated_stations": 2, "correlated_stations#2": 3, "image_points": ("image_points", "xy"),
}  # fmt: skip


def with_one_changed(group: str, h: float):
    """Adjusted block with the second number of a group changed by h."""
    block = from_optimum().block
    place = _PLACES[group]
    where = (lambda b: b.more[place]) if isinstance(place, int) else (lambda b: getattr(b, place[0]))
    rows = where(block)
    value = np.array(rows.observation, float)
    value.reshape(-1)[1] += h
    return eqx.tree_at(where, block, jax.tree.map(np.asarray, rows.with_observation(value)))


@pytest.mark.slow
@pytest.mark.parametrize("group", _PLACES)
def test_exact_sensitivity_is_the_difference_of_re_adjustments(group):
    a = from_optimum()
    rows = observation_groups(a)[group]
    step = float(np.ravel(np.asarray(rows.sigmas))[1])

    def estimates(h):
        unknowns = a.unknowns
        # Twice, to remove the iteration error.
        for _ in range(2):
            found = adjust(with_one_changed(group, h), unknowns)
            unknowns = found.unknowns
        return np.asarray(found.values.shared)[a.structure.free]

    expected = (estimates(step) - estimates(-step)) / (2 * step)
    d = derivatives()
    shared = [d.row(label) for label in a.structure.labels]
    found = d.groups[group][shared, 1]
    sigma = np.asarray(covariance(a).shared_sigma)
    size = np.abs(expected / sigma).max()
    assert size * step > 1e-7, "nothing depends on it"
    np.testing.assert_allclose(found / sigma / size, expected / sigma / size, atol=2e-4)


def test_a_design_has_the_redundancy_of_the_adjustment():
    block, truth = simulated()
    known = dataclasses.replace(
        block.start, image_known=np.ones(len(block.images), bool), point_known=np.ones(len(block.points), bool)
    )
    block = dataclasses.replace(block, start=known)
    design = prepare_design(block, truth, sizes_of(structure_of(block, block.priors)), len(block.points))
    assert design.redundancy == adjusted().redundancy
    assert design.labels == adjusted().structure.labels


@functools.cache
def tables():
    return Tables(adjusted())


@pytest.mark.slow
@each_group
def test_the_table_of_residuals_names_each_number(group):
    table = tables().residuals
    own = table[table["group"] == group]
    assert len(own) == np.size(adjusted().residuals[group])
    names = own[["image", "point", "axis"]]
    # Points may lie on several surfaces. Planes and steps of strips have neither image nor point.
    alike = ("surfaces", "strip_planes", "strip_points", "position_steps", "attitude_steps")
    assert not names.duplicated().any() or group in alike
    assert (names != "").any(axis=1).all()
    assert set(own["unit"]) == {in_file_unit(observation_groups(adjusted())[group].unit)[1]}
    assert np.isfinite(own[["residual", "sigma", "redundancy_number", "w"]].to_numpy(float)).all()


@each_group
def test_a_sentence_names_each_number(group):
    rows, block = observation_groups(adjusted())[group], adjusted().block
    called = block.images, block.points
    sentences = np.broadcast_to(rows.words(*called), np.shape(np.atleast_2d(adjusted().residuals[group])))
    assert sentences.all()
    assert rows.words_of(*np.indices(sentences.shape).reshape(2, -1), *called) == sentences.ravel().tolist()


@pytest.mark.slow
def test_results_and_report_are_written(tmp_path):
    write_results(tables(), Verdict(()), tmp_path / "out", {})
    page = (tmp_path / "out/report.html").read_text(encoding="utf-8")
    for name in ("height differences", "baselines"):
        assert name in page.replace("_", " "), name
    summary = page + (tmp_path / "out/summary.json").read_text(encoding="utf-8")
    for label in TRUE:
        assert label in summary, label


# User-defined unknowns ---------------------------------------------------------------------------------------


TRUE = {
    label: value
    for owners in OWN.values()
    for name, own in owners.items()
    for label, value in zip(own.labels(name), numbers_of(own), strict=True)
}


def numbers_of_own(more) -> np.ndarray:
    return np.array([v for kind, owners in OWN.items() for name in owners for v in numbers_of(more[kind][name])])


@functools.cache
def dense_sigmas() -> dict[str, float]:
    """Standard deviations of the shared unknowns, by the dense normal equations."""
    a, d = adjusted(), dense()
    scale = ravel_pytree(typical_scale(a.equations.values, a.equations.structure))[0]
    scale, j = scale[own_order(a.equations.values, a.padded)[0]], d.jacobian[:, d.free]
    sigma = np.zeros(len(scale))
    sigma[d.free] = scale[d.free] * np.sqrt(np.diagonal(np.linalg.inv(j.T @ j)))
    labels, first = a.structure.labels, 6 * len(a.block.images)
    return dict(zip(labels, sigma[first : first + len(labels)], strict=True))


@pytest.mark.parametrize("label", TRUE)
def test_truth_of_an_own_unknown_is_recovered(label):
    a, sigma = adjusted(), dense_sigmas()[label]
    found = np.asarray(a.values.shared)[a.structure.free][a.structure.labels.index(label)]
    assert abs(TRUE[label]) > 3 * sigma, "nothing is known of it"
    assert abs(found - TRUE[label]) < 3 * sigma


def with_own(prior_of):
    block = own_alone().block
    more = block.priors.more | own_priors(prior_of)
    return dataclasses.replace(block, priors=dataclasses.replace(block.priors, more=more))


@functools.cache
def freely():
    return adjust(own_alone().block, own_alone().block.start.unknowns)


@functools.cache
def by_prior(kind: str):
    """User-defined unknowns fixed at half their truth, or with a weak or strong prior there."""
    half = jax.tree.map(lambda v: 0.5 * v, OWN)
    given = own_alone().block.start.unknowns
    start = dataclasses.replace(given, more=given.more | half)
    of = {
        "fixed": lambda v: FIXED,
        "hardly": lambda v: Weighted(0.5 * v, 1e4 * np.ones(np.shape(v))),
        "well": lambda v: Weighted(0.5 * v, 1e-9 * np.ones(np.shape(v))),
    }
    return adjust(with_own(of[kind]), start)


def off(a, b) -> float:
    """Largest difference of the shared unknowns of two adjustments, in standard deviations of the free one."""
    free = freely()
    sigma = np.asarray(covariance(free).shared_sigma)
    v = [np.asarray(x.values.shared)[free.structure.free] for x in (a, b)]
    return float(np.max(np.abs(v[0] - v[1]) / sigma))


def test_a_weak_prior_of_an_own_unknown_is_none():
    assert off(by_prior("hardly"), freely()) < 1e-3


def test_an_own_unknown_held_fixed_stays_as_it_starts_and_a_strong_prior_does_the_same():
    held = by_prior("fixed")
    np.testing.assert_array_equal(numbers_of_own(held.unknowns.more), 0.5 * numbers_of_own(OWN))
    assert off(by_prior("well"), held) < 1e-4
    assert off(held, freely()) > 1, "what is held has an effect"
    numbers = held.n_unknowns
    assert {numbers[kind] for kind in OWN} == {0}


@pytest.mark.slow
def test_a_covariance_of_a_vector_is_what_known_parameters_say_and_both_pull():
    """A prior with a correlation near one moves the shift along it."""
    known = np.array([0.5, -0.1])
    matrix = np.array([[1.0, 0.999], [0.999, 1.0]]) * 0.02**2
    free = own_alone().block
    shifts = {"": dataclasses.replace(free.priors.more["shifts"][""], shift=Weighted(known, covariance=matrix))}
    priors = dataclasses.replace(free.priors, more={**free.priors.more, "shifts": shifts})
    one = adjust(dataclasses.replace(free, priors=priors), free.start.unknowns)
    two = adjust(free, free.start.unknowns, more=(KnownParameters(("shifts.X_m", "shifts.Y_m"), known, matrix),))
    assert off(one, two) < 1e-6
    assert off(one, freely()) > 1
    moved = np.asarray(one.unknowns.more["shifts"][""].shift) - known
    assert abs(moved[0] - moved[1]) < 0.1 * np.abs(moved).max() + 4e-3


# Invalid priors ----------------------------------------------------------------------------------------------

PLACES = {
    "exterior.position": lambda p: p.exterior.position,
    "exterior.camera_from_object": lambda p: p.exterior.camera_from_object,
    "points": lambda p: p.points,
    "interior[one].k3": lambda p: p.interior["one"].distortion.k3,
    "c_rates[one].rate_mm_per_s": lambda p: p.more["c_rates"]["one"].rate,
    "clocks[early].offset_s": lambda p: p.more["clocks"]["early"].offset,
    "shifts.X_m": lambda p: p.more["shifts"][""].shift,
    "mounts[imu].boresight_x_rad": lambda p: p.mounts["imu"].boresight,
}


@pytest.mark.parametrize("garbage", [0.0, "free", None, np.zeros(3), np.zeros((3, 3))], ids=str)
@pytest.mark.parametrize("label", PLACES)
def test_what_is_no_prior_is_refused_by_name(label, garbage):
    block = simulated().block
    priors = eqx.tree_at(PLACES[label], block.priors, garbage, is_leaf=lambda v: isinstance(v, Weighted))
    with pytest.raises(JaxphotoError) as refused:
        adjust(block, block.start.unknowns, priors)
    assert str(refused.value).startswith(f"{label}: "), str(refused.value)
    assert "FREE, FIXED" in str(refused.value) and "\n" not in str(refused.value)


def test_a_table_of_priors_that_is_none_is_refused_by_name():
    block = own_alone().block
    for garbage in (0.0, FREE, None):
        more = {**block.priors.more, "clocks": {"early": garbage, "late": block.priors.more["clocks"]["late"]}}
        with pytest.raises(JaxphotoError, match=r"^[^\n]*clocks\[early\][^\n]*$"):
            adjust(block, block.start.unknowns, dataclasses.replace(block.priors, more=more))
