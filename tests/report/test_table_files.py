"""Tables in other formats: full precision, or digits by standard deviation."""

import re

import numpy as np
import pandas as pd
import pytest

from jaxphoto import InputError, Tables
from jaxphoto.camera import Brown, InteriorOrientation, OpenCv, parameter_unit
from jaxphoto.io import read_result_tables
from jaxphoto.report import to_latex, to_markdown, write_tables
from jaxphoto.report.findings import Finding, Verdict
from jaxphoto.report.formatting import (
    column_unit,
    head_of,
    in_equal_figures,
    in_figures,
    label_unit,
    of_sigma,
    readable,
    with_sigma,
    without_powers,
)
from jaxphoto.report.tables import check_spread
from tests.blocks import adjusted

FEW = ["interior", "exterior", "check_points"]


@pytest.mark.parametrize(
    ("value", "sigma", "text", "sigma_text"),
    [
        (34.250186, 0.00337, "34.2502", "0.0034"),
        (-9.0867162e-05, 7.5e-07, "-9.087e-05", "7.5e-07"),
        (1500.04, 25.0, "1500", "25"),
        (0.001, 0.02, "0.001", "0.020"),
        (-0.00025, 0.058, "0.000", "0.058"),
        (-0.0026, 0.058, "-0.003", "0.058"),
        (9.96, 1.2, "10.0", "1.2"),
        (2.5e-09, 7.5e-07, "0", "7.5e-07"),
        (2.5e-08, 7.5e-07, "0.2e-07", "7.5e-07"),
        (0.0, 0.1, "0", "0.10"),
        (35.0, 0.0, "35", ""),
    ],
)
def test_a_number_ends_at_the_second_digit_of_its_sigma(value, sigma, text, sigma_text):
    assert (with_sigma(value, sigma), of_sigma(sigma)) == (text, sigma_text)


def test_large_numbers_have_no_powers_of_ten():
    said = without_powers("by -1.16e+03 +- 4e+02 m, of point 7e+02b 1e-05.")
    assert said == "by -1160 +- 400 m, of point 7e+02b 1e-05."
    assert Verdict.of([Finding("message", "error", "c is off by +2e+03.")]).texts == ["c is off by +2000."]
    assert [in_figures(1234.5, 3), of_sigma(437.0), in_figures(1e12, 2)] == ["1230", "440", "1.0e+12"]


def test_a_column_has_as_many_figures_in_each_row():
    assert in_equal_figures([0.0035, 0.002861, -0.0129], 3) == ["0.00350", "0.00286", "-0.0129"]
    assert in_equal_figures([1e-08, 4e-10, 0.0], 4) == ["1e-08", "4e-10", "0"]
    assert in_equal_figures([20.0, 3.5], 4) == ["20", "3.5"]
    shown = readable(pd.DataFrame({"rmse": [0.4, np.nan, 0.188], "X_m": [1234.5678, 0.5, 2.0]}))
    assert shown["rmse"].tolist() == ["0.400", "", "0.188"]
    assert shown["X_m"].tolist() == ["1234.5678", "0.5000", "2.0000"]


def test_yes_and_no_are_no_numbers():
    shown = readable(pd.DataFrame({"freedom": [1, 0, 34], "significant": [True, False, None]}))
    assert shown["freedom"].tolist() == ["1", "0", "34"] and shown["significant"].tolist() == ["yes", "no", ""]


def test_units_of_a_camera_follow_its_model():
    table = Tables(adjusted("cross")).interior
    assert dict(zip(table["parameter"], table["unit"], strict=True))["k2"] == "1/mm^4"
    assert readable(table)["parameter"].tolist()[:4] == ["c", "x_p", "y_p", "k1"]
    assert r"1/mm\textasciicircum 2" in to_latex(table) and "| 1/mm^2 |" in to_markdown(table)
    cv = InteriorOrientation(35.0, distortion=OpenCv(k1=0.1))
    assert [parameter_unit(cv, name) for name in ("c_mm", "k1", "b1")] == ["mm", "1", "1"]


def test_labels_and_columns_of_draws_have_the_units_of_their_models():
    models = {"a_m": Brown(), "cv": OpenCv()}
    cameras = {name: InteriorOrientation(35.0, distortion=model) for name, model in models.items()}
    labels = {
        "interior[a_m].k1": "1/mm^2", "interior[cv].k1": "1", "interior[cv].c_mm": "mm", "points[7].X": "m",
        "exterior[1].omega_deg": "deg", "mounts[default].boresight_up_rad": "rad", "strips[k1].drift_X_m_per_s": "m/s",
        "scanner_calibration.range_scale_ppm": "ppm",
    }  # fmt: skip
    assert {label: label_unit(label, cameras) for label in labels} == labels
    columns = {"a_m.k1": "1/mm^2", "bias.cv.k1": "1", "bias.a_m.X_m": "m", "check.7.dX_m": "m"}
    assert {column: column_unit(column, cameras) for column in columns} == columns


def test_heads_have_units_in_brackets():
    names = {"X_m": "X [m]", "sigma_omega_deg": "sigma omega [deg]", "drift_X_m_per_s": "drift X [m/s]", "rho": "rho"}
    assert {name: head_of(name) for name in names} == names


def test_numbers_come_back_from_csv_and_parquet(tmp_path):
    tables = Tables(adjusted("cross"))
    write_tables(tables, tmp_path / "csv", "csv", FEW)
    write_tables(tables, tmp_path / "parquet", "parquet", FEW)
    back = read_result_tables(tmp_path / "csv", FEW)
    for name in FEW:
        ours = getattr(tables, name)
        numbers = ours.select_dtypes("number").columns
        pd.testing.assert_frame_equal(back[name][numbers], ours[numbers], check_dtype=False, rtol=1e-14)
        binary = pd.read_parquet(tmp_path / "parquet" / f"{name}.parquet")
        pd.testing.assert_frame_equal(binary, ours, check_dtype=False, rtol=0)


def test_markdown_is_a_table_of_as_many_cells():
    table = Tables(adjusted("cross")).exterior
    lines = to_markdown(table, "exterior").splitlines()
    assert lines[0] == "## exterior" and lines[2].startswith("| image | X [m] | Y [m] |")
    assert {line.count("|") for line in lines[2:]} == {14} and len(lines) == 4 + len(table)
    x, sigma = (re.split(r" *\| *", lines[4])[k] for k in (2, 8))
    assert abs(float(x) - table.loc[0, "X_m"]) < table.loc[0, "sigma_X_m"] / 10
    # The same place of the last digit.
    assert len(x.partition(".")[2]) == len(sigma.partition(".")[2])


def test_a_table_that_there_is_not_is_named():
    with pytest.raises(InputError, match="unknown table inner; use one of interior, exterior"):
        write_tables(Tables(adjusted("cross")), "nowhere", names=["inner"])


def test_the_mean_of_residuals_has_the_digits_that_their_scatter_allows():
    shown = readable(pd.DataFrame({"n": [400], "mean": [-0.00012345678], "rmse": [0.002], "max_abs": [0.00912345]}))
    # 0.002 / 20 = 0.0001.
    assert list(shown.iloc[0]) == ["400", "-0.00012", "0.002", "0.00912"]


def test_what_has_no_sigma_of_its_name_is_neither_cut_nor_endless():
    """Times of a week, pixels by the sigma of both, places by the larger of two, angles and coordinates of a map."""
    given = pd.DataFrame(
        {
            "time_s": [345678.125], "column_px": [2620.356], "sigma_px": [0.5], "dX_m": [-0.0021123],
            "sigma_survey_X_m": [0.02], "sigma_adjusted_X_m": [0.3], "w_X": [0.47531], "E_m": [587620.44123456],
            "kappa_deg": [-139.31234], "rms_m": [0.0989412],
        }
    )  # fmt: skip
    assert readable(given).iloc[0].tolist() == [
        "345678.125", "2620.36", "0.50", "0.00", "0.020", "0.30", "0.475", "587620.4412", "-139.3123", "0.0989",
    ]  # fmt: skip


def test_check_points_are_summed_up_by_axis():
    d = pd.DataFrame({"point": ["a", "b"], "dX_m": [0.01, -0.03], "dY_m": [0.02, 0.02], "dZ_m": [0.0, np.nan]})
    spread = check_spread(d)
    assert (
        list(spread["axis"]) == ["X", "Y", "Z"]
        and list(spread["n"]) == [2, 2, 1]
        and list(spread["point"]) == ["b", "a", "a"]
    )
    np.testing.assert_allclose(spread[["mean", "rmse", "max_abs"]], [[-0.01, 5e-4**0.5, 0.03], [0.02] * 3, [0.0] * 3])


def test_fixed_values_are_shown_in_full():
    table = {"parameter": ["c_mm", "k1"], "value": [34.250186, 1.2345678e-4], "sigma": [0.0, np.nan]}
    shown = readable(pd.DataFrame(table))
    assert list(shown["value"]) == ["34.250186", "0.00012345678"] and list(shown["sigma"]) == ["", ""]
