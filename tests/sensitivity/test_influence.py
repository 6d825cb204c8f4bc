"""Station bias, variance fractions and external reliability; tables and command."""

import dataclasses
import functools
import hashlib
import json

import equinox as eqx
import jax
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from jaxphoto import adjust, covariance, read_block
from jaxphoto.errors import InputError
from jaxphoto.observations import CameraPositions
from jaxphoto.report.sensitivity import SensitivityTables
from jaxphoto.sensitivity.exact import sensitivity
from jaxphoto.sensitivity.influence import Per, external_reliability, station_bias, variance_shares
from jaxphoto.statistics import redundancy_numbers
from jaxphoto.writing import MARKER
from jaxphoto_command import app
from tests.blocks import adjusted, simulated
from tests.checked_types import unchecked
from tests.test_examples import EXAMPLES


@functools.cache
def derivatives(name: str, curvature: bool = True):
    return sensitivity(adjusted(name), curvature=curvature, points=("p3",))


@functools.cache
def in_strips():
    """The cross block with its images in two strips, which does not affect the adjustment."""
    a = adjusted("cross")
    strips = ("a",) * 5 + ("b",) * 5
    return dataclasses.replace(a, block=dataclasses.replace(a.block, image_strip=strips))


def test_bias_of_a_strip_is_what_full_adjustments_show() -> None:
    """10 cm in height at the stations of strip b: the largest derivatives, and the change of two adjustments."""
    a = in_strips()
    result = station_bias(a, derivatives("cross"), "strip", 0.1)
    assert result.units == ("a", "b")
    moved = (np.asarray(a.block.stations.who) >= 5) & (np.asarray(a.block.stations.axis) == 2)

    def principal_distance(bias: float) -> float:
        stations = a.block.stations.value + bias * moved
        block = eqx.tree_at(lambda b: b.stations.value, adjusted("cross").block, stations)
        return float(adjust(block, a.unknowns).unknowns.interior["one"].c)

    expected = (principal_distance(0.1) - principal_distance(-0.1)) / 2
    assert result.change[derivatives("cross").row("interior[one].c_mm"), 1, 2] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("per", ["block", "image"])
def test_station_bias_by_block_and_image(per: Per) -> None:
    a = adjusted("cross")
    result = station_bias(a, derivatives("cross"), per, 0.1)
    assert result.units == (("block",) if per == "block" else a.block.images)
    total = result.change.sum(axis=1)
    whole = station_bias(a, derivatives("cross"), "block", 0.1).change[:, 0]
    np.testing.assert_allclose(total, whole, rtol=1e-9, atol=1e-12)
    # Stations and control contradict each other: part of a bias in height is absorbed by the principal distance.
    assert abs(whole[derivatives("cross").row("interior[one].c_mm"), 2]) > 1e-5


def test_variance_is_that_of_the_covariance_where_residuals_are_measurements() -> None:
    """Up to the distortion: residuals are of ideal coordinates, which it scales by some per cent."""
    shares = variance_shares(adjusted("cross"), derivatives("cross", False))
    cov = covariance(adjusted("cross"))
    variance = np.diagonal(cov.matrix)
    np.testing.assert_allclose(shares.variance[:-3], variance, rtol=0.1)
    total = sum(share.sum(axis=1) for share in shares.groups.values())
    np.testing.assert_allclose(total, 1.0, rtol=1e-12)
    assert set(shares.by_group) == set(derivatives("cross").groups)


@pytest.mark.slow
def test_shares_without_distortion_are_those_of_the_covariance() -> None:
    """For residuals of measured coordinates, A diag(sigma^2) A' is the covariance exactly."""
    block = simulated("fixed_interior").block
    nothing = jax.tree.map(lambda v: np.float64(0.0), block.start.unknowns.interior["one"].distortion)
    start = eqx.tree_at(lambda u: u.interior["one"].distortion, block.start.unknowns, nothing)
    a = adjust(block, start)
    shares = variance_shares(a, sensitivity(a, curvature=False, points=("p3",)))
    cov = covariance(a)
    expected = np.concatenate([np.diagonal(cov.matrix), np.diagonal(cov.points[block.points.index("p3")])])
    np.testing.assert_allclose(shares.variance, expected, rtol=1e-7)


def test_external_reliability_is_an_undetected_error_adjusted_in() -> None:
    """Readjust the block with an error of the size of the MDB in a control coordinate."""
    a = adjusted("cross")
    result = external_reliability(a, derivatives("cross", False))
    control = 4
    r = np.asarray(redundancy_numbers(a, covariance(a))["control_points"])[control]
    error = result.mdb["control_points"][control]
    assert error == pytest.approx(4.13 * 0.03 / np.sqrt(r), rel=1e-9)
    value = np.array(a.block.control.value)
    value[control] += error
    again = adjust(eqx.tree_at(lambda b: b.control.value, a.block, value), a.unknowns)
    row = derivatives("cross").row("interior[one].c_mm")
    moved = float(again.unknowns.interior["one"].c - a.unknowns.interior["one"].c)
    assert result.effect["control_points"][row, control] == pytest.approx(moved, rel=0.05)
    assert all((d > 0).all() for d in result.mdb.values())
    assert not any(np.isnan(e).any() for e in result.effect.values())
    # The normalised residual changes by delta0.
    change = (again.residuals["control_points"] - a.residuals["control_points"])[control] / np.sqrt(r)
    assert change == pytest.approx(4.13, rel=0.02)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (
            lambda a, d: station_bias(a, d, "camera"),
            "unknown unit camera of a station bias: choose among block, strip, image",
        ),  # type: ignore[arg-type]
        (lambda a, d: station_bias(a, d, "strip"), "no image with an observed station has a strip"),
        (lambda a, d: external_reliability(a, d, 0.0), "must be positive, got 0.0"),
        (lambda a, d: d.row("interior[one].k9"), "unknown estimate interior"),
    ],
)
def test_mistakes_get_a_sentence(call, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence), unchecked():
        call(adjusted("cross"), derivatives("cross"))


def test_bias_of_a_block_without_stations() -> None:
    a = adjusted("cross")
    a = dataclasses.replace(a, block=dataclasses.replace(a.block, stations=CameraPositions.none()))
    with pytest.raises(InputError, match="no observed stations"):
        station_bias(a, derivatives("cross"))


def test_tables_and_command(tmp_path) -> None:
    result = CliRunner().invoke(app, ["sensitivity", str(EXAMPLES / "cross_block"), "--out", str(tmp_path / "s")])
    assert result.exit_code == 0, result.output
    written = {path.name for path in (tmp_path / "s").iterdir()}
    assert written == {
        MARKER, "sensitivity.csv", "variance_shares.csv", "external_reliability.csv", "summary.json", "report.html",
    }  # fmt: skip
    page = (tmp_path / "s" / "report.html").read_text(encoding="utf-8")
    assert hashlib.sha256((EXAMPLES / "cross_block" / "image_points.csv").read_bytes()).hexdigest() in page
    assert "<td>jaxphoto sensitivity " in page and "--bias-m 0.1 --" in page and "<svg" in page
    assert page.count("<h2") == page.count('<a href="#') == 4
    bias = pd.read_csv(tmp_path / "s" / "sensitivity.csv")
    np.testing.assert_allclose(bias["exact"] - bias["first_order"], bias["difference"], atol=1e-15)
    assert set(bias["axis"]) == {"X", "Y", "Z"}
    for name in ("sensitivity", "external_reliability"):
        units = pd.read_csv(tmp_path / "s" / f"{name}.csv").set_index("estimate")["estimate_unit"].to_dict()
        assert units["interior[kodak].c_mm"] == "mm" and units["interior[kodak].k1"] == "1/mm^2"
        assert units[next(label for label in units if label.startswith("points["))] == "m"
    shares = pd.read_csv(tmp_path / "s" / "variance_shares.csv")
    np.testing.assert_allclose(shares.groupby("estimate")["share"].sum(), 1.0)
    summary = json.loads((tmp_path / "s" / "summary.json").read_text(encoding="utf-8"))
    assert summary["bias_m"] == 0.1
    assert "interior[kodak].c_mm" in summary["interior"]
    tables = SensitivityTables(adjust(read_block(EXAMPLES / "cross_block")), "block", 0.1)
    # Sigmas and external reliability are those of the tables of the adjustment.
    own, sigma = tables.tables, tables.tables.interior.set_index("parameter")["sigma"]
    assert tables.sigma["interior[kodak].c_mm"] == pytest.approx(sigma["c_mm"], rel=1e-12)
    largest = tables.external_reliability.set_index(["estimate", "group"])["effect_over_sigma"].abs()
    control = own.residuals[own.residuals["group"] == "control_points"]
    for name in ("c", "xp", "yp"):
        effect = largest[f"interior[kodak].{name}_mm", "control_points"]
        assert effect == pytest.approx(control[f"{name}_moves"].max(), rel=0.01)
    assert len(tables.check) == 20
    assert len(tables.bias) == 3 * (5 + 60)
