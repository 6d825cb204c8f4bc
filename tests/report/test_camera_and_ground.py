"""Reports of lens priors, correlated residuals, rolling shutter, camera and ground, duplicates and convergence."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

import jaxphoto
from jaxphoto import FREE, InputError, Outcome, Tables, Weighted, report
from jaxphoto.adjustment.iteration_log import step_lines
from jaxphoto.camera import Brown, InteriorOrientation, set_parameter
from jaxphoto.camera.lens_prior import lens_prior, prior_sigmas
from jaxphoto.observations import KnownParameters
from jaxphoto.procedures.known_lens import KnownLens, contradicted_prior, with_known_lens
from jaxphoto.report.results import convergence_words
from jaxphoto.report.tables import convergence_table, side_by_side
from jaxphoto.report.verdict import lens_findings, shutter_findings
from jaxphoto.statistics import correlated_noise
from tests.blocks import SENSOR, adjusted, simulated

LENS = KnownLens(InteriorOrientation(35.0, 0.0, 0.0, Brown()), lens_prior("Canon", "Canon EOS 5D"), 0.01)


def stub(adjustment, **tables):
    """Tables with numbers of our own."""
    made = Tables(adjustment)
    made.__dict__ |= tables
    return made


def test_all_that_is_estimated_is_observed_and_an_earlier_calibration_counts_more():
    block = adjusted("cross").block
    given = with_known_lens(block, "one", LENS)
    sigma = prior_sigmas(LENS.prior, LENS.nominal, SENSOR, 0.01)
    assert given.priors.interior["one"].c.value == 35.0
    assert given.priors.interior["one"].c.sigma == sigma["c_mm"] == pytest.approx(35 * np.hypot(0.02, 0.01))
    assert given.priors.interior["one"].distortion.k1.sigma == sigma["k1"]
    assert given.priors.interior["one"].distortion.p1 == block.priors.interior["one"].distortion.p1
    known = KnownParameters(["interior[one].c_mm"], np.array([35.1]), np.array([[1e-6]]))
    assert with_known_lens(dataclasses.replace(block, more=(known,)), "one", LENS).priors is block.priors
    said = " ".join(LENS.sentences(block, "one"))
    assert "interchangeable lenses" in said and "no published figure" in said and "2.2 %" in said
    assert "earlier calibration" in said


def test_a_focal_length_of_another_format_is_not_used():
    """With a prior of c far from what control and stations give, c is estimated as if it were free."""
    found = adjusted("cross")
    block = with_known_lens(found.block, "one", LENS)
    true = jaxphoto.adjust(block)
    assert contradicted_prior(true, correlated_noise(true), "one") is None
    c, sigma = float(LENS.nominal.c), float(block.priors.interior["one"].c.sigma)
    free = set_parameter(block.priors.interior["one"], "c_mm", FREE)
    wrong = set_parameter(free, "c_mm", Weighted(c + 10 * sigma, sigma))
    priors = {name: dataclasses.replace(block.priors, interior={"one": p}) for name, p in (("f", free), ("w", wrong))}
    right = jaxphoto.adjust(dataclasses.replace(block, priors=priors["f"]))
    pulled = jaxphoto.adjust(dataclasses.replace(block, priors=priors["w"]))
    one = contradicted_prior(pulled, correlated_noise(pulled), "one")
    free_sigma = float(jaxphoto.covariance(right).of_interior("one", ["c_mm"])[0, 0]) ** 0.5
    assert one is not None and one.parameter == "c_mm"
    assert one.value == pytest.approx(float(right.unknowns.interior["one"].c), abs=0.3 * free_sigma)
    again = with_known_lens(found.block, "one", LENS, ["c_mm"]).priors.interior["one"]
    assert again.c == found.block.priors.interior["one"].c and again.distortion.k1.sigma > 0


def test_a_block_that_does_not_tell_c_is_warned_of():
    found = adjusted("cross")
    block = with_known_lens(found.block, "one", LENS)
    prior, tables = block.priors.interior["one"].c, {}
    known = float(prior.sigma)
    for share, code in ((0.9, "lens_prior_only"), (0.1, "lens_prior")):
        row = {"camera": ["one"], "parameter": ["c_mm"], "value": [float(prior.value) - 2.5 * known]}
        tables["interior"] = pd.DataFrame(row | {"sigma": [share * known]})
        (finding,) = lens_findings(stub(dataclasses.replace(found, block=block), **tables))
        assert (finding.code, finding.value, finding.limit) == (code, share * known, known)
    assert finding.numbers["ratio"] == pytest.approx(2.5) and finding.numbers["change"] == pytest.approx(-2.5 * known)
    assert list(lens_findings(stub(found, **tables))) == []


def test_a_readout_is_told_with_its_direction():
    rows = [("shutters[one].readout_ms", -30.2, 0.5), ("shutters[two].readout_ms", 0.4, 0.3), ("mounts[m].x_m", 1, 1)]
    table = pd.DataFrame(rows, columns=["parameter", "value", "sigma"])
    one, two = shutter_findings(stub(adjusted("cross"), georeferencing=table))
    assert one.code == "rolling_shutter" and "30.2 +- 0.5 ms (last row first)" in one.text
    assert (two.code, two.subject) == ("no_rolling_shutter", "camera two")


def test_the_table_of_the_ground():
    table = Tables(adjusted("cross")).correlation_ground
    assert set(table.ground) == {"height", "flying_height", "dome"}
    assert set(table.parameter) >= {"c_mm", "k1", "all"}
    together = table[table.parameter == "all"].set_index("ground").rho
    largest = table[table.parameter != "all"].assign(size=lambda t: t.rho.abs()).groupby("ground")["size"].max()
    assert (together >= largest[together.index] - 1e-9).all() and (together <= 1).all()


def test_side_by_side_stands_what_the_long_table_says():
    table = Tables(adjusted("cross")).correlation_summary
    wide = side_by_side(table, ["camera", "exterior"], "interior", "max_abs_rho")
    assert wide.columns.tolist()[:4] == ["exterior", "c", "x_p", "y_p"]
    assert wide["exterior"].tolist() == table["exterior"].unique().tolist()
    one = table[(table["exterior"] == "omega") & (table["interior"] == "yp_mm")]["max_abs_rho"].item()
    assert wide.set_index("exterior").loc["omega", "y_p"] == one


def test_sigma_naught_falls_from_that_of_the_start_to_that_of_the_optimum():
    result = adjusted("cross")
    table = convergence_table(result)
    assert len(table) == int(result.steps) + 1 and table["step"].iloc[-1] == "end"
    assert table["sigma0"].iloc[-1] == pytest.approx(float(result.sigma0))
    assert (np.diff(table["sigma0"]) <= 1e-9).all()
    lines = list(step_lines(result))
    assert lines[0].startswith("step 1: sigma naught") and "moves" in lines[0] and "moves" not in lines[-1]
    assert lines[-1] == f"end: sigma naught {float(result.sigma0):.6g}"
    # One step from the start leads to where the second begins.
    one = jaxphoto.adjust(simulated("cross").block, max_steps=1)
    assert one.history.sum_of_squares[0] == pytest.approx(result.history.sum_of_squares[0])
    assert float(one.sum_of_squares) == pytest.approx(result.history.sum_of_squares[1], rel=1e-6)
    assert "1 step, the maximum (--max-steps)" in convergence_words(one) and one.outcome is Outcome.STEPS


def test_the_last_step_is_shorter_than_what_ends_an_adjustment():
    result = adjusted("cross")
    last = result.history.length[-1]
    assert 0 <= last < 1e-4 and (result.history.length[:-1] > last).all()
    assert f"by more than {last:.1e} of its standard deviation" in convergence_words(result)


def test_without_iterations_nothing_is_reported():
    without = dataclasses.replace(adjusted("cross"), history=None)
    assert convergence_table(without).empty and convergence_words(without) == ""
    with pytest.raises(InputError, match="adjust the block to draw its convergence"):
        report.plot_convergence(Tables(without))
