"""Plots of flights, strips, sensitivity and draws on given axes have the numbers of their tables."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from jaxphoto import InputError
from jaxphoto.lidar.strip_planes import Raster
from jaxphoto.report import plot_draws, plot_effects, plot_position_offsets, plot_sensitivity, plot_strip_differences
from jaxphoto.report.formatting import without_empty
from jaxphoto.report.sensitivity import SensitivityTables
from tests.blocks import adjusted
from tests.report.flights import part_report


@pytest.fixture
def axes():
    return Figure().add_subplot()


def test_offsets_are_recorded_minus_adjusted_less_their_mean(axes):
    report = part_report()
    plan = plot_position_offsets(report, axes)
    assert any(np.abs(child.U).max() > 5 for child in plan.get_children() if isinstance(child, Quiver) and len(child.U))
    with pytest.raises(InputError, match="no recorded position of this part is used"):
        plot_position_offsets(report._replace(part=report.part._replace(placed=None)), axes)


def test_gaps_of_strips_are_drawn_in_centimetres(axes):
    gaps = Raster(np.random.default_rng(3).normal(0, 0.1, (20, 30)), 0.0, 20.0, 1.0)
    assert plot_strip_differences(gaps, axes, limit_m=0.3) is axes and axes.images[0].get_clim() == (-30, 30)
    np.testing.assert_allclose(axes.images[0].get_array(), 100 * gaps.heights)


def test_a_sensitivity_is_drawn_as_its_table_says(axes):
    tables = SensitivityTables(adjusted("cross"), "block", 0.1)
    plot_sensitivity(tables, "c_mm", axes)
    own = tables.bias[tables.bias["estimate"] == "interior[one].c_mm"]
    heights = [bar.get_height() for bar in axes.patches]
    np.testing.assert_allclose(heights, np.concatenate([own[n] for n in ("exact", "first_order", "difference")]))
    assert axes.get_legend_handles_labels()[1] == ["exact", "first order", "difference"]
    with pytest.raises(InputError, match=r"unknown estimate 'k9'; use one of c_mm; .*check points, X"):
        plot_sensitivity(tables, "k9")


def test_what_is_empty_in_all_rows_is_no_column():
    table = pd.DataFrame({"cut": [1, 2], "problem": ["", ""], "none": [np.nan] * 2, "note": ["", "x"]})
    assert list(without_empty(table)) == ["cut", "note"] and list(without_empty(table[:0])) == list(table)


def test_draws_and_effects_are_those_of_their_files(axes):
    rng = np.random.default_rng(2)
    draws = pd.DataFrame({"one.c_mm": 35 + rng.normal(0, 0.01, 400)})
    summary = pd.DataFrame({"quantity": ["one.c_mm"], "nominal": [35.0], "predicted_sigma": [0.01]})
    assert plot_draws(draws, summary, "one.c_mm", axes) is axes
    area = sum(bar.get_height() * bar.get_width() for bar in axes.patches)
    assert area == pytest.approx(1.0)
    assert max(axes.lines[1].get_ydata()) == pytest.approx(1 / 0.01 / np.sqrt(2 * np.pi), rel=1e-3)
    with pytest.raises(InputError, match=r"unknown quantity 'c' of the draws; use one of one\.c_mm"):
        plot_draws(draws, summary, "c", axes)
    effects = pd.DataFrame({"error": ["A X", "A Y"], "one.c_mm": [0.005, -0.002]})
    shown = plot_effects(effects, summary, ["one.c_mm"], Figure().add_subplot()).images[0]
    np.testing.assert_allclose(np.asarray(shown.get_array()).ravel(), [0.5, -0.2])
    with pytest.raises(InputError, match="unknown quantity 'k1' of the effects"):
        plot_effects(effects, summary, ["k1"])
