"""Variance components: inflated by a few blunders, or required by wrong standard deviations."""

import dataclasses

import jax
import numpy as np
import pytest

from benchmarks.weights import coverage, flights
from jaxphoto import Tables, adjust, covariance, estimate_weights, halves, variance_components
from jaxphoto.procedures.model_choice import model_choice
from jaxphoto.procedures.snooping import inflated_components
from jaxphoto.report import component_findings, verdict_of
from jaxphoto.simulation import remeasure
from jaxphoto.stability import image_grid
from tests.blocks import adjusted_example, calibration_flight, example, free_network


@pytest.fixture(scope="module")
def block():
    return example()


def found_in(block):
    adjusted = adjusted_example() if block is example() else adjust(block)
    components = variance_components(adjusted, ("xy-z",))
    return components, inflated_components(adjusted, components, ("xy-z",))


def test_the_component_that_one_wrong_height_makes_is_an_alarm(block):
    control = block.control
    row = np.flatnonzero((control.who == block.points.index("T11")) & (control.axis == 2))
    value = np.array(control.value)
    value[row] += 2.0
    components, (made,) = found_in(
        block.with_observations({"control_points": dataclasses.replace(control, value=value)})
    )
    assert made.label == "control_points Z" and made.words == ("control point T11 in Z",)
    assert made.factor == components.factor[components.labels.index(made.label)] > 50
    # As in the block without the error, whose control heights are as good as stated.
    assert made.without == pytest.approx(1.0, abs=0.5)
    alarm = component_findings(components, [made])[0]
    assert alarm.severity == "error" and "T11 in Z" in alarm.text and "--snoop" in alarm.text


def test_sigmas_that_were_stated_too_small_are_not(block):
    control = block.control
    off = np.random.default_rng(4).normal(0.0, 0.5, len(control))
    worse = dataclasses.replace(control, value=np.asarray(control.value) + off)
    components, made = found_in(block.with_observations({"control_points": worse}))
    assert (components.factor > 4).any()
    assert not made


def test_nothing_is_made_of_a_sound_block(block):
    assert not found_in(block)[1]


# Estimated weights: only of parts whose residuals contradict their standard deviations


def with_sigmas_times(block, factors):
    named = block.named_observations
    return block.with_observations({name: named[name].with_sigmas_times(np.asarray(f)) for name, f in factors.items()})


def test_valid_standard_deviations_are_not_estimated():
    assert estimate_weights(adjusted_example()) is None


@pytest.mark.parametrize("factor", [3.0, 0.4])
def test_a_wrong_sigma_of_image_points_is_estimated_and_no_other(block, factor):
    adjusted = adjusted_example()
    estimated = estimate_weights(adjust(with_sigmas_times(block, {"image_points": factor})))
    assert estimated.labels == ("image_points",)
    assert np.sqrt(estimated.factor[0]) * factor == pytest.approx(1.0, abs=0.1)
    # Standard deviations are those of the block with the right weights.
    sigmas = [np.asarray(covariance(a).shared_sigma) for a in (estimated.adjusted, adjusted)]
    np.testing.assert_allclose(*sigmas, rtol=0.1)


def test_models_and_halves_use_estimated_sigmas(block):
    wrong = with_sigmas_times(block, {"image_points": 3.0})
    sigmas = [
        {s.parameter: s.sigma for s in model_choice(b, ["brown:k1+k2"], k=0).judged[0].parameters}
        for b in (block, wrong)
    ]
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.1)
    cells = image_grid(block.sensors["kodak"], 5, 5)
    ratio = halves(wrong, cells, n_cuts=2).promised_px / halves(block, cells, n_cuts=2).promised_px
    assert ratio == pytest.approx(1.0, rel=0.1)


def test_a_common_shift_is_no_wrong_sigma():
    """Eight control points in another epoch: the shift explains their residuals, however little weight they have."""
    block, *_ = calibration_flight()
    shifted = np.asarray(block.control.value) + np.array([0.55, 0.45, 0.0])[block.control.axis]
    adjusted = adjust(block.with_observations({"control_points": dataclasses.replace(block.control, value=shifted)}))
    assert float(adjusted.sigma0) > 1.2 and estimate_weights(adjusted) is None
    # Independent errors of the same size are a wrong sigma.
    rng = np.random.default_rng(5)
    noisy = np.asarray(block.control.value) + np.where(block.control.axis < 2, rng.normal(0, 0.5, len(shifted)), 0.0)
    noisy = block.with_observations({"control_points": dataclasses.replace(block.control, value=noisy)})
    estimated = estimate_weights(adjust(noisy))
    plan = dict(zip(estimated.labels, np.sqrt(estimated.factor), strict=True))["control_points X-Y"]
    assert plan == pytest.approx(25.0, rel=0.5)


@pytest.mark.parametrize("case", ["attitudes in radians", "attitude variances", "station variances", "GNSS of 0.1 m"])
def test_sigmas_of_a_whole_group_that_are_far_too_small_accuse_no_observation(case):
    """Radians under a name in degrees, or variances: the group has no redundancy, and others have its residuals."""
    block, *_ = calibration_flight()
    attitudes, stations = block.attitudes, block.stations
    if case.startswith("attitude"):
        degrees = np.rad2deg(np.asarray(attitudes.sigma))
        stated = np.deg2rad(degrees) if "radians" in case else degrees**2
        block = block.with_observations({"attitudes": dataclasses.replace(attitudes, sigma=np.deg2rad(stated))})
        true = {"attitudes": np.median(degrees / stated)}
    else:
        sigma, value = np.asarray(stations.sigma), np.asarray(stations.value)
        if "0.1" in case:
            rng = np.random.default_rng(6)
            value = value + np.sqrt(0.01 - sigma**2) * rng.normal(size=len(sigma))
            sigma = np.full(len(sigma), 0.1)
        block = block.with_observations({"stations": dataclasses.replace(stations, value=value, sigma=sigma**2)})
        true = {f"stations {part}": 1 / sigma[stations.axis == axis][0] for part, axis in (("X-Y", 0), ("Z", 2))}
    stated = Tables(adjust(block))
    estimated = estimate_weights(stated.adjusted)
    assert estimated.converged and set(estimated.labels) <= set(true)
    for label, factor, sigma in zip(estimated.labels, estimated.factor, estimated.sigma, strict=True):
        # In logarithms: few degrees of freedom.
        assert abs(np.log(factor / true[label] ** 2)) < 3 * sigma / factor
    tables = Tables(estimated.adjusted)
    findings = verdict_of(tables, component_findings(estimated, [], (stated, tables))).findings
    assert {f.code for f in findings if f.severity != "note"} <= {"weights", "small_sigma"}


def test_image_points_that_fit_nothing_keep_their_weight(block):
    rows = block.image_points
    noise = 5 * np.asarray(rows.sigma) * np.random.default_rng(2).normal(size=np.shape(rows.xy))
    wrong = block.with_observations({"image_points": dataclasses.replace(rows, xy=np.asarray(rows.xy) + noise)})
    adjusted = adjust(wrong)
    assert estimate_weights(adjusted) is None and adjusted.verdict().severity == "error"


def test_prior_information_needs_the_weight_of_the_image_points():
    block = with_sigmas_times(free_network().weigh("c", sigma=0.01), {"image_points": 3.0})
    estimated = estimate_weights(adjust(block))
    assert estimated.labels == ("image_points",) and estimated.factor[0] == pytest.approx(1 / 9, rel=0.2)
    # Image points alone: sigma naught has the factor.
    assert estimate_weights(adjust(with_sigmas_times(free_network(), {"image_points": 3.0}))) is None


@pytest.fixture(scope="module")
def precise(block):
    """The block measured with a twentieth of the image noise: its stations check one another."""
    return remeasure(with_sigmas_times(block, {"image_points": 0.05}), adjusted_example().unknowns, jax.random.key(1))


def test_stations_with_too_small_sigmas_are_estimated(precise):
    estimated = estimate_weights(adjust(with_sigmas_times(precise, {"stations": 0.1})))
    assert set(estimated.labels) == {"stations X-Y", "stations Z"}
    np.testing.assert_allclose(np.sqrt(estimated.factor), 10.0, rtol=0.3)


def test_a_shifted_strip_or_a_wrong_height_is_not_a_weight(block):
    stations, control = block.stations, block.control
    of_strip = np.array(block.image_strip)[stations.who] == block.image_strip[0]
    shifted = np.asarray(stations.value) + np.where(of_strip & (stations.axis == 0), 3.0, 0.0)
    assert (
        estimate_weights(adjust(block.with_observations({"stations": dataclasses.replace(stations, value=shifted)})))
        is None
    )
    wrong = np.array(control.value)
    wrong[(control.who == block.points.index("T11")) & (control.axis == 2)] += 2.0
    assert (
        estimate_weights(adjust(block.with_observations({"control_points": dataclasses.replace(control, value=wrong)})))
        is None
    )


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["image_1px", "rtk"])
def test_intervals_of_the_camera_cover_the_truth(recipe):
    """Image sigma stated three times too large: of 30 intervals, at least 24 cover in 99.94 % of such studies."""
    found = list(flights(recipe, range(30)))
    assert len(found) >= 29
    stated, estimated = (coverage([getattr(f, which) for f in found]) for which in ("stated", "estimated"))
    assert stated["c_mm"] < 0.8
    assert min(estimated.values()) >= 0.8 and np.mean(list(estimated.values())) > 0.9
