"""The main job: what is compiled ahead is what statistics then use."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarks.basin import far_off
from jaxphoto import adjust, read_block
from jaxphoto.compiling import run
from jaxphoto.procedures import adjust_for_tables
from jaxphoto.report import Tables, verdict_of
from tests.blocks import simulated
from tests.marks import slow_but

EXAMPLE = Path(__file__).parents[2] / "examples" / "cross_block"


@pytest.mark.parametrize("name", slow_but(("cross",), ("cross", "inner", "mount")))
def test_what_is_compiled_meanwhile_serves_the_tables(name, monkeypatch):
    monkeypatch.setattr(run, "_programs", {})
    monkeypatch.setattr(run, "_prepared", {})
    adjusted = adjust_for_tables(simulated(name).block)
    ahead = {key[0].__name__ for key in run._prepared}
    assert {"_covariance", "_row_variances"} <= ahead
    tables = Tables(adjusted)
    tables.covariance, tables.redundancy  # noqa: B018
    assert not run._prepared
    # What the verdict has compiled in the background is what it runs.
    verdict_of(tables)
    assert not run._prepared


def test_approximate_values_that_lead_nowhere_are_not_the_last_word():
    """Off by up to 100 m, 10 degrees and 10 % of c: points fly away, but the images know how they lie."""
    block, rng = read_block(EXAMPLE), np.random.default_rng(1)
    best = adjust(block)
    for _ in range(6):
        spoilt = far_off(block, rng)
    with pytest.warns(UserWarning, match="lead nowhere"):
        found = adjust(spoilt)
    assert bool(found.converged)
    np.testing.assert_allclose(float(found.square_sum), float(best.square_sum), rtol=1e-6)


def test_images_that_are_given_upside_down_are_oriented_by_their_points():
    """omega off by 180 degrees, as between conventions: all points lie behind."""
    block = read_block(EXAMPLE)
    best = adjust(block)
    start = block.start
    exterior = best.unknowns.exterior
    turned = np.diag([1.0, -1.0, -1.0]) @ np.asarray(exterior.camera_from_object)
    exterior = dataclasses.replace(exterior, camera_from_object=turned)
    unknowns = dataclasses.replace(start.unknowns, exterior=exterior)
    known = np.ones(len(block.images), bool)
    spoilt = dataclasses.replace(block, start=dataclasses.replace(start, unknowns=unknowns, image_known=known))
    with pytest.warns(UserWarning, match="lead nowhere"):
        found = adjust(spoilt)
    np.testing.assert_allclose(float(found.square_sum), float(best.square_sum), rtol=1e-6)
