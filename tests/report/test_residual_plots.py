"""Residuals by radius and in the order of the flight show what was put into them."""

import equinox as eqx
import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxphoto import Tables
from jaxphoto.report import plot_residuals_by_radius, plot_station_residuals
from tests.blocks import adjusted


def test_radial_residuals_are_told_from_tangential_ones():
    a = adjusted("cross")
    from_centre = np.asarray(a.values.xy) - np.asarray(a.unknowns.interior["one"].principal_point)[:, None]
    along = from_centre / np.hypot(*from_centre)
    v = 1e-3 * (2.0 * along + 3.0 * np.stack([-along[1], along[0]]))
    of_image = eqx.tree_at(lambda r: r.image, a.residuals, v / np.asarray(a.values.sigma_xy))
    axes = plot_residuals_by_radius(
        Tables(eqx.tree_at(lambda b: b.residuals, a, of_image)), "one", Figure().add_subplot()
    )
    radial, tangential = (np.asarray(bars.lines[0].get_ydata()) for bars in axes.containers)
    np.testing.assert_allclose(radial, 2.0, atol=1e-9)
    np.testing.assert_allclose(tangential, 3.0, atol=1e-9)


@pytest.mark.parametrize("axis", range(3))
def test_station_residuals_are_those_of_the_table(axis):
    tables = Tables(adjusted("cross"))
    line = plot_station_residuals(tables, Figure().add_subplot()).lines[axis]
    rows = tables.residuals[(tables.residuals["group"] == "stations") & (tables.residuals["axis"] == "XYZ"[axis])]
    assert sorted(line.get_ydata()) == sorted(rows["residual"])
    assert list(line.get_xdata()) == sorted(line.get_xdata())
