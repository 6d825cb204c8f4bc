"""What was exported comes back by `read_source`: whole, and adjusting to the same values."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxphoto
from jaxphoto.camera import InteriorOrientation, OpenCv, get_parameter, parameter_names
from jaxphoto.io import FORMATS, AdjustedPhotographs, export, read_source
from jaxphoto.io.exports import ExportCamera
from tests.io.oriented_files import come_back, inside, posed, poses
from tests.io.test_exports import SENSOR

# Formats whose image points stand beside their files.
BESIDE = {"metashape": "agisoft", "nerfstudio": "opencv", "orthority": "opencv", "opk": "opencv"}


@pytest.mark.filterwarnings("ignore:.*fewer than")
@pytest.mark.parametrize("format", BESIDE)
def test_image_points_come_back_with_their_standard_deviations(tmp_path, format):
    p = inside(BESIDE[format], "epsg" if format != "nerfstudio" else "local")
    sigma = np.random.default_rng(1).uniform(0.2, 2.0, len(p.image))
    export(p._replace(sigma_px=np.repeat(sigma[:, None], 2, axis=1)), tmp_path / "out", format)
    block = read_source(tmp_path / "out")
    rows = zip(p.image, p.point, p.column_row, sigma, strict=True)
    given = {(p.images[i], p.points[j]): (*at, s, s) for i, j, at, s in rows}
    again = AdjustedPhotographs.of_block(block, block.start.unknowns)
    assert len(again.image) > 60
    for i, j, at, s in zip(again.image, again.point, again.column_row, again.sigma_px, strict=True):
        np.testing.assert_allclose((*at, *s), given[again.images[i], again.points[j]], rtol=0, atol=1e-9)


@pytest.mark.filterwarnings("ignore:.*fewer than")
def test_standard_deviations_that_differ_by_axis_are_told(tmp_path):
    p = inside("opencv", "local")
    with pytest.warns(UserWarning, match="image_points.csv has one standard deviation for x and y"):
        export(p._replace(sigma_px=np.tile([3.0, 4.0], (len(p.image), 1))), tmp_path / "out", "nerfstudio")
    block = read_source(tmp_path / "out")
    np.testing.assert_allclose(np.asarray(block.image_points.sigma) / 0.001, np.sqrt(12.5), rtol=1e-12)


@pytest.mark.filterwarnings("ignore:.*fewer than")
@pytest.mark.parametrize("format", ["metashape", "nerfstudio", "orthority"])
def test_a_block_adjusts_to_the_same_values_again(tmp_path, format):
    p = inside(BESIDE[format], "local")
    rng = np.random.default_rng(2)
    sigma = np.repeat(rng.uniform(0.2, 0.4, len(p.image))[:, None], 2, axis=1)
    p = p._replace(column_row=p.column_row + rng.normal(0, 0.3, (len(p.image), 2)), sigma_px=sigma)
    export(p, tmp_path / "first", format)
    first = jaxphoto.adjust(read_source(tmp_path / "first").fix("k3"))
    assert first.converged
    export(AdjustedPhotographs.of(first), tmp_path / "again", format)
    again = jaxphoto.adjust(read_source(tmp_path / "again").fix("k3"))
    assert float(again.sigma0) == pytest.approx(float(first.sigma0), rel=1e-9)
    (one,) = first.unknowns.interior.values()
    (two,) = again.unknowns.interior.values()
    for name in parameter_names(one):
        assert float(get_parameter(two, name)) == pytest.approx(float(get_parameter(one, name)), abs=1e-7), name


term = st.floats(-0.2, 0.2)


@settings(max_examples=25, deadline=None)
@given(
    values=poses,
    c=st.floats(2.0, 200.0),
    at=st.tuples(term, term),
    terms=st.sampled_from([(), ("k1",), ("k1", "k2", "k3"), ("k1", "k2", "k3", "p1", "p2")]),
    numbers=st.lists(term.filter(bool), min_size=5, max_size=5),
)
def test_scenes_of_openmvg_come_back(tmp_path_factory, values, c, at, terms, numbers):
    folder = tmp_path_factory.mktemp("scene")
    given = dict(zip(terms, numbers, strict=False))
    p = posed(values, InteriorOrientation(c, *at, OpenCv(**given)))
    assert export(p, folder, "openmvg").cameras["one"].max_px == 0
    tables = FORMATS["openmvg"].read(folder)
    come_back(p, tables, list(p.images))
    (camera,) = tables.settings["cameras"].values()
    scale = camera["pixel_mm"] / SENSOR.pixel_mm
    wanted = {"c_mm": c * scale, "xp_mm": at[0] * scale, "yp_mm": at[1] * scale} | given
    assert {name for name, prior in camera["unknowns"].items() if prior == "free"} == set(wanted)
    for name, value in wanted.items():
        assert camera["interior"].get(name, 0.0) == pytest.approx(value, rel=1e-12, abs=1e-9)
    rows = tables.tables["image_points"]
    shown = np.stack([rows.numbers("column_px"), rows.numbers("row_px")], axis=1)
    own = {(p.images[i], str(j + 1)): at for i, j, at in zip(p.image, p.point, p.column_row, strict=True)}
    names = zip(rows.text("image"), rows.text("point"), strict=True)
    np.testing.assert_allclose(shown, [own[name] for name in names], rtol=0, atol=1e-9)


@pytest.mark.filterwarnings("ignore:.*fewer than")
def test_several_cameras_of_openmvg_are_told_apart_as_cereal_does(tmp_path):
    """The name of a kind stands with the first of it alone, and numbers of objects do not come twice."""
    p = inside("brown", "local")
    more = {n: ExportCamera(SENSOR, InteriorOrientation(9.0, 0, 0, OpenCv(k1=k))) for n, k in (("b", 0.0), ("c", 1e-2))}
    p = p._replace(cameras=p.cameras | more | {"d": p.cameras["one"]}, image_camera=("one", "b", "c", "d"))
    export(p, tmp_path / "out", "openmvg")
    scene = json.loads((tmp_path / "out" / "sfm_data.json").read_text())
    values = [item["value"] for item in scene["intrinsics"]]
    assert [v.get("polymorphic_name") for v in values] == ["pinhole_brown_t2", "pinhole", "pinhole_radial_k1", None]
    assert [v["polymorphic_id"] & 0x7FFFFFFF for v in values] == [1, 2, 3, 1]
    assert [v["polymorphic_id"] >> 31 for v in values] == [1, 1, 1, 0]
    ids = [item["value"]["ptr_wrapper"]["id"] for item in scene["views"] + scene["intrinsics"]]
    assert len(set(ids)) == len(ids) and all(number >> 31 for number in ids)
    tables = FORMATS["openmvg"].read(tmp_path / "out")
    assert dict(zip(tables.tables["images"].text("image"), tables.tables["images"].text("camera"), strict=True)) == {
        name: str(k) for k, name in enumerate(p.images)
    }
