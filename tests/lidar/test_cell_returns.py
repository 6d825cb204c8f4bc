"""Returns added up in parts are the returns added up at once, and cells are the same of every part of a cloud."""

import hypothesis.strategies as st
import numpy as np
from hypothesis import given, settings

from jaxphoto.lidar.strip_planes import (
    CellTally,
    StripSettings,
    cells_of,
    columns_and_rows,
    gathered,
    joined,
    planes_from,
    planes_of,
)

SETTINGS = StripSettings(cell_m=3.0)


def returns(seed: int, n: int = 4000) -> np.ndarray:
    """Over both sides of the origin, 900 m up: where squares of heights lose the digits of a centimetre."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-30, 30, (n, 2))
    return np.column_stack([xy, 900.0 + 0.3 * xy[:, 0] + rng.normal(0, 0.01, n)])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.lists(st.integers(0, 4000), max_size=5))
def test_parts_joined_are_the_whole(seed, cuts):
    xyz = returns(seed)
    measured, time, cell = xyz + 0.5, np.arange(len(xyz)) / 100, cells_of(xyz, SETTINGS)
    whole = gathered(xyz, measured, time, cell)
    parts = [gathered(xyz[p], measured[p], time[p], cell[p]) for p in np.split(np.arange(len(xyz)), sorted(cuts))]
    for name, one, other in zip(whole._fields, joined(parts), whole, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9, err_msg=name)


def test_a_tally_gives_the_planes_of_all_returns():
    xyz, tally = returns(1, 40_000), CellTally(SETTINGS)
    for part in np.array_split(xyz, 30):
        tally.add("A", part)
    found = planes_from(tally.strips["A"], SETTINGS)
    asked = planes_of(xyz, xyz, np.zeros(len(xyz)), cells_of(xyz, SETTINGS), SETTINGS)
    assert len(found.cell) == 400
    np.testing.assert_allclose(found.roughness, asked.roughness, rtol=1e-9)
    np.testing.assert_allclose(found.normal, asked.normal, atol=1e-10)


def test_columns_and_rows_of_cells_on_all_sides_of_the_origin():
    x, y = (v.ravel() for v in np.meshgrid([-7.0, -0.1, 0.0, 2.9, 3.0, 9.5], [-3.0, -0.1, 0.1, 5.0]))
    columns, rows = columns_and_rows(cells_of(np.column_stack([x, y, x]), SETTINGS))
    np.testing.assert_array_equal(columns, np.floor(x / 3))
    np.testing.assert_array_equal(rows, np.floor(y / 3))
