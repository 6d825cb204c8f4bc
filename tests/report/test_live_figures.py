"""Pictures of boresight, cloud as control, halves, models and stability: on given axes, alive on their pages."""

import base64
import gzip
import json
import re

import equinox as eqx
import numpy as np
import pytest
from matplotlib.figure import Figure

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
    to_plotly,
)
from jaxphoto.report.boresight import boresight_figure, boresight_page
from jaxphoto.report.change import change_headline
from jaxphoto.report.document import DocumentPicture, Heading, Pictures
from jaxphoto.report.halves import halves_figure
from jaxphoto.report.lidar import above_figure, heights_figure
from jaxphoto.report.made import Made
from jaxphoto.report.model_choice import choice_figure
from jaxphoto.report.study_page import WholePicture, study_page
from jaxphoto.report.to_plotly import twins_of
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


def live(page: str) -> list[list[dict]]:
    """Of each figure of a page what its panels are drawn from."""
    packed = re.findall(
        r'<figure class="twins live-figure"[^>]*>.*?<script type="text/plain">([^<]*)</script>', page, re.DOTALL
    )
    return [json.loads(gzip.decompress(base64.b64decode(one))) for one in packed]


def named(twin) -> dict:
    return {trace["name"]: trace for trace in twin.data if trace["showlegend"]}


def test_misalignments_of_both_steps_and_shifts_of_strips(axes):
    steps = boresight_steps()
    assert plot_boresight(steps, axes) is axes
    found = named(to_plotly(axes))
    for step in steps[2:]:
        np.testing.assert_allclose(found[f"step {step.number}"]["x"], [e.value for e in step.estimates])
    shifts = plot_boresight(steps, Figure().add_subplot(), shifts=True)
    assert [label.get_text() for label in shifts.get_yticklabels()] == [f"E{k} {x}" for k in (1, 2) for x in "XYZ"]
    # The bar of the first is two standard deviations to each side.
    np.testing.assert_allclose(shifts.collections[0].get_segments()[0][:, 0], [-0.1, 0.1])
    with pytest.raises(InputError, match="these steps estimated no shifts of strips"):
        plot_boresight(steps[2:], axes, shifts=True)
    assert boresight_figure(steps[:1]) is None


def test_maps_of_halves_have_the_values_of_their_cells(axes):
    found = halves_found()
    levels = plot_halves(found, axes).collections[0].levels
    assert (levels[0], levels[-1]) == pytest.approx((1.0, 2.0), abs=0.05)
    figure = halves_figure(found)
    band = figure.axes[1]
    assert (band.collections[0].levels[0], band.collections[0].levels[-1]) == pytest.approx((0.1, 0.3), abs=0.02)
    assert [twin.layout.title.text for twin in twins_of(figure)] == [a.get_title(loc="left") for a in figure.axes[:2]]
    # Areas between two lines tell what they stand for.
    assert f"{levels[0]:.3g} to {levels[1]:.3g}" in {trace["text"] for trace in to_plotly(axes).data}


def test_maps_of_a_change_reach_as_far_as_its_offsets(axes):
    sensor = Sensor(400, 300, 0.01)
    first, second = (InteriorOrientation(8.0, 0.0, 0.0, Brown(k1=k1)) for k1 in (1e-4, 5e-4))
    covariance = 1e-12 * np.eye(len(parameter_names(first)))
    found = change(first, second, image_grid(sensor, 7, 5), (covariance, None), "zrot")
    assert plot_change(found, sensor, axes) is axes and axes.get_title(loc="left") == "offset [px]"
    # Of k1 alone, at the corner: (5e-4 - 1e-4) r^3 mm, through the first distortion.
    assert axes.collections[0].zmax == pytest.approx(4e-4 * 2.5**3 / 0.01, rel=0.01)
    over = plot_change(found, sensor, Figure().add_subplot(), over_usual=True)
    assert over.collections[0].zmax == pytest.approx((found.offset_mm / found.limit_mm).max())
    # What one test finds stands at the head, whatever the other says, or where there is no other.
    for p_parameters in (0.9, np.nan):
        assert change_headline(found._replace(p_parameters=p_parameters)).startswith("the camera has changed")


def test_models_are_drawn_by_bic_and_by_what_they_predict(axes):
    choice = model_choice_of()
    plot_models(choice, axes)
    (bars,) = (trace for trace in to_plotly(axes).data if trace.type == "bar")
    bic = np.array([row[1] for row in MODELS.values()])
    np.testing.assert_allclose(bars.x, bic - bic.min())
    assert (bars.orientation, set(bars.base)) == ("h", {1.0})
    assert to_plotly(axes).layout.xaxis.ticktext[:3] == ("0", "2", "10")
    left_out = named(to_plotly(plot_models(choice, Figure().add_subplot(), rms=True)))["left out"]
    np.testing.assert_allclose(left_out["x"], [row[3] for row in MODELS.values()])
    assert len(twins_of(choice_figure(choice))) == 2
    assert set(named(to_plotly(plot_models(model_choice_of(0), Figure().add_subplot(), rms=True)))) == {"adjusted"}
    with pytest.raises(InputError, match="no model could be adjusted"):
        plot_models(choice._replace(judged=choice.judged[3:]), axes)
    assert twins_of(choice_figure(choice._replace(judged=choice.judged[3:]))) == []


def test_heights_of_a_cloud_are_counted_and_coloured(axes):
    control = lidar_control_of(0.05)
    assert plot_lidar_heights(control, axes) is axes
    refused = ~np.isfinite(control.height)
    numbers = control.used.sum(), (~control.used & ~refused).sum(), refused.sum()
    words = [f"{w} ({n})" for w, n in zip(("control", "left out", "refused"), numbers, strict=True)]
    found = named(to_plotly(axes))
    assert set(found) == set(words) and len(found[words[0]]["x"]) == control.used.sum()
    right = plot_lidar_heights(control, Figure().add_subplot(), residuals=True)
    np.testing.assert_allclose(np.abs(right.collections[0].get_array()), 0.05)
    assert "RMSE 0.050 m" in right.get_title(loc="left")
    none = eqx.tree_at(lambda c: c.used, control, np.zeros_like(control.used))
    with pytest.raises(InputError, match="no height of the cloud is control"):
        plot_lidar_heights(none, axes, residuals=True)
    assert len(twins_of(heights_figure(none))) == 1


def test_points_above_a_cloud_have_the_colours_of_before(axes):
    result = simultaneous_of(0.5, 0.05)
    assert plot_above(result, axes) is axes and axes.get_title(loc="left") == "after: RMSE 0.050 m"
    np.testing.assert_allclose(axes.collections[0].get_array(), result.apart)
    before, after = (panel.collections[0] for panel in above_figure(result).axes[:2])
    np.testing.assert_allclose(before.get_array(), result.apart_before)
    assert before.get_clim() == after.get_clim() == axes.collections[0].get_clim() == (-0.5, 0.5)


def test_offsets_of_rays_are_arrows_in_micrometres(axes):
    analysis = ray_offsets()
    plot_ray_offsets(analysis, GOPRO, axes)
    (told,) = (trace.customdata for trace in to_plotly(axes).data if trace.customdata is not None and len(trace.x) > 1)
    np.testing.assert_allclose(told, 1e3 * np.asarray(analysis.offsets.offsets))
    assert f"{1e3 * float(analysis.offsets.rmse_mm):.3g} µm" in axes.get_title(loc="left")


def test_a_page_holds_its_pictures_still_and_alive_and_what_draws_them_once():
    page = boresight_page(boresight_steps(), Made("jaxphoto boresight"))
    ((angles, shifts),) = live(page)
    assert angles["layout"]["xaxis"]["title"]["text"] == "angle [deg]"
    assert shifts["layout"]["xaxis"]["title"]["text"] == "shift [m]"
    assert re.search(r'<div class="still"><div class="wide"><img alt="[^"]+" src="data:image/png', page)
    panels = Pictures(
        (DocumentPicture(lambda a: a.plot([1, 2]), "one"), DocumentPicture(lambda a: a.bar([1], [2]), "two"))
    )
    both = study_page("t", ["said"], [Heading("A"), panels, WholePicture.of(halves_figure(halves_found()), "maps")])
    assert [len(one) for one in live(both)] == [2, 2] and both.count('id="plotly"') == 1
    # Of nothing that answers there is no library.
    assert 'id="plotly"' not in study_page("t", ["said"], [Heading("A")])
