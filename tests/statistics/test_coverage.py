"""What a block shows of the ground, as numbers."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxphoto.report.plots import draw_overlap
from jaxphoto.statistics.coverage import Coverage, coverage
from tests.blocks import adjusted


def test_the_area_of_a_map_of_one_row():
    found = Coverage(np.ones(1), np.ones(1), np.array([1.0, 3.0, 5.0]), np.zeros(1), np.array([[0, 2, 3]]), 2.0)
    assert found.area_m2(1) == 8.0 and found.area_m2(3) == 4.0


def test_cells_are_as_far_apart_as_they_are_wide():
    found = coverage(adjusted("cross"))
    np.testing.assert_allclose(np.diff(found.x), found.step_m)
    np.testing.assert_allclose(np.diff(found.y), found.step_m)
    assert found.area_m2(0) == pytest.approx(len(found.x) * len(found.y) * found.step_m**2)


def test_a_map_of_one_row_is_drawn_as_wide_as_its_cells():
    a = adjusted("cross")
    found = coverage(a)
    axes = Figure().subplots()
    draw_overlap(axes, found._replace(y=found.y[:1], seen_by=found.seen_by[:1]), a)
    box = axes.collections[0].get_datalim(axes.transData)
    assert box.height == pytest.approx(found.step_m) and box.width == pytest.approx(len(found.x) * found.step_m)
