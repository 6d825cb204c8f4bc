"""The block of a joint adjustment on disk: read again it is the same, and mistakes in it are named."""

import functools

import numpy as np
import pytest

from jaxphoto import JaxphotoError, adjust, bias, covariance, read_block, write_block
from jaxphoto.procedures.lidar.iterate_to_convergence import at_result
from tests.commands import run
from tests.procedures.joint import fitted


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("joint") / "block"
    result = fitted().adjusted
    write_block(at_result(result.block, result.unknowns), path)
    return path


@functools.cache
def read(folder):
    return read_block(folder)


def test_the_block_comes_back_and_adjusts_to_the_same(folder):
    before = fitted().adjusted
    after = adjust(read(folder))
    labels = before.structure.labels
    assert after.structure.labels == labels
    assert after.redundancy == before.redundancy
    sigma = np.asarray(fitted().covariance.shared_sigma)
    one, other = (np.asarray(a.values.shared)[a.structure.free] for a in (before, after))
    # Both ended within a hundred-thousandth of a standard deviation of the optimum, and far nearer in fact.
    np.testing.assert_allclose((other - one) / sigma, 0.0, atol=1e-6)
    np.testing.assert_allclose(covariance(after).shared_sigma, sigma, rtol=1e-9)
    for name, rows in before.block.named_observations.items():
        assert len(after.block.named_observations[name]) == len(rows)
    assert list(read(folder).start.unknowns.more["trajectory_knots"]) == list(before.unknowns.more["trajectory_knots"])
    assert bias(read(folder), "trajectory", 0.1, "strip").names[:3] == ("1.X_m", "1.Y_m", "1.Z_m")


@pytest.mark.parametrize(
    ("file", "old", "new", "match"),
    [
        ("trajectory_stations.csv", ",0,", ",3,", r"row 2: axis is 3; it is 0, 1 or 2"),
        ("position_steps.csv", "1 at ", "7 at ", r"row 2: trajectory_knots 7 at .* is none of the trajectory_knots"),
    ],
)
def test_mistakes_are_named(folder, tmp_path, file, old, new, match):
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in folder.glob("[!.]*"):
        text = path.read_text()
        if path.name == file:
            assert old in text
            text = text.replace(old, new, 1)
        (copy / path.name).write_text(text)
    with pytest.raises(JaxphotoError, match=match):
        read_block(copy)


@pytest.mark.slow
def test_commands_take_the_block(folder, tmp_path, monkeypatch, capsys):
    given = ("--bias", "trajectory", "--per", "strip", "--sigma-m", "0.05", "--draws", "20")
    code, said, _ = run(monkeypatch, capsys, "monte-carlo", folder, *given, "--out", tmp_path / "draws")
    assert code == 0 and "20 draws, 20 converged" in said
    assert run(monkeypatch, capsys, "sensitivity", folder, "--out", tmp_path / "sensitivity")[0] == 0
