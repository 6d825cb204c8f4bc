"""The main job: what is compiled ahead is what statistics then use."""

import pytest

from jaxphoto.compiling import run
from jaxphoto.procedures import adjust_for_tables
from jaxphoto.report import Tables
from tests.blocks import simulated
from tests.marks import slow_but


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
