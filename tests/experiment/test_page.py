"""Pages of experiments: names, digits, tables and plots agree with tables.csv."""

import re

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from jaxphoto import Tables
from jaxphoto.experiment import Experiment, Run, comparison_figure, plot_agreement, plot_comparison, side_by_side
from jaxphoto.experiment.page import (
    cell_words,
    experiment_page,
    far_apart,
    heading,
    not_judged,
    printed_table,
    table_title,
)
from tests.blocks import adjusted

NAN = np.nan
COLUMNS = ["table", "row", "column", "published", "ours", "unit", "tolerance", "within", "note", "spread", "n_layouts"]
COMPARISON = pd.DataFrame(
    [
        ("table2_iops", "first", "c_mm", 34.25, 34.24812, "mm", NAN, "", "the truth", 0.0021, 4),
        ("table2_iops", "first", "sigma_k1_mm-2", 3.75e-7, 4.1e-7, "mm^-2", 0.2e-7, "no", "", 1.2e-8, 4),
        ("table2_iops", "third", "c_mm", 34.249, 34.2, "mm", NAN, "", "the truth", NAN, 1),
        ("table2_iops", "third", "sigma_k1_mm-2", 3.7e-7, 3.8e-7, "mm^-2", 0.2e-7, "yes", "only here", 1e-9, 4),
        ("table2_iops", "all", "mean_abs_difference", 0.0, 0.02, NAN, 0.03, "yes", "mean of all", NAN, 4),
        ("own", "first", "n_check_points", NAN, 20.0, NAN, NAN, "", "", 0.0, 4),
    ],
    columns=COLUMNS,
)


@pytest.mark.parametrize(
    ("name", "title"), [("table2_iops", "Table 2: iops"), ("agreement", "Agreement"), ("table12_a_b", "Table 12: a b")]
)
def test_tables_have_titles(name, title):
    assert table_title(name) == title


def test_a_table_holds_both_values_units_and_judgement():
    cells = COMPARISON[COMPARISON["table"] == "table2_iops"]
    assert [cell_words(cell) for cell in cells.to_dict("records")[:3]] == [
        ("34.2481 +- 0.0021", "34.25"), ("4.10e-07 +- 1.2e-08", "3.75e-07 (+- 2e-08)"), ("34.2", "34.249"),
    ]  # fmt: skip
    assert heading("c_mm", "mm") == "c [mm]" and heading("xH", "um") == "xH [um]" and heading("c", NAN) == "c"
    table = printed_table(cells).set_index("row")
    assert table.index.tolist() == ["first", "third", "all"] and "c [mm]" in table
    assert 'class="no"' in table.loc["first", "sigma k1 mm-2 [mm^-2]"] and "✗" in table.loc["first"].iloc[1]


def test_values_without_tolerance_are_counted_and_compared():
    reasons = not_judged(COMPARISON)
    assert reasons[["reason", "values"]].to_numpy().tolist() == [["the truth", 2]]
    names = ["rmse_dZ_m", "rmse_dX_m", "mean_dZ_m", "expected_rmse_dZ_m", "rmse_dY_m"]
    ours, printed = [0.134, 0.04, 0.03, 0.15, NAN], [0.054, 0.03, 0.001, NAN, 0.033]
    cells = pd.DataFrame({"table": "table5", "row": "a", "column": names, "ours": ours, "published": printed})
    cells = cells.assign(unit="m", tolerance=NAN, within="", note="", spread=0.01)
    far = far_apart(cells)
    assert far[["column", "expected"]].to_numpy().tolist() == [["rmse_dZ_m", 0.15]]
    assert far["ratio"].iloc[0] == pytest.approx(0.134 / 0.054)
    assert dict(zip(not_judged(cells)["reason"], not_judged(cells)["values"], strict=True)) == {
        "no tolerance is published": 3, "not computed": 1,
    }  # fmt: skip
    assert 'class="far"' in printed_table(cells).loc[0, "rmse dZ [m]"]


def test_side_by_side_keeps_the_order_of_the_print():
    wide = side_by_side(COMPARISON, "table2_iops")
    assert wide.index.tolist() == ["first", "third", "all"]
    assert wide.columns.tolist()[:4] == [(c, of) for c in ("c_mm", "sigma_k1_mm-2") for of in ("published", "ours")]
    assert wide.loc["third", ("c_mm", "ours")] == 34.2
    assert side_by_side(COMPARISON, "own").columns.tolist() == [("n_check_points", "ours")]
    with pytest.raises(ValueError, match="its tables are table2_iops, own"):
        side_by_side(COMPARISON, "table9")


def test_comparison_figure_draws_ours_and_the_print():
    figure = comparison_figure(COMPARISON, "table2_iops")
    c, k1, _ = figure.axes
    assert c.get_title() == "c [mm]"
    printed, ours = [container.lines[0] for container in k1.containers]
    np.testing.assert_allclose(printed.get_xdata(orig=False), [3.75e-7, 3.7e-7])
    np.testing.assert_allclose(ours.get_xdata(orig=False), [4.1e-7, 3.8e-7])
    assert [label.get_text() for label in c.get_yticklabels()] == ["first", "third", "all"]
    figure.draw_without_rendering()
    with pytest.raises(ValueError, match="no cell is both printed and computed"):
        comparison_figure(COMPARISON, "own")


def test_plots_take_and_return_axes():
    axes = Figure().add_subplot()
    assert plot_agreement(COMPARISON, axes) is axes
    # (4.1 - 3.75) / 0.2, (3.8 - 3.7) / 0.2, 0.02 / 0.03: the first is beyond.
    within, beyond = axes.lines
    np.testing.assert_allclose(np.sort(within.get_xdata()), [0.5, 2 / 3])
    np.testing.assert_allclose(beyond.get_xdata(), [1.75])
    with pytest.raises(ValueError, match="no cell that is both printed and computed has a tolerance"):
        plot_agreement(COMPARISON[COMPARISON["table"] == "own"], axes)
    one = plot_comparison(COMPARISON, "table2_iops", "sigma_k1_mm-2", Figure().add_subplot())
    _, ours = [container.lines[0] for container in one.containers]
    np.testing.assert_allclose(ours.get_xdata(orig=False), [4.1e-7, 3.8e-7])
    with pytest.raises(ValueError, match=r"'table2_iops': column 'c' .* choose among c_mm, sigma"):
        plot_comparison(COMPARISON, "table2_iops", "c")


def test_the_page_is_made_of_the_parts_of_all_pages():
    run = Run(Experiment("A paper", {}, {}), pd.DataFrame({"layout": [0, 1]}), {"first": Tables(adjusted("cross"))}, ())
    page = experiment_page(run, COMPARISON)
    assert '<p class="verdict amber">2 of 3 judged values within tolerance; 2 not judged' in page
    assert page.count('<span class="no">') == 1 and "&lt;span" not in page
    assert all(f'<a href="#{name}">' in page for name in ("table-2-iops", "own", "block-of-the-first-layout"))
    assert 'querySelectorAll("table:has(thead)")' in page and not re.search(r'(src|href)="(?!data:|#)', page)
