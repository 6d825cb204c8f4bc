"""The twins in plotly hold what matplotlib draws, where it draws it."""

import inspect

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.collections import EllipseCollection

from jaxphoto import InputError, report
from jaxphoto.report import Tables, plot_block, to_plotly
from tests.blocks import adjusted

# Of an adjustment; those of other things are drawn in the tests of these.
_PICTURES = [
    name
    for name in report.__all__
    if name.startswith("plot_") and next(iter(inspect.signature(getattr(report, name)).parameters)) == "tables"
    if name != "plot_sensitivity"
]


@pytest.fixture
def axes():
    figure, one = plt.subplots(figsize=(5, 4))
    yield one
    plt.close(figure)


def traces(axes):
    """As plotly has them: what is no trace or attribute of its is refused."""
    return to_plotly(axes).data


def xy(trace) -> np.ndarray:
    return np.stack([np.asarray(trace["x"], float), np.asarray(trace["y"], float)], axis=1)


@pytest.mark.parametrize("name", _PICTURES)
def test_every_picture_of_a_report_has_its_twin(name, axes):
    getattr(report, name)(Tables(adjusted("cross")), ax=axes)
    found = to_plotly(axes)
    assert len(found.data)
    shown = np.log10(axes.get_xlim()) if axes.get_xscale() == "log" else axes.get_xlim()
    assert found.layout.xaxis.range == pytest.approx(tuple(shown))
    assert found.layout.yaxis.title.text == axes.get_ylabel()
    # Nothing lies farther outside than arrows reach.
    limits = np.sort([axes.get_xlim(), axes.get_ylim()], axis=1)
    span = np.diff(limits, axis=1)[:, 0]
    for trace in (t for t in found.data if t.type == "scatter"):
        at = xy(trace)[np.isfinite(xy(trace)).all(axis=1)]
        assert (at >= limits[:, 0] - 0.5 * span).all()
        assert (at <= limits[:, 1] + 0.5 * span).all()


@pytest.mark.parametrize("in_3d", [False, True])
def test_the_block_has_its_stations_and_its_legend(in_3d):
    block = adjusted("cross").block
    axes = plot_block(adjusted("cross"), in_3d=in_3d)
    found = {t["name"]: t for t in traces(axes) if t["showlegend"]}
    stations = found["camera stations"]
    np.testing.assert_allclose(xy(stations), np.asarray(adjusted("cross").unknowns.exterior.position)[:, :2])
    assert len(stations["x"]) == len(block.images)
    assert set(found) == {t.get_text() for t in axes.get_legend().get_texts()}
    plt.close(axes.figure)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-50, 50)] * 4), min_size=1, max_size=6))
def test_arrows_end_where_they_point(rows):
    """In the coordinates of the data, whatever the picture is stretched by."""
    x, y, u, v = np.array(rows).T
    # Shorter ones are dots to matplotlib.
    u = u + 25 * np.where(u < 0, -1, 1)
    figure, one = plt.subplots(figsize=(5, 4))
    one.set(xlim=(-200, 200), ylim=(-120, 120))
    one.quiver(x, y, u, v, angles="xy", scale_units="xy", scale=2.0, color="C0")
    areas, told = traces(one)
    plt.close(figure)
    np.testing.assert_allclose(xy(told), np.stack([x, y], axis=1), atol=1e-9)
    np.testing.assert_array_equal(told["customdata"], np.stack([u, v], axis=1))
    ends = np.flatnonzero(np.isnan(np.asarray(areas["x"], float)))
    parts = np.split(xy(areas), ends)
    assert len(parts) == len(rows)
    for part, base, motion in zip(parts, np.stack([x, y], 1), np.stack([u, v], 1) / 2, strict=True):
        off = part[~np.isnan(part[:, 0])] - base
        farthest = off[np.argmax(off @ motion)]
        np.testing.assert_allclose(farthest, motion, atol=1e-6 * np.abs(motion).max())


@pytest.mark.parametrize("origin", ["upper", "lower"])
def test_a_raster_lies_as_matplotlib_lays_it(origin, axes):
    z = np.arange(6.0).reshape(2, 3)
    image = axes.imshow(z, origin=origin, extent=(10, 40, -4, 4))
    (found,) = traces(axes)
    np.testing.assert_array_equal(found["z"], z)
    np.testing.assert_allclose(found["x"], [15, 25, 35])
    # The first row is at the top where the origin is the upper one.
    np.testing.assert_allclose(found["y"], [2, -2] if origin == "upper" else [-2, 2])
    assert found["colorscale"][0][1] == "rgba({},{},{},{:.3g})".format(
        *np.round(255 * np.array(image.to_rgba(0.0))[:3]).astype(int), 1.0
    )


def test_lines_that_stand_by_the_frame_and_logarithmic_axes(axes):
    axes.set(xscale="log", xlim=(1, 1000), ylim=(-2, 6))
    axes.plot([1, 10, 1000], [0, 5, -1], "r--o", label="seen")
    axes.axvline(100.0)
    line, upright = traces(axes)
    np.testing.assert_array_equal(xy(line), [[1, 0], [10, 5], [1000, -1]])
    np.testing.assert_allclose(xy(upright), [[100, -2], [100, 6]], rtol=1e-9)
    assert (line["line"]["dash"], line["mode"], line["name"]) == ("dash", "lines+markers", "seen")
    layout = to_plotly(axes).layout
    assert layout.xaxis.type == "log"
    assert layout.xaxis.range == pytest.approx((0, 3))


def test_ellipses_bands_and_bars_keep_their_size(axes):
    axes.set(xlim=(-10, 10), ylim=(-8, 8))
    axes.add_collection(
        EllipseCollection([4.0], [2.0], [0.0], units="xy", offsets=[(1.0, -3.0)], offset_transform=axes.transData)
    )
    axes.fill_between([-9, -5], [5, 5], [6, 7], color=(1, 0, 0, 0.25))
    axes.bar([5], [7.5], width=1.0)
    found = [xy(t) for t in traces(axes) if t["type"] == "scatter" and t["fill"] == "toself"]
    boxes = sorted(np.round(np.concatenate([np.nanmin(p, 0), np.nanmax(p, 0)]), 2).tolist() for p in found)
    assert boxes == [[-9, 5, -5, 7], [-1, -4, 3, -2]]
    (bar,) = (t for t in traces(axes) if t["type"] == "bar")
    assert (bar["x"], bar["y"], bar["width"], bar["base"]) == ((5.0,), (7.5,), (1.0,), None)


def test_scattered_markers_bring_their_colours_and_the_bar(axes):
    shown = axes.scatter([1, 2, 3], [4, 5, 6], c=[0.0, 5.0, 10.0], s=36)
    axes.figure.colorbar(shown, ax=axes, label="sigma [m]")
    (found,) = traces(axes)
    np.testing.assert_array_equal(found["marker"]["color"], [0.0, 5.0, 10.0])
    assert found["marker"]["colorbar"]["title"]["text"] == "sigma [m]"
    assert found["marker"]["size"] == pytest.approx(8.0)
    assert (found["marker"]["cmin"], found["marker"]["cmax"]) == (0.0, 10.0)


def test_words_at_axes_and_in_the_picture_are_kept(axes):
    axes.set_xticks([0, 1], ["c", "k1"])
    axes.text(0.5, 0.25, "inside", rotation=30)
    axes.text(1.0, 1.0, "corner", transform=axes.transAxes, ha="right", va="top")
    axes.set_title("left one", loc="left")
    found = to_plotly(axes).layout
    assert (found.xaxis.tickvals, found.xaxis.ticktext) == ((0.0, 1.0), ("c", "k1"))
    inside, corner = found.annotations
    assert (inside.x, inside.y, inside.xref, inside.textangle) == (0.5, 0.25, "x", -30.0)
    assert (corner.xref, corner.yref, corner.xanchor, corner.yanchor) == ("x domain", "y domain", "right", "top")
    assert found.title.text == "left one"


def test_a_figure_of_no_window_has_its_arrows_and_key():
    axes = report.new_figure(5, 4).subplots(1, 2)[0]
    arrows = axes.quiver([0, 1], [0, 1], [1, 0.5], [0, 1], [1.0, 2.0], angles="xy", scale_units="xy", scale=1.0)
    axes.quiverkey(arrows, 0.9, 1.05, 1.0, "1 m")
    axes.figure.colorbar(arrows, ax=axes, label="sigma [m]")
    found = to_plotly(axes)
    assert "  1 m" in [t for trace in found.data if trace.text for t in trace.text]
    assert [t.marker.colorbar.title.text for t in found.data if t.marker.showscale] == ["sigma [m]"]
    # Of two panels the one.
    assert (found.layout.width, found.layout.height) == (240, 384)


def test_words_on_logarithmic_axes_and_steps(axes):
    axes.set(xscale="log", xlim=(1, 1000))
    axes.text(100.0, 0.5, "here")
    axes.step([1, 10, 100], [0, 1, 0])
    found = to_plotly(axes)
    assert (found.layout.annotations[0].x, found.layout.annotations[0].y) == pytest.approx((2.0, 0.5))
    assert found.data[0].line.shape == "vh"


def test_nothing_scattered_and_markers_without_a_face(axes):
    axes.scatter([], [], c=[])
    axes.scatter([1, 2], [1, 2], facecolors="none", edgecolors=["r", "b"])
    _, hollow = traces(axes)
    assert hollow["marker"]["symbol"] == "circle-open"
    assert list(hollow["marker"]["color"]) == ["rgba(255,0,0,1)", "rgba(0,0,255,1)"]


def test_a_coloured_picture_has_no_twin(axes):
    axes.imshow(np.zeros((2, 2, 3)))
    with pytest.warns(UserWarning, match="AxesImage has no twin"):
        to_plotly(axes)


def test_polar_axes_are_refused():
    figure, round_ones = plt.subplots(subplot_kw={"projection": "polar"})
    with pytest.raises(InputError, match="axes are polar"):
        to_plotly(round_ones)
    plt.close(figure)


def test_what_has_no_twin_is_said(axes):
    axes.table([["a", "b"]])
    with pytest.warns(UserWarning, match="Table has no twin in plotly: it is not shown"):
        to_plotly(axes)
