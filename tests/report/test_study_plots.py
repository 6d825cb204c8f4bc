"""Plots of boresight, cloud as control, halves, models and stability draw the numbers of their results."""

import equinox as eqx
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from jaxphoto import InputError
from jaxphoto.camera import Brown, InteriorOrientation, Sensor, parameter_names
from jaxphoto.report import (
    plot_above,
    plot_boresight,
    plot_change,
    plot_halves,
    plot_lidar_heights,
    plot_models,
    plot_ray_offsets,
)
from jaxphoto.report.stability import change_headline
from jaxphoto.stability import change, image_grid
from tests.report.studies import (
    GOPRO,
    MODELS,
    boresight_steps,
    halves_found,
    lidar_control_of,
    model_choice_of,
    ray_offsets,
    simultaneous_of,
)


@pytest.fixture
def axes():
    return Figure().add_subplot()


def lines(axes) -> dict:
    """Lines and points by their label."""
    handles, labels = axes.get_legend_handles_labels()
    return dict(zip(labels, handles, strict=True))


def test_misalignments_of_both_steps_and_shifts_of_strips(axes):
    steps = boresight_steps()
    assert plot_boresight(steps, axes) is axes
    for step in steps[2:]:
        points = lines(axes)[f"step {step.number}"].lines[0]
        np.testing.assert_allclose(points.get_xdata(orig=False), [e.value for e in step.estimates])
    shifts = plot_boresight(steps, Figure().add_subplot(), shifts=True)
    assert [label.get_text() for label in shifts.get_yticklabels()] == [f"E{k} {x}" for k in (1, 2) for x in "XYZ"]
    # The bar of the first is two standard deviations to each side.
    np.testing.assert_allclose(shifts.collections[0].get_segments()[0][:, 0], [-0.1, 0.1])
    with pytest.raises(InputError, match="these steps estimated no shifts of strips"):
        plot_boresight(steps[2:], axes, shifts=True)


def test_maps_of_halves_have_the_values_of_their_cells(axes):
    halves = halves_found()
    levels = plot_halves(halves, axes).collections[0].levels
    assert (levels[0], levels[-1]) == pytest.approx((1.0, 2.0), abs=0.05)
    band = plot_halves(halves, Figure().add_subplot(), band=True).collections[0].levels
    assert (band[0], band[-1]) == pytest.approx((0.1, 0.3), abs=0.02)


def test_maps_of_a_change_reach_as_far_as_its_offsets(axes):
    sensor = Sensor(400, 300, 0.01)
    first, second = (InteriorOrientation(8.0, 0.0, 0.0, Brown(k1=k1)) for k1 in (1e-4, 5e-4))
    covariance = 1e-12 * np.eye(len(parameter_names(first)))
    changed = change(first, second, image_grid(sensor, 7, 5), (covariance, None), "zrot")
    assert plot_change(changed, sensor, axes) is axes and axes.get_title(loc="left") == "offset [px]"
    # Of k1 alone, at the corner: (5e-4 - 1e-4) r^3 mm, through the first distortion.
    assert axes.collections[0].zmax == pytest.approx(4e-4 * 2.5**3 / 0.01, rel=0.01)
    over = plot_change(changed, sensor, Figure().add_subplot(), over_usual=True)
    assert over.collections[0].zmax == pytest.approx((changed.offset_mm / changed.limit_mm).max())
    # Either test suffices.
    for p_parameters in (0.9, np.nan):
        assert change_headline(changed._replace(p_parameters=p_parameters)).startswith("the camera has changed")


def test_models_are_drawn_by_bic_and_by_what_they_predict(axes):
    choice = model_choice_of()
    plot_models(choice, axes)
    bic = np.array([row[1] for row in MODELS.values()])
    np.testing.assert_allclose([bar.get_width() for bar in axes.patches], bic - bic.min())
    rms = lines(plot_models(choice, Figure().add_subplot(), rms=True))
    np.testing.assert_allclose(rms["held out"].get_xdata(), [row[3] for row in MODELS.values()])
    assert set(lines(plot_models(model_choice_of(0), Figure().add_subplot(), rms=True))) == {"adjusted"}
    with pytest.raises(InputError, match="no model could be adjusted"):
        plot_models(choice._replace(judged=choice.judged[3:]), axes)


def test_heights_of_a_cloud_are_counted_and_coloured(axes):
    control = lidar_control_of(0.05)
    assert plot_lidar_heights(control, axes) is axes
    refused = ~np.isfinite(control.height)
    numbers = control.used.sum(), (~control.used & ~refused).sum(), refused.sum()
    words = [f"{w} ({n})" for w, n in zip(("control", "rejected", "no height"), numbers, strict=True)]
    assert set(lines(axes)) == set(words) and len(lines(axes)[words[0]].get_xdata()) == control.used.sum()
    right = plot_lidar_heights(control, Figure().add_subplot(), residuals=True)
    np.testing.assert_allclose(np.abs(right.collections[0].get_array()), 0.05)
    assert "RMSE 0.050 m" in right.get_title(loc="left")
    none = eqx.tree_at(lambda c: c.used, control, np.zeros_like(control.used))
    with pytest.raises(InputError, match="no height of the cloud is used as control"):
        plot_lidar_heights(none, axes, residuals=True)


def test_points_above_a_cloud_have_the_range_of_their_own_heights(axes):
    result = simultaneous_of(0.5, 0.05)
    assert plot_above(result, axes) is axes and axes.get_title(loc="left") == "after: RMSE 0.050 m"
    np.testing.assert_allclose(axes.collections[0].get_array(), result.apart)
    before = plot_above(result, Figure().add_subplot(), before=True).collections[0]
    np.testing.assert_allclose(before.get_array(), result.apart_before)
    assert before.get_clim() == (-0.5, 0.5) and axes.collections[0].get_clim() == (-0.05, 0.05)


def test_offsets_of_rays_are_arrows_in_micrometres(axes):
    analysis = ray_offsets()
    plot_ray_offsets(analysis, GOPRO, axes)
    (arrows,) = (child for child in axes.get_children() if isinstance(child, Quiver))
    np.testing.assert_allclose(np.stack([arrows.U, arrows.V], 1), 1e3 * np.asarray(analysis.offsets.offsets))
    assert f"{1e3 * float(analysis.offsets.rmse_mm):.3g} µm" in axes.get_title(loc="left")
