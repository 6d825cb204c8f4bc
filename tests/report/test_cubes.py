"""Cubes hold the numbers of the tables, under the names of their axes."""

import numpy as np
import pytest

from jaxphoto import Tables
from jaxphoto.report import correlation_cube, covariance_array, draws_cube
from jaxphoto.report.draws import draws_table
from jaxphoto.sensitivity import Draws
from tests.blocks import adjusted


@pytest.fixture(scope="module")
def tables():
    return Tables(adjusted("cross"))


def test_correlations_by_image_are_those_of_the_summary(tables):
    (camera,) = tables.correlations
    cube = correlation_cube(tables.correlations[camera])
    summary = tables.correlation_summary.set_index(["exterior", "interior"])["mean_abs_rho"]
    assert len(summary)
    for (element, parameter), mean in summary.items():
        assert float(abs(cube.exterior).mean("image").sel(element=element, parameter=parameter)) == pytest.approx(mean)
    np.testing.assert_allclose(cube.interior.sel(parameter="c_mm", with_parameter="c_mm"), 1.0)


def test_the_matrix_has_the_sigmas_and_correlations_of_the_tables(tables):
    matrix = covariance_array(tables.covariance)
    (camera,) = tables.correlations
    table = tables.interior.set_index("parameter")["sigma"]
    assert float(matrix.sel(unknown=f"interior[{camera}].c_mm").sigma) == pytest.approx(table["c_mm"])
    image = tables.exterior["image"].iloc[3]
    own = matrix.sel(unknown=[name for name in matrix.unknown.values if name.startswith(f"exterior[{image}]")])
    expected = tables.exterior.set_index("image").loc[image, ["sigma_X_m", "sigma_Y_m", "sigma_Z_m"]]
    np.testing.assert_allclose(own.sigma[:3], expected.astype(float))
    cube = correlation_cube(tables.correlations[camera])
    name, element = f"interior[{camera}].c_mm", str(cube.element.values[2])
    found = matrix.sel(unknown=f"exterior[{image}].{element}", with_unknown=name)
    assert float(found) == pytest.approx(float(cube.exterior.sel(image=image, element=element, parameter="c_mm")))


@pytest.mark.parametrize("whole", [True, False])
def test_draws_are_those_of_their_table(whole):
    a, rng, n = adjusted("cross"), np.random.default_rng(2), 4
    images, points, labels = a.block.images, a.block.points, a.structure.labels
    draws = Draws(
        {"block.X_m": rng.normal(size=n)} if whole else {}, rng.normal(size=(n, len(labels))),
        rng.normal(size=(n, len(images), 6)) if whole else None,
        rng.normal(size=(n, len(points), 3)) if whole else None, np.ones(n, bool), np.arange(n), np.zeros(n, bool),
        tuple(labels),
    )  # fmt: skip
    cube, table = draws_cube(draws, a), draws_table(draws, a)
    np.testing.assert_array_equal(cube.shared.sel(parameter="interior[one].c_mm"), table["one.c_mm"])
    assert ("exterior" in cube) == ("points" in cube) == ("error" in cube) == whole
    if whole:
        kappa = np.degrees(cube.exterior.sel(image=images[2], element="kappa_rad"))
        np.testing.assert_allclose(kappa, table[f"exterior.{images[2]}.kappa_deg"])
        np.testing.assert_array_equal(cube.points.sel(point=points[5], axis="Y"), table[f"point.{points[5]}.Y_m"])
        np.testing.assert_array_equal(cube.error.sel(of_error="block.X_m"), table["bias.block.X_m"])
