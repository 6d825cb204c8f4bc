"""Pages of experiments: names, digits, tables and plots agree with tables.csv."""

import re

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from jaxphoto import Tables
from jaxphoto.experiment import Experiment, Run, comparison_figure, plot_agreement, plot_comparison, side_by_side
from jaxphoto.experiment.page import (
    experiment_page,
    heading,
    own_decimals,
    power_of,
    printed_decimals,
    table_texts,
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
    ("name", "title"), [("table2_iops", "Table 2: IOPs"), ("agreement", "Agreement"), ("table12_a_b", "Table 12: a b")]
)
def test_tables_have_titles(name, title):
    assert table_title(name) == title


@pytest.mark.parametrize(
    ("column", "unit", "power", "expected"),
    [
        ("c_mm", "mm", 0, "c [mm]"),
        ("sigma_k1_mm-2", "mm^-2", -7, "σ k1 [10⁻⁷ mm⁻²]"),
        ("rmse_dX_m", "", 0, "RMSE dX [m]"),
        ("xH", "um", 0, "xH [µm]"),
        ("c", "", 0, "c"),
    ],
)
def test_columns_have_units(column, unit, power, expected):
    assert heading(column, unit, power) == expected


def test_digits_are_those_of_the_print_and_of_the_spread():
    assert power_of([0.0, -9.1e-5]) == -5
    assert power_of([0.002]) == power_of([]) == power_of([0.0]) == 0
    assert printed_decimals([34.25, 34.249], 0) == 3
    assert printed_decimals([-9.1217e-5], -5) == 4
    assert printed_decimals([0.0], 0) is None
    assert own_decimals(34.24812, 0.0021, 3, 34.0) == 4
    assert own_decimals(34.24812, 0.3, 3, 34.0) == 3
    assert own_decimals(34.24812, 0.0, 3, 34.0) == 4
    assert own_decimals(20.0, 0.0, 0, 20.0) == 0
    assert own_decimals(0.0123, 0.0, None, 0.0123) == 4


def test_a_table_of_the_page_holds_both_values_notes_and_judgement():
    table = table_texts("table2_iops", COMPARISON[COMPARISON["table"] == "table2_iops"])
    assert [c["heading"] for c in table["columns"]] == ["c [mm]", "σ k1 [10⁻⁷ mm⁻²]"]
    assert [row["name"] for row in table["rows"]] == ["first", "third"]
    c, k1 = table["rows"][0]["cells"]
    assert (c["ours"], c["spread"], c["published"]) == ("34.2481", " ± 0.0021", "34.250")
    assert (k1["ours"], k1["published"], k1["within"]) == ("4.10", "3.75 (± 0.2)", "no")
    # A note of the whole column stands at its heading, another at its cell.
    assert table["notes"] == ["the truth", "only here"]
    assert [column["notes"] for column in table["columns"]] == [[1], []]
    assert (k1["note"], table["rows"][1]["cells"][1]["note"]) == ("", 2)
    assert (table["good"], table["judged"]) == (2, 3)
    assert table["difference"] == {"words": "0.02 (at most 0.03 promised)", "within": "yes"}


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
    c, k1 = figure.axes
    assert [axes.get_title() for axes in (c, k1)] == ["c [mm]", "σ k1 [10⁻⁷ mm⁻²]"]
    printed, ours = [container.lines[0] for container in k1.containers]
    np.testing.assert_allclose(printed.get_xdata(orig=False), [3.75, 3.7])
    np.testing.assert_allclose(ours.get_xdata(orig=False), [4.1, 3.8])
    assert [label.get_text() for label in c.get_yticklabels()] == ["first", "third"]
    figure.draw_without_rendering()
    with pytest.raises(ValueError, match="both printed and ours"):
        comparison_figure(COMPARISON, "own")


def test_plots_take_and_return_axes():
    axes = Figure().add_subplot()
    assert plot_agreement(COMPARISON, axes) is axes
    # (4.1 - 3.75) / 0.2, (3.8 - 3.7) / 0.2, 0.02 / 0.03: the first is beyond.
    within, beyond = axes.lines
    np.testing.assert_allclose(np.sort(within.get_xdata()), [0.5, 2 / 3])
    np.testing.assert_allclose(beyond.get_xdata(), [1.75])
    with pytest.raises(ValueError, match="no value that is printed and ours has a tolerance"):
        plot_agreement(COMPARISON[COMPARISON["table"] == "own"], axes)
    one = plot_comparison(COMPARISON, "table2_iops", "sigma_k1_mm-2", Figure().add_subplot())
    _, ours = [container.lines[0] for container in one.containers]
    np.testing.assert_allclose(ours.get_xdata(orig=False), [4.1, 3.8])
    with pytest.raises(ValueError, match=r"no column 'c' of 'table2_iops' .* those that are: c_mm, sigma"):
        plot_comparison(COMPARISON, "table2_iops", "c")


def test_the_page_is_made_of_the_parts_of_all_pages():
    run = Run(Experiment("A paper", {}, {}), pd.DataFrame({"layout": [0, 1]}), {"first": Tables(adjusted("cross"))}, ())
    page = experiment_page(run, COMPARISON)
    assert '<p class="verdict amber">2 of 3 printed values with a tolerance are within it' in page
    assert all(f'<a href="#{name}">' in page for name in ("table-2-iops", "own", "block-of-the-first-layout"))
    # Heads that come again on every sheet and that sort, by what is ours.
    assert page.count('<table class="as-printed">\n<thead><tr><th></th>') == 2
    assert 'class="no" data-value="4.10"' in page
    assert 'querySelectorAll("table:has(thead)")' in page and not re.search(r'(src|href)="(?!data:|#)', page)
