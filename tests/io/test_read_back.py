"""Round trips of exports by `read_source`: identical values, identical adjustments."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxphoto
from jaxphoto.camera import InteriorOrientation, OpenCv, Sensor, get_parameter, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import (
    ControlPoints,
    Project,
    ProjectCamera,
    export,
    read_source,
    read_tables,
)
from jaxphoto.io.block_folder.table_layout import SIGMA_XYZ, XYZ
from tests.io.oriented_files import come_back, inside, posed, poses
from tests.io.test_exports import CAMERAS, SENSOR

# Formats whose image points stand beside their files.
BESIDE = {"metashape": "agisoft", "opk": "opencv"}


@pytest.mark.filterwarnings("ignore:.*fewer than")
@pytest.mark.parametrize("format", BESIDE)
def test_image_points_come_back_with_their_standard_deviations(tmp_path, format):
    p = inside(BESIDE[format], "epsg")
    sigma = np.random.default_rng(1).uniform(0.2, 2.0, len(p.image))
    export(p._replace(sigma_px=np.repeat(sigma[:, None], 2, axis=1)), tmp_path / "out", format)
    block = read_source(tmp_path / "out")
    rows = zip(p.image, p.point, p.column_row, sigma, strict=True)
    given = {(p.images[i], p.points[j]): (*at, s, s) for i, j, at, s in rows}
    again = Project.of_block(block, block.start.unknowns)
    assert len(again.image) > 60
    for i, j, at, s in zip(again.image, again.point, again.column_row, again.sigma_px, strict=True):
        np.testing.assert_allclose((*at, *s), given[again.images[i], again.points[j]], rtol=0, atol=1e-9)


@pytest.mark.filterwarnings("ignore:.*fewer than")
def test_different_standard_deviations_of_x_and_y_are_reported(tmp_path):
    p = inside("opencv", "local")
    with pytest.warns(UserWarning, match="sigma_x and sigma_y differ, but image_points.csv has one column"):
        export(p._replace(sigma_px=np.tile([3.0, 4.0], (len(p.image), 1))), tmp_path / "out", "opk")
    block = read_source(tmp_path / "out")
    np.testing.assert_allclose(np.asarray(block.image_points.sigma) / SENSOR.pixel_mm, np.sqrt(12.5), rtol=1e-12)


@pytest.mark.filterwarnings("ignore:.*fewer than")
@pytest.mark.parametrize("format", ["metashape", "opk"])
def test_a_block_adjusts_to_the_same_values_again(tmp_path, format):
    p = inside(BESIDE[format], "local")
    rng = np.random.default_rng(2)
    sigma = np.repeat(rng.uniform(0.2, 0.4, len(p.image))[:, None], 2, axis=1)
    p = p._replace(column_row=p.column_row + rng.normal(0, 0.3, (len(p.image), 2)), sigma_px=sigma)
    export(p, tmp_path / "first", format)
    first = jaxphoto.adjust(read_source(tmp_path / "first").fix("k3"))
    assert first.converged
    export(Project.of(first), tmp_path / "again", format)
    again = jaxphoto.adjust(read_source(tmp_path / "again").fix("k3"))
    assert float(again.sigma0) == pytest.approx(float(first.sigma0), rel=1e-9)
    (one,) = first.unknowns.interior.values()
    (two,) = again.unknowns.interior.values()
    for name in parameter_names(one):
        assert float(get_parameter(two, name)) == pytest.approx(float(get_parameter(one, name)), abs=1e-7), name


@pytest.mark.filterwarnings("ignore:.*fewer than")
def test_several_cameras_come_back_with_their_photographs_from_opk(tmp_path):
    p = inside("opencv", "local")
    other = ProjectCamera(Sensor(SENSOR.width_px, SENSOR.height_px, 0.002), CAMERAS["brown"])
    two = p._replace(cameras={**p.cameras, "two": other}, image_camera=("two", "one", "one", "two"))
    export(two, tmp_path / "out", "opk")
    block = read_source(tmp_path / "out")
    assert dict(zip(block.images, block.image_camera, strict=True)) == dict(
        zip(p.images, two.image_camera, strict=True)
    )
    for name, (sensor, interior, _) in two.cameras.items():
        assert block.sensors[name] == sensor
        again = block.start.unknowns.interior[name]
        assert [float(get_parameter(again, n)) for n in parameter_names(interior)] == pytest.approx(
            [float(get_parameter(interior, n)) for n in parameter_names(interior)], abs=1e-15
        )
    back = Project.of_block(block, block.start.unknowns)
    own = {(two.images[i], two.points[k]): at for i, k, at in zip(two.image, two.point, two.column_row, strict=True)}
    for i, k, at in zip(back.image, back.point, back.column_row, strict=True):
        np.testing.assert_allclose(at, own[back.images[i], back.points[k]], rtol=0, atol=1e-9)
    table = tmp_path / "out" / "images.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(InputError, match=r"images.csv has no camera for 1 photographs \(f.tif\); add a row"):
        read_source(tmp_path / "out")
    table.unlink()
    with pytest.raises(InputError, match=r"camera.toml has several cameras.*; write images.csv into"):
        read_source(tmp_path / "out")


term = st.floats(-0.2, 0.2)
# Formats that hold points with their image points, and the names of OpenCV's coefficients there.
WHOLE = {"opensfm": {}, "blocksexchange": {"p1": "p2", "p2": "p1"}}


@settings(max_examples=40, deadline=None)
@given(
    format=st.sampled_from(list(WHOLE)),
    values=poses,
    c=st.floats(2.0, 200.0),
    at=st.tuples(term, term),
    terms=st.sampled_from([(), ("k1",), ("k1", "k2", "k3"), ("k1", "k2", "k3", "p1", "p2")]),
    numbers=st.lists(term.filter(bool), min_size=5, max_size=5),
)
def test_cameras_poses_points_and_image_points_round_trip(tmp_path_factory, format, values, c, at, terms, numbers):
    folder = tmp_path_factory.mktemp("scene")
    given = dict(zip(terms, numbers, strict=False))
    p = posed(values, InteriorOrientation(c, *at, OpenCv(**given)))
    assert export(p, folder, format).cameras["one"].max_px == 0
    tables = read_tables(folder, format)
    come_back(p, tables, list(p.images))
    (camera,) = tables.settings["cameras"].values()
    scale = camera["pixel_mm"] / SENSOR.pixel_mm
    wanted = {"c_mm": c * scale, "xp_mm": at[0] * scale, "yp_mm": at[1] * scale}
    wanted |= {WHOLE[format].get(name, name): value for name, value in given.items()}
    assert set(wanted) <= {name for name, prior in camera["unknowns"].items() if prior == "free"}
    for name, value in camera["interior"].items():
        assert value == pytest.approx(wanted.get(name, 0.0), rel=1e-12, abs=1e-9)
    rows, points = tables.tables["image_points"], tables.tables["object_points"].text("point").tolist()
    shown = np.stack([rows.numbers("column_px"), rows.numbers("row_px")], axis=1)
    own = {(p.images[i], points[j]): at for i, j, at in zip(p.image, p.point, p.column_row, strict=True)}
    names = list(zip(rows.text("image"), rows.text("point"), strict=True))
    assert set(names) == set(own)
    np.testing.assert_allclose(shown, [own[name] for name in names], rtol=0, atol=1e-9)


# Control ------------------------------------------------------------------------------------------------------------


def with_control(p, xyz, sigma_m, check):
    """The first points that four photographs show are known, with these errors; NaN is not given."""
    often = np.argsort(-np.bincount(p.point, minlength=len(p.points)), kind="stable")[: len(xyz)]
    return p._replace(control=ControlPoints(often, p.xyz[often] + xyz, sigma_m, check))


offset = st.floats(-0.5, 0.5)


@settings(max_examples=15, deadline=None)
@given(
    kind=st.sampled_from(["local", "epsg"]),
    errors=st.lists(st.tuples(offset, offset, offset), min_size=5, max_size=5),
    sigmas=st.lists(st.floats(1e-3, 2.0), min_size=15, max_size=15),
    height=st.booleans(),
)
@pytest.mark.filterwarnings("ignore:.*fewer than two images")
def test_control_comes_back_in_markers(tmp_path_factory, kind, errors, sigmas, height):
    folder, p = tmp_path_factory.mktemp("markers"), inside("agisoft", kind)
    xyz, sigma = np.array(errors), np.array(sigmas).reshape(5, 3)
    if not height:
        xyz[0, 2] = sigma[0, 2] = np.nan
    p = with_control(p, xyz, sigma, np.arange(5) == 4)
    export(p, folder, "metashape")
    table = read_tables(folder, "metashape").tables["control_points"]
    names = [p.points[k] for k in p.control.point]
    assert sorted(table.text("point")) == sorted(names)
    order = [names.index(name) for name in table.text("point")]
    assert list(table.text("role")) == ["check" if k == 4 else "control" for k in order]
    wanted = p.control.xyz
    if kind == "epsg":
        # Through the map, by the place that the adjusted point has where no height is given.
        full = np.where(np.isnan(wanted), p.xyz[p.control.point], wanted)
        wanted = np.where(np.isnan(wanted), np.nan, p.frame.map.map(full))
    found = np.stack([table.numbers(n, empty=True) for n in XYZ], axis=1)
    # A northing of a map has nine digits before those of a nanometre.
    np.testing.assert_allclose(found, wanted[order], rtol=0, atol=1e-9 if kind == "local" else 2e-9)
    again = np.stack([table.sigmas(n) for n in SIGMA_XYZ], axis=1)
    given = np.ones((5, 3), bool) if height else ~np.isnan(wanted)
    np.testing.assert_array_equal(again[given[order]], sigma[order][given[order]])


def test_a_block_with_control_adjusts_to_the_same_values_again(tmp_path):
    p, rng = inside("agisoft", "epsg"), np.random.default_rng(4)
    p = with_control(p, rng.normal(0, 0.02, (8, 3)), np.full((8, 3), 0.02), np.arange(8) > 5)
    p = p._replace(column_row=p.column_row + rng.normal(0, 0.3, (len(p.image), 2)))
    p = p._replace(sigma_px=np.full((len(p.image), 2), 0.3))
    export(p, tmp_path / "first", "metashape")
    with pytest.warns(UserWarning, match="fewer than two images"):
        first = jaxphoto.adjust(read_source(tmp_path / "first"))
    assert first.converged and len(first.block.control.who) == 18 and len(first.block.check.who) == 6
    export(Project.of(first), tmp_path / "again", "metashape")
    again = jaxphoto.adjust(read_source(tmp_path / "again"))
    assert float(again.sigma0) == pytest.approx(float(first.sigma0), rel=1e-9)
    system = [a.block.frame.map.map(np.asarray(a.unknowns.exterior.position)) for a in (first, again)]
    np.testing.assert_allclose(*system, rtol=0, atol=1e-6)
    (one,), (two,) = (a.unknowns.interior.values() for a in (first, again))
    assert float(two.c) == pytest.approx(float(one.c), abs=1e-8)


@pytest.mark.filterwarnings("ignore:.*fewer than two images")
def test_incomplete_markers_are_reported(tmp_path):
    p = inside("agisoft", "local")
    none = np.full((4, 3), np.nan)
    heights = with_control(p, np.array([[0.0, 0, 0]] * 3 + [[np.nan, np.nan, 0]]), none, np.zeros(4, bool))
    with pytest.warns(UserWarning, match="skipped 1 control or check points without X and Y"):
        export(heights, tmp_path / "out", "metashape")
    assert len(read_source(tmp_path / "out").control.who) == 9


def test_control_of_a_block_by_point(tmp_path):
    """Held, in one row of three axes or several, and a check in height of what is control in position."""
    block = jaxphoto.read_block("examples/cross_block")
    points = ControlPoints.of(block)
    rows = block.control
    assert set(points.point[~points.check]) == {*rows.who, *block.fixed.who}
    for who, axis, value, sigma in zip(rows.who, rows.axis, rows.value, rows.sigma, strict=True):
        k = list(points.point).index(who)
        assert (points.xyz[k, axis], points.sigma_m[k, axis]) == (value, sigma)
    held = dataclasses.replace(block, fixed=rows, control=rows.take(np.zeros(0, int)), check=rows)
    again = ControlPoints.of(held)
    assert not again.check.any()
    np.testing.assert_array_equal(np.isnan(again.xyz), np.isnan(points.xyz[~points.check]))
