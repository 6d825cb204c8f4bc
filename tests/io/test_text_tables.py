"""Text tables: cells as of Python's csv reader, with their rows."""

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxphoto import InputError
from jaxphoto.io.text_tables import read_csv

_CELLS = st.sampled_from(["", "a", " b ", "7", "-1.5e3", "x y", "2,5", "3;4", '"', 'a "b" c', "１"])


@given(st.lists(st.tuples(_CELLS, _CELLS, _CELLS), max_size=20), st.sampled_from(",;"))
def test_cells_are_those_of_the_csv_module(tmp_path_factory, records, separator):
    # One cell at least is filled: a line of empty ones is passed over as an empty line is.
    records = [("z", *record) for record in records]
    written = io.StringIO()
    csv.writer(written, delimiter=separator, lineterminator="\n").writerows([("image", "p", "q", "r"), *records])
    path = tmp_path_factory.mktemp("tables") / "t.csv"
    path.write_text(written.getvalue(), "utf-8")
    table = read_csv(path, ("image", "p"), ("q", "r"), text=("p", "q", "r"))
    for j, name in enumerate(("image", "p", "q", "r")):
        assert table.text(name).tolist() == [record[j].strip() for record in records]
    assert table.rows.tolist() == list(range(2, len(records) + 2))


def test_numbers_round_trip_and_invalid_ones_name_their_row(tmp_path: Path):
    values = np.random.default_rng(1).normal(0, 1e3, 25_000)
    lines = ["# measured", "image,v", *(f"i,{value!r}" for value in values.tolist())]
    path = tmp_path / "t.csv"
    path.write_text("\n".join(lines))
    assert np.array_equal(read_csv(path, ("image", "v")).numbers("v"), values)

    # After a comment and the header.
    for cell, words in {
        "1_000": "row 20010: v is '1_000', not a number",
        "": "row 20010: v is empty",
        "3,4": "row 20010: 3 cells, but the header has 2",
        '"3': "row 20010: the quotation marks do not pair",
    }.items():
        path.write_text("\n".join([*lines[:20_009], f"i,{cell}", *lines[20_010:]]))
        with pytest.raises(InputError, match=words):
            read_csv(path, ("image", "v")).numbers("v")
