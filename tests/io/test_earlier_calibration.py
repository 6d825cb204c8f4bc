"""An earlier calibration as prior information with its covariance."""

import shutil

import equinox as eqx
import jax
import numpy as np
import pytest

from jaxphoto import adjust, covariance, read_block, write_block
from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.io.toml import read_toml
from jaxphoto.simulation import remeasure
from tests.blocks import FIVE, measured, simulated
from tests.commands import run
from tests.io.conftest import write_calibration


def values_of(adjusted):
    return np.array([float(get_parameter(adjusted.unknowns.interior["one"], name)) for name in FIVE])


@pytest.fixture(scope="module")
def years(tmp_path_factory):
    """The block of this year and the results of last year, and a function that changes the camera of the block."""
    folder = tmp_path_factory.mktemp("years")
    sound = simulated("cross")
    this = measured(sound).block
    last = jax.tree.map(
        lambda v: np.asarray(v) if isinstance(v, jax.Array) else v, remeasure(*sound, jax.random.key(77))
    )
    write_block(this, folder / "this")
    write_block(last, folder / "last")
    return folder


@pytest.fixture(scope="module")
def results(years):
    write_calibration(read_block(years / "last"), years / "results")
    return years / "results"


def with_camera(years, name, table):
    """This year's block with another table of the camera."""
    folder = years / name
    shutil.copytree(years / "this", folder, ignore=shutil.ignore_patterns(".jaxphoto.json"))
    lines = (folder / "block.toml").read_text().splitlines()
    begin = lines.index("[cameras.one]")
    end = next((k for k in range(begin, len(lines)) if lines[k].startswith("[") and "cameras" not in lines[k]), None)
    (folder / "block.toml").write_text("\n".join([*lines[:begin], table, *(lines[end:] if end else [])]))
    return folder


def test_the_prior_adds_its_information(years, results):
    """(Q1^-1 + Q2^-1)^-1 and the weighted mean, whatever way the calibration is named."""
    folder = with_camera(years, "named", '[cameras.one]\ncalibration = "../results"\nresiduals = "measured"')
    block = read_block(folder)
    alone, both = adjust(read_block(years / "this")), adjust(block)
    earlier = read_camera_file(results)
    names = parameter_names(earlier.interior)
    which = [names.index(name) for name in FIVE]
    before = np.array([float(get_parameter(earlier.interior, name)) for name in FIVE])
    own = covariance(alone).of_interior("one", FIVE) / float(alone.sigma0) ** 2
    weights = np.linalg.inv(own), np.linalg.inv(earlier.covariance[np.ix_(which, which)])
    expected = np.linalg.inv(weights[0] + weights[1])
    sigma = np.sqrt(np.diag(expected))
    found = covariance(both).of_interior("one", FIVE) / float(both.sigma0) ** 2
    assert np.abs((found - expected) / np.outer(sigma, sigma)).max() < 0.02
    mean = expected @ (weights[0] @ values_of(alone) + weights[1] @ before)
    assert np.abs((values_of(both) - mean) / sigma).max() < 0.1
    # Written and read again it is the same adjustment.
    write_block(block, years / "again")
    np.testing.assert_allclose(values_of(adjust(read_block(years / "again"))), values_of(both), rtol=1e-9)


def test_a_camera_file_keeps_the_covariance(years, results, monkeypatch, capsys):
    out = years / "camera.toml"
    assert run(monkeypatch, capsys, "camera", results, out)[0] == 0
    one, other = read_camera_file(results), read_camera_file(out)
    sigma = np.sqrt(np.diag(one.covariance))
    np.testing.assert_allclose(other.covariance, one.covariance, atol=1e-12 * sigma.max() ** 2)
    named = with_camera(years, "by_file", '[cameras.one]\ncalibration = { file = "../camera.toml", camera = "one" }')
    pasted = with_camera(years, "pasted", out.read_text())
    first, second = (read_block(folder).more[0] for folder in (named, pasted))
    assert first.labels == second.labels == tuple(f"interior[one].{name}" for name in FIVE)
    np.testing.assert_allclose(first.value, second.value, rtol=1e-12)
    np.testing.assert_allclose(first.covariance, second.covariance, rtol=1e-9)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ('calibration = "../this"', "has no covariance; give a result folder of jaxphoto adjust, or a camera file"),
        ('calibration = "../nothing"', "file not found"),
        (
            'calibration = "../results"\nwidth_px = 3',
            "width_px: already given by the calibration, which permits only residuals, unknowns",
        ),
        ('calibration = "../results"\n[cameras.one.unknowns]\nc_mm = "fixed"', "it has prior information in"),
    ],
)
def test_invalid_calibrations_are_refused(years, results, table, sentence):
    name = f"bad{abs(hash(table))}"
    folder = with_camera(years, name, f"[cameras.one]\n{table}")
    with pytest.raises(InputError, match=sentence.replace("(", r"\(")):
        read_block(folder)
    assert "calibration" in read_toml(folder / "block.toml")["cameras"]["one"]


@pytest.mark.slow
def test_the_posterior_covers_the_truth(years):
    """Two years simulated again and again: sigmas of the second, with the first as its prior, are the scatter."""
    from jaxphoto import KnownParameters

    block, truth = simulated("cross")
    true = np.array([float(get_parameter(truth.interior["one"], name)) for name in FIVE])
    off = []
    for seed in range(150):
        pair = [remeasure(block, truth, jax.random.key(2 * seed + k)) for k in (0, 1)]
        first, second = jax.tree.map(lambda v: np.asarray(v) if isinstance(v, jax.Array) else v, pair)
        last = adjust(first, truth)
        prior = KnownParameters(
            [f"interior[one].{name}" for name in FIVE], values_of(last), covariance(last).of_interior("one", FIVE)
        )
        this = adjust(eqx.tree_at(lambda b: b.start.unknowns, second, truth), truth, more=(prior,))
        q = covariance(this).of_interior("one", FIVE)
        off.append((values_of(this) - true) / np.sqrt(np.diag(q)))
    inside = (np.abs(off) < 1.96).mean()
    # Five parameters that are correlated: as two hundred independent ones at least.
    assert inside == pytest.approx(0.95, abs=3 * np.sqrt(0.95 * 0.05 / 200))
