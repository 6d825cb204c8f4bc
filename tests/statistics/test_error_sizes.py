"""Large errors in observations are estimated as unknowns of a repeated adjustment."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import Tables, adjust
from jaxphoto.statistics import error_sizes
from tests.blocks import adjusted_example, example


@pytest.mark.parametrize("size", [0.5, 5.0, 50.0])
def test_the_size_of_a_common_shift_is_that_of_an_adjustment_that_estimates_it(size):
    block = example()
    rows = block.stations
    value = np.asarray(rows.value) + np.where(rows.axis == 2, size, 0.0)
    wrong = adjust(block.with_observations({"stations": dataclasses.replace(rows, value=value)}))
    (common,) = (t.pattern for t in Tables(wrong).tested_trends if t.pattern.group == "stations")
    height = next(term for term in common.terms if term.name == "Z")
    found = error_sizes(wrong, (), [(common, height)])
    true = error_sizes(adjusted_example(), (), [(common, height)])
    amount, sigma = found.terms["stations as a whole", "Z"]
    own, own_sigma = true.terms["stations as a whole", "Z"]
    # The noise of the block is the same: the estimates differ by the shift, up to the tolerance of the iteration.
    assert amount - own == pytest.approx(size, abs=0.1 * sigma)
    assert sigma == pytest.approx(own_sigma, rel=0.02)


def test_large_errors_of_two_observations_are_estimated_together():
    block, true = example(), {("T11", 2): 40.0, ("T3", 0): -25.0}
    control, value = block.control, np.array(block.control.value)
    for (point, axis), error in true.items():
        value[(control.who == block.points.index(point)) & (control.axis == axis)] += error
    wrong = adjust(block.with_observations({"control_points": dataclasses.replace(control, value=value)}))
    tables = Tables(wrong)
    found = error_sizes(wrong, tables.culprits)
    own = error_sizes(adjusted_example(), tables.culprits).suspects
    for (group, row, number), (size, sigma) in found.suspects.items():
        name = block.points[control.who[row]]
        noise, own_sigma = own[group, row, number]
        assert size - noise == pytest.approx(true[name, int(control.axis[row])], abs=0.1 * sigma)
        assert sigma == pytest.approx(own_sigma, rel=0.02)
    assert len(found.suspects) == len(true)
