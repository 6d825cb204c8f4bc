"""Correlations as a reader has them: parameters beside one another."""

from jaxphoto import Tables
from jaxphoto.report.tables import side_by_side
from tests.blocks import adjusted


def test_side_by_side_stands_what_the_long_table_says():
    table = Tables(adjusted("cross")).correlation_summary
    wide = side_by_side(table, ["camera", "exterior"], "interior", "max_abs_rho")
    assert wide.columns.tolist()[:4] == ["exterior", "c", "xp", "yp"]
    assert wide["exterior"].tolist() == table["exterior"].unique().tolist()
    one = table[(table["exterior"] == "omega") & (table["interior"] == "yp_mm")]["max_abs_rho"].item()
    assert wide.set_index("exterior").loc["omega", "yp"] == f"{one:.3f}"
