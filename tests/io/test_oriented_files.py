"""Orientations with separate image points, in local and map systems, and refusals."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.camera import Brown, InteriorOrientation, Sensor, get_parameter, parameter_names
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import ProjectCamera, export, read_source, read_tables
from jaxphoto.extras.formats.texts import named, points_of, read_exterior, with_marks
from jaxphoto.io.block_folder.table_layout import XYZ
from jaxphoto.rotation import matrix_from_omega_phi_kappa
from tests.formulas import camera_from_object
from tests.io.oriented_files import (
    inside,
    markers,
    misfits_px,
    poses,
    write_angles,
    write_bingo,
    write_metashape,
    write_patb,
)
from tests.io.test_exports import SENSOR, photographs
from tests.io.test_reconstructions import free_of


def misfits_of(block, p):
    """Reprojection errors (px) of the start values and the points that were photographed."""
    points = p.xyz[[p.points.index(name) for name in block.points]]
    return misfits_px(block, block.frame.map.local(p.frame.map.map(points)) if block.frame.kind == "epsg" else points)


@pytest.mark.filterwarnings("ignore:.*fewer than")
@pytest.mark.parametrize(("camera", "kind"), [("agisoft", "epsg"), ("agisoft fisheye", "local")])
def test_cameras_of_metashape_and_image_points_of_bingo_are_a_block(tmp_path, camera, kind):
    p = inside(camera, kind)
    block = read_source(write_metashape(tmp_path / "in", camera, kind))
    assert block.sensors["one"] == SENSOR and block.frame.kind == kind and block.datum.kind == "inner"
    assert len(block.images) == len(set(p.image.tolist())) and len(block.image_points.image) > 60
    assert np.abs(misfits_of(block, p)).max() < 1e-6
    assert free_of(block, "one") == {"c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2"}


REAL = """<document version="2.0.0"><chunk label="Chunk 1"><sensors><sensor id="0" label="M3M" type="frame">
<resolution width="5280" height="3956"/><property name="pixel_width" value="0.00335820"/>
<calibration type="frame" class="adjusted"><resolution width="5280" height="3956"/><f>3705.4728792737214</f>
<cx>11.6738523909</cx><cy>-27.7497969199</cy><k1>-0.0919367147</k1></calibration></sensor></sensors>
<components><component id="0"><transform><rotation locked="true">0.8710699454 0.3070967021 -0.3833128821 -0.4909742007
0.5658364395 -0.6623997719 0.0134716110 0.7651932691 0.6436596744</rotation>
<translation locked="true">-2499366.429888 -4256836.520906 4029217.965003</translation>
<scale locked="true">12.354192447331316</scale></transform></component></components>
<cameras><group id="0" label="Group 1" type="folder"><camera id="0" sensor_id="0" component_id="0" label="one.JPG">
<transform>-0.99988146 -0.00872749 0.01268391 7.04224697 -0.00842932 0.99969124 0.02337453 7.05403071
-0.01288400 0.02326485 -0.99964631 0.43561421 0 0 0 1</transform></camera></group></cameras></chunk></document>"""


def test_a_camera_exported_by_metashape_agrees_with_gnss_and_looks_down(tmp_path):
    """One photograph of a flight that is public: its GNSS says -120.417985477, 39.41191747, 2420.109."""
    # Two of it, because points of one photograph tie nothing.
    twice = re.sub(r"(<camera .*?</camera>)", lambda m: m[1] + m[1].replace("one.JPG", "two.JPG"), REAL, flags=re.S)
    (tmp_path / "cameras.xml").write_text(twice)
    rows = "1 0.5 0.5\n2 -0.5 0.5\n3 0.5 -0.5\n-99\n"
    (tmp_path / "ties.dat").write_text(f"one c\n{rows}two c\n{rows}")
    images = read_tables(tmp_path, "metashape").tables["images"]
    at = [images.numbers(name)[0] for name in ("longitude_deg", "latitude_deg", "height_m")]
    assert np.abs((at - np.array([-120.417985477, 39.41191747, 2420.109])) / [1e-4, 1e-4, 10]).max() < 1
    # Yaw was 179.9 degrees: the camera's x axis points west.
    omega, phi, kappa = (images.numbers(f"{name}_deg")[0] for name in ("omega", "phi", "kappa"))
    assert abs(omega) < 3 and abs(phi) < 3 and abs(abs(kappa) - 180) < 3


TEXTS = {
    "as --to opk writes them": lambda folder: write_angles(folder, points="own"),
    "bingo": lambda folder: write_angles(folder),
    "pixels": lambda folder: write_angles(folder, "local", points="pix4d"),
    "gon": lambda folder: write_angles(folder, change=in_gon, points="patb"),
    "matrices": lambda folder: write_patb(folder),
    "bingo's angles": lambda folder: write_bingo(folder),
    "bingo's on the map": lambda folder: write_bingo(folder, "epsg", change=lambda t: "* EPSG:32633\n" + t),
}


def in_gon(text):
    """Angles in gon before the positions, and said so."""
    lines = [line for line in text.split("\n") if line]
    head = [line.replace("degrees", "gon") for line in lines if line.startswith("#")]
    rows = [line.split("\t") for line in lines if not line.startswith(("#", "imageName"))]
    turned = [[row[0], *(repr(float(v) / 0.9) for v in row[4:]), *row[1:4]] for row in rows]
    return "\n".join([*head, "imageName omega phi kappa X Y Z", *map(" ".join, turned)])


@pytest.mark.filterwarnings("ignore:.*fewer than")
@pytest.mark.parametrize("name", TEXTS)
def test_texts_of_orientations_image_points_and_a_camera_are_a_block(tmp_path, name):
    block = read_source(TEXTS[name](tmp_path / "in"))
    p = inside("opencv", block.frame.kind)
    assert block.sensors == {"one": SENSOR} and set(block.images) <= set(p.images) and len(block.images) > 2
    assert np.abs(misfits_of(block, p)).max() < 1e-6
    assert free_of(block, "one") == {"c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2", "b1"}


@settings(max_examples=25, deadline=None)
@given(
    case=st.sampled_from(
        [("metashape", "agisoft", "local"), ("metashape", "agisoft", "epsg"), ("opk", "opencv", "local")]
    ),
    values=poses,
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:.*fewer than", "ignore:.*skipped")
def test_poses_round_trip(tmp_path_factory, case, values):
    (format, camera, kind), folder, values = case, tmp_path_factory.mktemp("poses"), np.array(values)
    turn = np.stack([camera_from_object(*angles) for angles in values[:, 3:]])
    p = photographs(camera, kind)._replace(exterior=ExteriorOrientation(values[:, :3], turn))
    export(p, folder, format)
    rows = "".join(f"{k} {k}.5 {k}.25\n" for k in range(3))
    (folder / "image_points.csv").unlink()
    (folder / "ties.txt").write_text("".join(f"{name} camera\n{rows}-99\n" for name in p.images))
    tables = read_tables(folder, "texts" if format == "opk" else format)
    table, (read,) = tables.tables["images"], tables.settings["cameras"].values()
    wanted = p.in_map().exterior
    order = [p.images.index(name) for name in table.text("image")]
    position = np.stack([table.numbers(name) for name in XYZ], axis=1)
    # A northing of a map has nine digits before those of a nanometre.
    tolerance = 1e-9 if kind == "local" else 1e-8
    np.testing.assert_allclose(position, np.asarray(wanted.position)[order], rtol=0, atol=tolerance)
    angles = np.deg2rad(np.stack([table.numbers(f"{name}_deg") for name in ("omega", "phi", "kappa")], axis=1))
    again = np.stack([camera_from_object(*row) for row in angles])
    np.testing.assert_allclose(again, np.asarray(wanted.camera_from_object)[order], rtol=0, atol=1e-9)
    interior, scale = p.cameras["one"].interior, read["pixel_mm"] / SENSOR.pixel_mm
    for name in parameter_names(interior):
        value = read["interior"][name] / (scale if name.endswith("_mm") else 1)
        assert value == pytest.approx(float(get_parameter(interior, name)), abs=1e-9), name


@pytest.mark.filterwarnings("ignore:.*fewer than")
def test_markers_of_metashape_are_control_and_tie_photographs(tmp_path):
    p = inside()
    names = [p.points[k] for k in np.argsort(-np.bincount(p.point, minlength=40))[:8]]
    at = p.in_map().xyz[[p.points.index(name) for name in names]]
    more = markers(p, names, at)
    write_metashape(tmp_path / "in", change=lambda text: text.replace("</chunk>", more + "</chunk>"), ties=False)
    block = read_source(tmp_path / "in")
    assert set(block.points) == set(names) and block.datum.kind == "control"
    assert len(block.check.who) == 3 and len(block.control.who) == 21
    assert np.asarray(block.control.sigma).tolist() == [0.02, 0.02, 0.03] * 7
    assert np.abs(misfits_of(block, p)).max() < 1e-6


def _without(pattern):
    return lambda text: re.sub(pattern, "", text, flags=re.S)


def _metashape(change=lambda text: text, **more):
    return lambda folder: write_metashape(folder, change=change, **more)


def _angles(change):
    return lambda folder: write_angles(folder, change=change) / "exterior.txt"


def _patb(change):
    return lambda folder: write_patb(folder, change=change) / "patb.ori"


def changed(folder, name, old, new):
    path = folder / name
    path.write_text(path.read_text().replace(old, new))
    return folder


def without(folder, name):
    (folder / name).unlink()
    return folder


def appended(folder, text, name="ties.dat"):
    path = folder / name
    path.write_text(path.read_text() + text)
    return folder


REFUSED = {
    "no ties": (_metashape(ties=False), "cameras.xml has no tie points and no marks.*as BINGO or PATB"),
    "not aligned": (_metashape(_without("<transform>-?[0-9].*?</transform>")), "no camera is aligned; align"),

    "cut": (_metashape(lambda text: text[:-30]), "cameras.xml: damaged"),
    "no sensor": (_metashape(_without("<calibration.*</calibration>")), "'a b': .* its sensor is not calibrated"),
    "matrix": (_metashape(lambda text: text.replace(" 1.0</tr", " x</tr")), "'a b', transform: .* 16 fi"),
    "scale": (_metashape(lambda text: text.replace(">1.0</scale>", ">-1</scale>")), "scale -1 is not positive"),
    "moved": (
        _metashape(lambda text: re.sub("<translation.*?</translation>", "<translation>0 0 0</translation>", text)),
        "off the Earth's surface",
    ),
    "row": (_angles(lambda text: text + "lost 1 2 3\n" * 2), "row 8: 'lost 1 2 3' is not name, X, Y, Z, omega"),

    "system": (_angles(lambda text: text.replace("EPSG:32633", "EPSG:99999")), "EPSG code 99999 is unknown"),
    "no camera": (lambda folder: without(write_angles(folder), "camera.toml"), "0 camera files, not 1"),
    "no points": (lambda folder: without(write_angles(folder), "ties.dat") / "exterior.txt", "has no image points"),
    "point": (lambda folder: appended(write_angles(folder), "a b c\n7 1\n"), "row [0-9]+: '7 1' is not point"),
    "xy": (lambda folder: appended(write_angles(folder), "a b c\n7 1 x\n"), "'1 x' is not 2 numbers"),
    "matrix end": (_patb(lambda text: text.rsplit("\n", 2)[0]), "patb.ori, row 10: .* is not the start of a three-row"),
    "bingo's row": (
        lambda folder: write_bingo(folder, change=lambda t: re.sub(r" \S+ 1$", "", t.rstrip())) / "itera.dat",
        r"itera.dat, row \d+: .* is not ORIA, name, X, Y, Z, phi, omega, kappa",
    ),
    "spherical": (_metashape(lambda text: text.replace('"frame"', '"spherical"')), "'spherical' is not supported"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_files_are_refused(tmp_path, name):
    write, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        read_source(write(tmp_path / "in"))


def test_untied_photographs_are_reported(tmp_path):
    write_metashape(tmp_path / "in", ties=False)
    (tmp_path / "in" / "ties.txt").write_text("a b camera\n1 0.5 0.5\n2 0.5 0.6\n3 0.5 0.7\n-99\nlost camera\n")
    with (
        pytest.raises(InputError, match="no image shares 3 points with others"),
        pytest.warns(UserWarning, match="1 photographs that are not in cameras.xml: 'lost camera'"),
        pytest.warns(UserWarning, match=r"3 point\(s\) in fewer than two images"),
    ):
        read_source(tmp_path / "in")


def test_two_texts_of_image_points_are_one_too_many(tmp_path):
    write_metashape(tmp_path / "in")
    text = (tmp_path / "in" / "bingo.txt").read_text()
    (tmp_path / "in" / "again.dat").write_text(text)
    with pytest.raises(InputError, match=r"2 files of image points \(again.dat, bingo.txt\); keep one"):
        read_source(tmp_path / "in")


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("imageName X Y Z Omega Phi Kappa", "{name} 1.5 2.5 100 3 -2 90"),
        ("# Name, Easting, Northing, Height, Phi (deg), Omega (deg), Kappa (deg)", "{name}, 1.5, 2.5, 100, -2, 3, 90"),
        ("Name;Latitude;Longitude;Altitude;Omega;Phi;Kappa", "{name};2.5;1.5;100;3;-2;90"),
        ("PhotoID X Y Z Omega Phi Kappa r11 r12 r13 r21", "{name} 1.5 2.5 100 3 -2 90 1 0 0 0"),
        ("angles in gon\nPhoto X Y Z Omega Phi Kappa", "{name} 1.5 2.5 100 3.3333333333333335 -2.2222222222222223 100"),
        ("image X Y Z omega phi kappa", "two words {name} 1.5 2.5 100 3 -2 90"),
    ],
)
def test_columns_of_orientations_are_those_that_their_header_names(tmp_path, head, row):
    path = tmp_path / "ext.txt"
    path.write_text(head + "\n" + "".join(row.format(name=name) + "\n" for name in ("a.jpg", "b.jpg", "c.jpg")))
    found = read_exterior(path)
    assert [name.split()[-1] for name in found.names] == ["a.jpg", "b.jpg", "c.jpg"]
    np.testing.assert_allclose(found.positions, [[1.5, 2.5, 100.0]] * 3)
    expected = matrix_from_omega_phi_kappa(np.radians([3.0, -2.0, 90.0]))
    np.testing.assert_allclose(found.camera_from_object[1], expected, atol=1e-12)


@pytest.mark.parametrize("head", ["Name X Y Z Winkel Phi Kappa", "", "a.jpg 1.5 2.5 100 3 -2 90"])
def test_orientations_without_a_header_are_refused(tmp_path, head):
    path = tmp_path / "ext.txt"
    path.write_text(head + "\n" + "a.jpg 1.5 2.5 100 3 -2 90\n" * 3)
    with pytest.raises(InputError, match=r"ext\.txt has no orientations; write the header"):
        read_exterior(path)


def test_a_tie_point_of_a_markers_name_is_another_point_unless_it_lies_there():
    names, at = ["1", "2", "3"], np.array([[10.0, 10.0], [20.0, 20.0], [30.0, 30.0]])
    ties = named([0, 0, 0, 1], [*names, "1"], np.vstack([at, [[50.0, 50.0]]]))
    rows = [("a", "1", [10.5, 10.0]), ("a", "2", [200.0, 200.0]), ("b", "2", [5.0, 5.0]), ("c", "9", [1.0, 1.0])]
    marks = [(*row, np.nan, "") for row in rows]
    with pytest.warns(UserWarning, match=r"1 tie points have the name of a marker elsewhere \(2\)"):
        both = with_marks(ties, marks, ["a", "b"], "a.xml")
    rows = {(i, both.points[p], *at) for i, p, at in zip(both.image, both.point, both.column_row.tolist(), strict=True)}
    assert rows == {
        (0, "1", 10.5, 10.0), (1, "1", 50.0, 50.0), (0, "2 (tie)", 20.0, 20.0), (0, "3", 30.0, 30.0),
        (0, "2", 200.0, 200.0), (1, "2", 5.0, 5.0),
    }  # fmt: skip


def test_empty_lines_end_photographs_and_signs_identify_millimetres(tmp_path):
    text = tmp_path / "ties.txt"
    text.write_text("a.jpg\n1 -1.0 2.0\n2 3.0 1.0\n\nb.jpg\n1 4.0 2.0\n2 1.0 0.5\n\n")
    sensor = Sensor(1000, 800, 0.01)
    camera = ProjectCamera(sensor, InteriorOrientation(20.0, 0.0, 0.0, Brown()))
    found = points_of(text, ["a.jpg", "b.jpg"], "ext.txt", [camera] * 2)
    np.testing.assert_allclose(found.column_row, [[400.0, 200.0], [800.0, 300.0], [900.0, 200.0], [600.0, 350.0]])
    text.write_text(text.read_text().replace("-", ""))
    pixels = points_of(text, ["a.jpg", "b.jpg"], "ext.txt", [camera] * 2).column_row
    np.testing.assert_allclose(pixels, [[1.0, 2.0], [3.0, 1.0], [4.0, 2.0], [1.0, 0.5]])
