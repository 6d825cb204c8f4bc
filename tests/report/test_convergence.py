"""How an adjustment converged is told as it was."""

import dataclasses

import numpy as np
import pytest

import jaxphoto
from jaxphoto import InputError, Outcome, Tables, report
from jaxphoto.adjustment.iteration_log import step_lines
from jaxphoto.report.results import convergence_words
from jaxphoto.report.tables import convergence_table
from tests.blocks import adjusted, simulated


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
    assert "1 step, which is the limit (--max-steps)" in convergence_words(one) and one.outcome is Outcome.STEPS


def test_the_last_step_is_shorter_than_what_ends_an_adjustment():
    result = adjusted("cross")
    last = result.history.length[-1]
    assert 0 <= last < 1e-4 and (result.history.length[:-1] > last).all()
    assert f"by more than {last:.1e} of its standard deviation" in convergence_words(result)


def test_where_nothing_was_iterated_nothing_is_told():
    without = dataclasses.replace(adjusted("cross"), history=None)
    assert convergence_table(without).empty and convergence_words(without) == ""
    with pytest.raises(InputError, match="adjust the block to draw its convergence"):
        report.plot_convergence(Tables(without))
