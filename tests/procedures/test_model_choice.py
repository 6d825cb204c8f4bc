import csv
import json

import equinox as eqx
import jax
import numpy as np
import pytest

from jaxphoto import FIXED, FREE, Weighted, adjust
from jaxphoto.camera import Brown, OpenCv, Smac, exact, get_parameter, rebalance, set_parameter
from jaxphoto.errors import BlockError, InputError
from jaxphoto.io import write_block
from jaxphoto.observations import ImagePoints
from jaxphoto.procedures.model_choice import (
    candidate_of,
    folds,
    measured_discrepancies,
    model_choice,
    with_candidate,
    without_rows,
)
from jaxphoto.writing import MARKER
from tests.blocks import VARIANTS, with_priors
from tests.commands import run
from tests.formulas import collinearity

# Truth: Brown with k1 and k2. All seven have five parameters more.
MODELS = ("brown:k1", "brown:k1+k2", "brown:all")
BLOCKS = 20


@pytest.fixture(scope="module")
def block():
    """Two crossing strips with control, and start values that are the truth."""
    made, truth = VARIANTS["cross"]()
    return eqx.tree_at(lambda b: b.start.unknowns, made, truth)


@pytest.fixture(scope="module")
def perfect(block):
    """The image coordinates without noise, written out: what of a noisy block is noise."""
    truth, p = block.start.unknowns, block.image_points
    angles = np.asarray(truth.exterior.omega_phi_kappa)
    camera = truth.interior["one"]
    ideal = [
        collinearity(float(camera.c), angles[i], truth.exterior.position[i], truth.points[k])
        for i, k in zip(p.image, p.point, strict=True)
    ]
    x = np.array(ideal)
    for _ in range(60):  # ideal = x (1 - k1 r^2 - k2 r^4), inverted by repetition
        r2 = (x**2).sum(1, keepdims=True)
        x = np.array(ideal) / (1 - float(camera.distortion.k1) * r2 - float(camera.distortion.k2) * r2**2)
    return x + np.array([float(camera.xp), float(camera.yp)])


def drawn(block, perfect, seed, image_sigma=0.004):
    """The block measured: all observations with noise of their standard deviations."""
    rng = np.random.default_rng(seed)
    truth = block.start.unknowns
    stations, control = block.stations, block.control
    xy = perfect + rng.normal(0, image_sigma, perfect.shape)
    at = np.asarray(truth.exterior.position)[stations.who, stations.axis] + rng.normal(0, stations.sigma)
    on = truth.points[control.who, control.axis] + rng.normal(0, control.sigma)
    places = lambda b: (b.image_points.xy, b.stations.value, b.control.value)  # noqa: E731
    return eqx.tree_at(places, block, (xy, at, on))


@pytest.fixture(scope="module")
def choice(block, perfect):
    return model_choice(drawn(block, perfect, 0), MODELS, k=3)


def of(choice, name):
    return next(j for j in choice.judged if j.candidate.name == name)


# The choice -------------------------------------------------------------------------------------------------


def test_the_true_model_is_chosen_by_all_means(choice):
    small, true, large = choice.judged
    assert choice.by_bic == choice.by_prediction == "brown:k1+k2"
    assert [j.candidate.name for j in choice.judged] == list(MODELS)
    assert (small.n_parameters, true.n_parameters, large.n_parameters) == (4, 5, 10)
    # k2 is needed, the five others are not.
    assert true.smaller == "brown:k1"
    assert true.f > 100 and true.f_p < 1e-6
    assert large.smaller == "brown:k1+k2"
    assert large.f_p > 0.01
    assert small.cv_excess > 3
    assert true.weakest.parameter == "k2" and true.weakest.ratio > 10
    assert large.weakest.ratio < 3
    # More parameters fit better, but do not predict better.
    assert small.rms_px > true.rms_px > large.rms_px
    assert large.cv_rms_px > true.rms_px


def test_bic_finds_the_true_model_in_nine_of_ten_blocks(block, perfect):
    won = [model_choice(drawn(block, perfect, 100 + seed), MODELS, k=0).by_bic for seed in range(BLOCKS)]
    assert won.count("brown:k1+k2") >= 0.9 * BLOCKS


def test_the_criteria_are_their_formulas(choice):
    for j in choice.judged:
        n, p = j.n_effective, j.n_parameters + 1
        assert n == j.redundancy + j.n_parameters
        fit = n * np.log(j.sum_of_squares / n)
        np.testing.assert_allclose([j.aic, j.bic], [fit + 2 * p, fit + p * np.log(n)], rtol=1e-12)
        np.testing.assert_allclose(j.aicc - j.aic, 2 * p * (p + 1) / (n - p - 1), rtol=1e-9)
        np.testing.assert_allclose(j.sigma0, np.sqrt(j.sum_of_squares / j.redundancy), rtol=1e-12)
    # What is counted does not depend on the model.
    assert len({j.n_effective for j in choice.judged}) == 1
    true, large = choice.judged[1:]
    f = (true.sum_of_squares - large.sum_of_squares) / 5 / (large.sum_of_squares / large.redundancy)
    np.testing.assert_allclose(large.f, f, rtol=1e-12)
    # Noise of the standard deviations stated: sigma naught is 1 within five of its own.
    assert abs(true.sigma0 - 1) < 5 / np.sqrt(2 * true.redundancy)


def test_prediction_errors_are_those_of_an_adjustment_without_the_points(block, perfect, choice):
    own = with_candidate(drawn(block, perfect, 0), candidate_of("brown:k1+k2"), None)
    fold = folds(own, 3, 0)
    assert (fold >= 0).sum() == choice.n_left_out
    errors = []
    for number in range(3):
        left = fold == number
        without = adjust(without_rows(own, left))
        assert len(without.block.image_points.image) == (~left).sum()
        errors.append(measured_discrepancies(own, without.unknowns)[left])
    rms = np.sqrt(np.mean((np.concatenate(errors) ** 2).sum(1))) / 0.008
    np.testing.assert_allclose(of(choice, "brown:k1+k2").cv_rms_px, rms, rtol=1e-5)
    # The noise of the point itself and that of the prediction: more than the former, 4 um in x and y.
    assert rms > np.sqrt(2) * 0.004 / 0.008


def test_discrepancies_are_of_measured_coordinates(block, perfect):
    noisy = drawn(block, perfect, 5)
    apart = measured_discrepancies(noisy, noisy.start.unknowns)
    # To first order in noise of 4 um: the second is below a millionth of a millimetre.
    np.testing.assert_allclose(apart, noisy.image_points.xy - perfect, rtol=0, atol=2e-6)


# Folds ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [2, 3, 5, 40])
def test_folds_leave_every_point_two_rays(block, k):
    point = block.image_points.point
    fold = folds(block, k, seed=3)
    rays = np.bincount(point)
    for number in range(k):
        left = np.bincount(point[fold == number], minlength=len(rays))
        assert (rays - left).min() >= 2
        # A fold is about a k-th of the rows.
        if k <= 5:
            assert abs((fold == number).mean() - (fold >= 0).mean() / k) < 0.1
    # All rows of points in four images and more are left out once where that can be.
    assert ((fold >= 0) | (rays[point] < 4)).all() or k == 2
    np.testing.assert_array_equal(fold, folds(block, k, seed=3))
    assert (fold != folds(block, k, seed=4)).any()


def test_nothing_to_leave_out_is_said(block):
    p, (_, first) = block.image_points, np.unique(block.image_points.point, return_index=True)
    two = np.concatenate([first, first + 1])
    few = eqx.tree_at(
        lambda b: b.image_points, block, ImagePoints(p.image[two], p.point[two], np.asarray(p.xy)[two], p.sigma[two])
    )
    with pytest.raises(BlockError, match="no point was measured in three images"):
        folds(few, 5)


# Candidates -------------------------------------------------------------------------------------------------


def test_candidates_by_name():
    assert candidate_of("brown").free == ("k1", "k2", "k3", "p1", "p2")
    assert candidate_of(" smac ").free == ("k1", "k2", "k3", "p1", "p2")
    assert candidate_of("smac:all").free == ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
    assert candidate_of("brown:none").free == ()
    assert candidate_of("brown:p1+k1").free == ("k1", "p1")
    assert candidate_of("brown:k1").within(candidate_of("brown"))
    assert not candidate_of("brown").within(candidate_of("brown"))
    assert not candidate_of("smac:k1").within(candidate_of("brown"))
    for name, message in (
        ("braun", "unknown distortion model 'braun'; choose one of brown"),
        ("brown:k9", "'k9' is not estimable in brown; choose among k1"),
        ("smac:k0", "'k0' is not estimable in smac"),
    ):
        with pytest.raises(InputError, match=message):
            candidate_of(name)


def test_a_candidate_starts_from_the_distortion_of_the_block(block):
    weighted = with_priors(block, "one", c_mm=Weighted(35.0, 0.01), k1=Weighted(-9e-5, 1e-6))
    same = with_candidate(weighted, candidate_of("brown:k1+p1"), None)
    interior, priors = same.start.unknowns.interior["one"], same.priors.interior["one"]
    assert isinstance(interior.distortion, Brown)
    assert [float(get_parameter(interior, n)) for n in ("k1", "k2", "p1")] == [-9e-5, 0.0, 0.0]
    assert (priors.c.value, priors.c.sigma) == (35.0, 0.01)
    # A weighted coefficient would be an observation that others do not have.
    assert (priors.distortion.k1, priors.distortion.p1, priors.distortion.k2) == (FREE, FREE, FIXED)
    assert interior.residuals == "measured"
    smac = with_candidate(block, candidate_of("smac:k1+k2"), None).start.unknowns.interior["one"].distortion
    assert isinstance(smac, Smac)
    assert (float(smac.k1), float(smac.k2)) == (-9e-5, 1.0e-7)
    with_others = with_candidate(block, candidate_of("opencv:k1"), None)
    assert isinstance(with_others.start.unknowns.interior["one"].distortion, OpenCv)
    # The best k1 alone: that of Brown's k1 would be -0.11, and his k2 takes half of it back in the corners.
    assert float(with_others.start.unknowns.interior["one"].distortion.k1) < -0.03


def test_a_weighted_principal_distance_is_the_same_in_every_model(block, perfect):
    """SMAC's c at R0 = 9 mm is 0.7 % below Brown's: 26 of the standard deviations that it is known with."""
    noisy = drawn(block, perfect, 3)
    balanced = rebalance(exact(noisy.start.unknowns.interior["one"], Smac), 9.0)
    free = jax.tree.map(lambda _: FIXED, balanced)
    for name in ("k1", "k2", "xp_mm", "yp_mm"):
        free = set_parameter(free, name, FREE)
    weighted = set_parameter(free, "c_mm", Weighted(float(balanced.c) + 0.004, 0.01))
    places = lambda b: (b.start.unknowns.interior["one"], b.priors.interior["one"])  # noqa: E731
    own = eqx.tree_at(places, noisy, (balanced, weighted))
    as_brown = with_candidate(own, candidate_of("brown:k1+k2"), None)
    prior, c = as_brown.priors.interior["one"].c, float(as_brown.start.unknowns.interior["one"].c)
    # c of R0 = 0 is c / (1 + sum of k R0^(2 i)): the bundle of the weighted value is the same.
    scale = 1 / (1 + float(balanced.distortion.k1) * 9.0**2 + float(balanced.distortion.k2) * 9.0**4)
    assert abs(c - scale * float(balanced.c)) < 1e-12 < 0.2 < abs(c - float(balanced.c))
    np.testing.assert_allclose((prior.value, prior.sigma), (scale * (float(balanced.c) + 0.004), scale * 0.01))


def test_wrong_use_is_refused(block):
    with pytest.raises(InputError, match="got none"):
        model_choice(block, [])
    with pytest.raises(InputError, match="got brown, brown"):
        model_choice(block, ["brown", "brown"])
    with pytest.raises(InputError, match="1 folds"):
        model_choice(block, ["brown"], k=1)


# The command ------------------------------------------------------------------------------------------------


def test_command_writes_the_table_and_says_the_choice(block, perfect, tmp_path, monkeypatch, capsys):
    write_block(drawn(block, perfect, 0), tmp_path / "block")
    out = tmp_path / "out"
    names = "brown:k1,brown:k1+k2"
    code, said, _ = run(
        monkeypatch, capsys, "models", tmp_path / "block", "--models", names, "--folds", "0", "--out", out
    )
    assert code == 0
    assert "BIC prefers brown:k1+k2" in said
    with (out / "models.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["model"] for row in rows] == names.split(",")
    assert float(rows[1]["delta_bic"]) == 0 < float(rows[0]["delta_bic"])
    assert rows[1]["smaller"] == "brown:k1"
    assert json.loads((out / "summary.json").read_text())["by_bic"] == "brown:k1+k2"
    assert {p.name for p in out.iterdir()} == {
        MARKER, "models.csv", "parameters.csv", "report.html", "summary.json",
    }  # fmt: skip
    with (out / "parameters.csv").open() as file:
        first = next(csv.DictReader(file))
    assert (first["model"], first["camera"], first["parameter"]) == ("brown:k1", "one", "c_mm")
    assert first["unit"] == "mm"
    code, _, errors = run(monkeypatch, capsys, "models", tmp_path / "block", "--models", "braun", "--out", out)
    assert code == 2
    assert "unknown distortion model 'braun'" in errors
