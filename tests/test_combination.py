"""Several calibrations as one: the least-squares solution of all, a test that is right, and a file that is a prior."""

import numpy as np
import pytest

from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.stability import combine, parameter_vector
from tests.commands import run
from tests.test_stability import ONE, SIGMAS, covariance, smac
from tests.test_stability_command import TARGET_1, TARGET_2, written_set

NAMES = parameter_names(ONE)
FREE = [NAMES.index(name) for name in SIGMAS]
OWN = np.ix_(FREE, FREE)
TRUE = np.asarray(parameter_vector(ONE))
SCALES = (1.0, 0.5, 2.0)


def drawn(rng, off=0.0):
    """Calibrations of one camera of different precision, the last one `off` standard deviations in c."""
    found = []
    for k, scale in enumerate(SCALES):
        q = covariance(scale)
        e = rng.multivariate_normal(np.zeros(len(q)), q, method="eigh")
        e[0] += off * np.sqrt(q[0, 0]) * (k == len(SCALES) - 1)
        found.append(smac(*(TRUE + e)[FREE]))
    return found, [covariance(scale) for scale in SCALES]


def test_one_calibration_says_nothing_twice():
    interiors, covariances = drawn(np.random.default_rng(1))
    with pytest.raises(InputError, match="c and a are the same calibration"):
        combine([*interiors[:2], interiors[0]], [*covariances[:2], covariances[0]], "abc")


def test_it_is_the_adjustment_of_all_of_them():
    interiors, covariances = drawn(np.random.default_rng(1))
    done = combine(interiors, covariances, "abc")
    x = [np.asarray(parameter_vector(interior))[FREE] for interior in interiors]
    unit = np.array([SIGMAS[n] for n in SIGMAS])
    rows, right = [], []
    for own, q in zip(x, covariances, strict=True):
        whitener = np.linalg.inv(np.linalg.cholesky(q[OWN]))
        rows.append(whitener * unit)
        right.append(whitener @ own)
    a, b = np.concatenate(rows), np.concatenate(right)
    solution, sum_of_squares, _, _ = np.linalg.lstsq(a, b)
    np.testing.assert_allclose(np.asarray(parameter_vector(done.interior))[FREE], unit * solution, rtol=1e-9)
    assert (done.chi_square, done.degrees_of_freedom) == (
        pytest.approx(float(sum_of_squares[0]), rel=1e-6),
        2 * len(FREE),
    )
    expected = np.linalg.inv(a.T @ a) * np.outer(unit, unit)
    np.testing.assert_allclose(done.covariance[OWN], expected, rtol=1e-7)
    assert not np.delete(done.covariance, FREE, axis=0).any()


def test_calibrations_that_agree_are_accused_as_seldom_as_said():
    rng, n = np.random.default_rng(2), 200
    done = [combine(*drawn(rng), "abc") for _ in range(n)]
    for level in (0.05, 0.5):
        spread = 4 * np.sqrt(level * (1 - level) / n)
        assert np.mean([one.p_value < level for one in done]) == pytest.approx(level, abs=spread)
    # Of three tests on the same numbers hardly two are independent.
    assert 0.01 < np.mean([bool(one.disagreeing(0.05)) for one in done]) < 0.09
    sigma = np.sqrt(np.diag(done[0].covariance)[FREE])
    off = [(np.asarray(parameter_vector(one.interior)) - TRUE)[FREE] / sigma for one in done]
    np.testing.assert_allclose(np.std(off, axis=0), 1, atol=4 / np.sqrt(2 * n))


def test_the_one_that_disagrees_is_named():
    done = combine(*drawn(np.random.default_rng(3), off=12.0), "abc")
    assert done.p_value < 1e-6
    assert np.argmin(done.against_others) == 2
    assert 2 in done.disagreeing(0.05)


def test_the_command_writes_a_prior(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "140")
    sets = [written_set(tmp_path / name, "gopro", v) for name, v in (("one", TARGET_1), ("two", TARGET_2))]
    out = tmp_path / "camera.toml"
    code, text, _ = run(monkeypatch, capsys, "combine", *sets, "--out", out)
    assert "they" in text and code in (0, 1)
    read = read_camera_file(out)
    assert float(get_parameter(read.interior, "c_mm")) == pytest.approx((2.6989 + 2.6987) / 2, abs=1e-9)
    np.testing.assert_allclose(
        np.sqrt(np.diag(read.covariance))[FREE], np.array(list(SIGMAS.values())) / np.sqrt(2), rtol=1e-9
    )


def test_what_cannot_be_combined_is_said(tmp_path, monkeypatch, capsys):
    interiors, covariances = drawn(np.random.default_rng(1))
    with pytest.raises(InputError, match="at least two calibrations"):
        combine(interiors[:1], covariances[:1], "a")
    held = covariances[1].copy()
    held[FREE[0]] = held[:, FREE[0]] = 0.0
    with pytest.raises(InputError, match="c_mm is fixed in b and estimated in a"):
        combine(interiors[:2], [covariances[0], held], "ab")
    sets = [written_set(tmp_path / name, "gopro", TARGET_1) for name in ("one", "two")]
    (sets[1] / "correlation.csv").unlink()
    code, _, error = run(monkeypatch, capsys, "combine", *sets, "--out", tmp_path / "camera.toml")
    assert (code, "two has no covariance" in error) == (2, True)
    code, _, error = run(monkeypatch, capsys, "combine", *sets, "--out", tmp_path / "camera.yml")
    assert (code, "only a .toml file can contain the covariance" in error) == (2, True)
