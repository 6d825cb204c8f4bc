"""What is printed of lens priors, rays that err alike, a rolling shutter, and the camera with the ground."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from jaxphoto import FREE, Tables, Weighted
from jaxphoto.camera import Brown, InteriorOrientation, set_parameter
from jaxphoto.camera.lens_prior import lens_prior, prior_sigmas
from jaxphoto.observations import KnownParameters
from jaxphoto.procedures.known_lens import KnownLens, with_known_lens
from jaxphoto.report.tables import with_correlated_sigma
from jaxphoto.report.verdict import lens_findings, shutter_findings
from tests.blocks import SENSOR, adjusted

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
    assert "an earlier calibration says more" in said


def test_rays_that_err_alike_widen_what_they_say_and_not_what_was_known():
    found = adjusted("cross")
    priors = set_parameter(found.block.priors.interior["one"], "c_mm", Weighted(35.0, 0.02))
    priors = set_parameter(priors, "k1", FREE)
    block = dataclasses.replace(found.block, priors=dataclasses.replace(found.block.priors, interior={"one": priors}))
    rows = [("one", "c_mm", 35.0, 0.012), ("one", "k1", 1e-5, 1e-6), ("one", "p1", 0.0, np.nan)]
    table = pd.DataFrame(rows, columns=["camera", "parameter", "value", "sigma"])
    wide = with_correlated_sigma(table, dataclasses.replace(found, block=block), 2.0).set_index("parameter").sigma_alike
    # 1 / 0.012^2 = 1 / 0.02^2 + 1 / 0.015^2; the rays' 0.015 become 0.030.
    assert wide["c_mm"] == pytest.approx(1 / np.sqrt(1 / 0.02**2 + 1 / 0.03**2))
    assert wide["k1"] == pytest.approx(2e-6) and np.isnan(wide["p1"])


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
