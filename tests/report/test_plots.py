"""Plots have the numbers of the tables."""

import equinox as eqx
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver, QuiverKey

from jaxphoto import Tables
from jaxphoto.report import (
    check_points_figure,
    plot_error_ellipses,
    plot_residuals_by_radius,
    plot_station_residuals,
    plots,
    results,
)
from jaxphoto.report.plots import ellipse_axes
from tests.blocks import adjusted


def arrows(axes) -> Quiver:
    (found,) = [child for child in axes.get_children() if isinstance(child, Quiver)]
    return found


def test_check_points_are_drawn_as_they_are_in_one_scale():
    tables = Tables(adjusted("cross"))
    figure = check_points_figure({"one": tables, "two": tables})
    d = tables.check_points[["dX_m", "dY_m", "dZ_m"]].to_numpy()
    number = [tables.adjusted.block.points.index(p) for p in tables.check_points["point"]]
    plan, height, *second = figure.axes
    np.testing.assert_allclose(np.stack([arrows(plan).U, arrows(plan).V], 1), d[:, :2])
    np.testing.assert_allclose(np.stack([arrows(height).U, arrows(height).V], 1), d[:, 2:] * [0, 1])
    np.testing.assert_allclose(arrows(plan).XY, np.asarray(tables.adjusted.unknowns.points)[number, :2])
    assert len(second) == 2
    assert len({arrows(axes).scale for axes in figure.axes}) == 1
    (key,) = [child for child in plan.get_children() if isinstance(child, QuiverKey)]
    assert 2 * np.sqrt((d**2).mean()) < key.U < 4 * np.sqrt((d**2).mean())
    assert plan.get_title(loc="left").startswith("one")
    # The tips of the arrows lie inside the axes.
    figure.draw_without_rendering()
    tips = arrows(plan).XY + d[:, :2] / arrows(plan).scale
    assert tips[:, 0].max() < plan.get_xlim()[1] and tips[:, 1].min() > plan.get_ylim()[0]


def test_points_checked_in_plan_only_have_no_height():
    tables = Tables(adjusted("cross"))
    table = tables.check_points.assign(dZ_m=np.nan)
    tables.check_points = table
    plan, height = check_points_figure({"": tables}).axes
    assert len(arrows(plan).U) == len(table)
    assert len(arrows(height).U) == 0


def test_of_many_residuals_a_part_is_drawn_and_the_largest(monkeypatch):
    tables = Tables(adjusted("cross"))
    whole = plots.plot_residuals(tables, "one", Figure().add_subplot())
    n = len(tables.adjusted.block.image_points.xy)
    assert len(arrows(whole).U) == n and "1 in" not in whole.get_title(loc="left")
    monkeypatch.setattr(plots, "_ARROWS", n // 4)
    monkeypatch.setattr(plots, "_LARGEST", 3)
    part = plots.plot_residuals(tables, "one", Figure().add_subplot())
    assert n // 5 <= len(arrows(part).U) <= n // 4 + 3
    assert "1 in 5" in part.get_title(loc="left") or "1 in 4" in part.get_title(loc="left")
    size = lambda axes: np.sort(np.hypot(arrows(axes).U, arrows(axes).V))  # noqa: E731
    np.testing.assert_allclose(size(part)[-3:], size(whole)[-3:])
    assert arrows(part).scale == arrows(whole).scale


def test_ellipses_are_where_the_quadratic_form_is_one():
    root = np.random.default_rng(1).normal(size=(40, 2, 2))
    covariance = root @ root.transpose(0, 2, 1)
    a, b, turn = ellipse_axes(covariance)
    assert (a >= b).all()
    for angle in np.linspace(0, 2 * np.pi, 9):
        along, across = a * np.cos(angle), b * np.sin(angle)
        d = np.stack([np.cos(turn) * along - np.sin(turn) * across, np.sin(turn) * along + np.cos(turn) * across], 1)
        np.testing.assert_allclose(np.einsum("ni,nij,nj->n", d, np.linalg.inv(covariance), d), 1.0, rtol=1e-6)


def test_ellipses_are_as_long_as_the_standard_deviations_of_the_table():
    """Their widest reach along X and Y, and their colour in Z, all by the factor that the title says."""
    tables = Tables(adjusted("cross"))
    axes = plot_error_ellipses(tables, Figure().add_subplot())
    (drawn,) = [child for child in axes.get_children() if isinstance(child, EllipseCollection)]
    factor = float(axes.get_title(loc="left").split(" x ")[1].split(", ")[0].replace(",", ""))
    a, b, turn = drawn.get_widths() / 2, drawn.get_heights() / 2, np.radians(drawn.get_angles())
    reach = np.sqrt((a * [np.cos(turn), np.sin(turn)]) ** 2 + (b * [np.sin(turn), np.cos(turn)]) ** 2) / factor
    measured = tables.object_points[tables.object_points["n_images"] > 0]
    sigma = measured[["sigma_X_m", "sigma_Y_m", "sigma_Z_m"]].to_numpy().T
    np.testing.assert_allclose(reach, sigma[:2], rtol=1e-9)
    np.testing.assert_allclose(drawn.get_array(), sigma[2], rtol=1e-9)


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


@pytest.fixture
def of_points(monkeypatch):
    """Tables of two cameras of which one is pictured, and the names by the number of image points."""
    tables = Tables(adjusted("two_cameras"))
    monkeypatch.setattr(results, "_PLOTTED", 1)
    of = tables.adjusted.block.image_camera
    seen = [of[i] for i in tables.adjusted.structure.image.tolist()]
    return tables, sorted(("one", "two"), key=seen.count)


def test_of_many_cameras_those_with_the_most_image_points_are_pictured(of_points):
    tables, (_, most) = of_points
    assert results.plotted_cameras(tables) == [most]
