"""Files of control in every form: told apart by content, read to the number, refused in a sentence."""

import contextlib
import json
import sqlite3
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.errors import InputError
from jaxphoto.extras.formats import export, read_control
from jaxphoto.procedures.control.surveyed import places, system_of
from tests.io import control_files as files
from tests.io.test_exports import photographs


def read(folder, points, marks=None):
    """From files whose names tell nothing."""
    (folder / "a").write_text(points, encoding="utf-8")
    if marks is not None:
        (folder / "b").write_text(marks, encoding="utf-8")
    return read_control(folder / "a", None if marks is None else folder / "b")


def test_a_gcp_list_has_points_and_marks(tmp_path):
    points, marks = read(tmp_path, files.GCP_LIST)
    assert points.ids == ("G1", "G2", "P1") and points.system == "EPSG:32633" and not points.check.any()
    np.testing.assert_array_equal(points.coordinates[0], (386800.10, 6175000.20, 30.5))
    assert np.isnan(points.coordinates[1, 2]) and np.isnan(points.sigma_m).all()
    assert marks.image[:2] == ("DJI_0001.JPG", "DJI_0002.JPG") and marks.point == ("G1", "G1", "G2", "P1", "P1")
    # Their (0, 0) is the centre of the first pixel, ours is (0.5, 0.5) there.
    np.testing.assert_array_equal(marks.column_row[[0, 2]], [(1013.0, 800.75), (100.0, 0.5)])


@pytest.mark.parametrize(
    "row",
    [
        "G{} 386800.5 61750{}0.2 30.5",
        "386800.5 61750{1}0.2 30.5 G{0}",
        "386800.5 61750{1}0.2 30.5 {0}",
        "{} 386800.5 61750{}0.2 nan",
    ],
)
def test_a_gcp_list_that_is_to_be_marked_has_points_alone(tmp_path, row):
    rows = "\n".join(row.format(k, k) for k in "123")
    points, marks = read(tmp_path, f"# of the survey\nEPSG:32633\n# the yard\n{rows}")
    assert [name[-1] for name in points.ids] == ["1", "2", "3"] and points.system == "EPSG:32633" and not marks.image
    np.testing.assert_array_equal(points.coordinates[:, 1], (6175010.2, 6175020.2, 6175030.2))
    assert np.isnan(points.coordinates[:, 2]).all() == ("nan" in row)


def test_markers_of_metashape(tmp_path):
    points, marks = read(tmp_path, files.MARKERS)
    assert points.ids == ("point 1", "point 2") and points.check.tolist() == [False, True]
    np.testing.assert_array_equal(points.coordinates[0], (13.2001, 55.7001, 30.5))
    np.testing.assert_array_equal(points.sigma_m, [(0.01, 0.01, 0.02), (0.005,) * 3])
    # What is not pinned was not measured.
    assert list(zip(marks.image, marks.point, strict=True)) == [
        ("DJI_0001.JPG", "point 1"), ("DJI_0002.JPG", "point 2"), ("DJI_0002.JPG", "tie"),
    ]  # fmt: skip
    np.testing.assert_array_equal(marks.column_row[0], (100.25, 200.5))
    assert system_of(points.system, "a").code == 4326


def test_the_reference_pane_of_metashape(tmp_path):
    points, marks = read(tmp_path, files.REFERENCE)
    assert points.ids == ("G1", "G2") and points.check.tolist() == [False, True] and not marks.image
    np.testing.assert_array_equal(points.coordinates[1], (386900.0, 6175100.0, 31.5))
    np.testing.assert_array_equal(points.sigma_m[0], (0.01, 0.01, 0.02))
    assert np.isnan(points.sigma_m[1]).all() and system_of(points.system, "a").code == 32633


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("G1,10.0,2O.0,30.0,0.02,0.03", "a, row 1: Y is '2O.0', not a number"),
        ("G1,10.0,20.0", "a, row 1: 3 cells, but most rows have 6"),
    ],
)
def test_one_bad_row_of_a_table_without_header_is_named(tmp_path, wrong, words):
    rows = [wrong, *(f"G{k},{k}.0,20.0,30.0,0.02,0.03" for k in range(2, 6))]
    with pytest.raises(InputError, match=words):
        read(tmp_path, "\n".join(rows))
    with pytest.raises(InputError, match="not a control file"):
        read(tmp_path, "\n".join(["who,knows,what,this,may,be", *rows[1:]]))


def test_pix4d_without_headers_is_in_the_order_of_the_axes(tmp_path):
    points, marks = read(tmp_path, files.PIX4D, files.PIX4D_MARKS)
    np.testing.assert_array_equal(points.sigma_m[0], (0.02, 0.02, 0.03))
    assert marks.image[0] == "D:/flight/DJI_0001.JPG" and marks.sigma_px.tolist() == [1.0, 0.5, 0.5]
    there = places(points, system_of("EPSG:4326", "a"), 4326)
    np.testing.assert_allclose(there[0], (13.20022, 55.70011, 29.931), rtol=1e-12)
    with_header = read(
        tmp_path, "Label,Latitude,Longitude,Altitude [m]\n" + files.PIX4D.replace(",0.02,0.03", "")
    ).points
    np.testing.assert_allclose(with_header.coordinates, there, rtol=1e-12)


def test_our_own_tables(tmp_path):
    points, marks = read(tmp_path, files.OWN, files.OWN_MARKS)
    assert points.system == "32633" and points.check.tolist() == [False, True]
    assert points.places == ("a, row 3", "a, row 4")
    np.testing.assert_array_equal(marks.column_row, [(100.25, 200.5), (110.25, 210.5)])
    assert marks.sigma_px[0] == 0.1 and np.isnan(marks.sigma_px[1])


@pytest.mark.parametrize(
    ("points", "marks", "words"),
    [
        ("", None, "the file is empty"),
        ("hello\nworld\n", None, "not a control file"),
        (files.OWN_MARKS, None, "has marks but no coordinates"),
        (files.OWN, files.OWN, "has coordinates but no marks"),
        (files.OWN + "G1,1,2,3,,,,\n", None, "row 5: point 'G1' is also in a, row 3 with other coordinates"),
        (files.OWN.replace("386800.10", "east"), None, "row 3: X is 'east', not a number"),
        (files.OWN.replace("control\n", "master\n"), None, "row 3: unknown role 'master'"),
        (files.OWN.replace("0.02", "-0.02"), None, "row 3: sigma of z is -0.02"),
        (files.OWN, files.OWN_MARKS.replace("G1", "H1"), "no marked point (H1) is in a (G1, G2)"),
        (files.OWN, files.OWN_MARKS.replace("DJI_0002", "DJI_0001"), "'G1' in 'DJI_0001' is also marked in b, row 2"),
        (files.GCP_LIST + "1 2 3 4 5\n", None, "row 7: 5 cells"),
        (files.GCP_LIST.replace("30.5 512.5", "31.5 512.5"), None, "row 3: point 'G1' is also in a, row 2"),
        (files.MARKERS[:900], None, "a: damaged"),
        (files.MARKERS.replace('camera_id="0"', 'camera_id="5"'), None, "unknown camera"),
        (files.MARKERS.replace('x="100.25"', 'x="nan"'), None, "x is 'nan', not a number"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(tmp_path, points, marks, words):
    with pytest.raises(InputError) as caught:
        read(tmp_path, points, marks)
    assert words in str(caught.value), caught.value


def test_words_for_systems():
    for words, code, vertical in (
        ("EPSG:25832", 25832, None),
        ("25832+7837", 25832, 7837),
        ("WGS84 UTM 16N", 32616, None),
        ("WGS84 UTM 23S", 32723, None),
        ("+proj=utm +zone=10 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", 32610, None),
        ("+proj=longlat +ellps=WGS84 +datum=WGS84 +no_defs", 4326, None),
        ("local", None, None),
    ):
        found = system_of(words, "a")
        assert (found.code, found.vertical) == (code, vertical), words
    for words in ("UTM 33", "EPSG:99", "x" * 30_000):
        with pytest.raises(InputError):
            system_of(words, "a")


def test_points_of_geo_json_in_a_system_of_its_own(tmp_path):
    points, marks = read(tmp_path, files.GEO_JSON)
    assert points.ids == ("G1", "G2") and points.check.tolist() == [False, True] and not marks.image
    np.testing.assert_array_equal(points.coordinates, [(386800.1, 6175000.2, 30.5), (386900.0, 6175100.0, np.nan)])
    np.testing.assert_array_equal(points.sigma_m[0], (0.01,) * 3)
    assert points.system == "EPSG:32633" and points.places[1] == "a, feature 2"


def test_points_of_geo_json_are_longitude_and_latitude_where_it_says_nothing(tmp_path):
    point = {"type": "Point", "coordinates": [13.2, 55.7]}
    one = {"type": "Feature", "id": "G7", "geometry": point, "properties": {"height": 12.5, "enabled": False}}
    points = read(tmp_path, json.dumps({"type": "FeatureCollection", "features": [one]})).points
    assert points.ids == ("G7",) and points.check.all() and not points.own_axes
    there = places(points, system_of(points.system, "a"), 4326)
    np.testing.assert_allclose(there, [(13.2, 55.7, 12.5)], rtol=1e-12)


def test_a_photograph_of_a_feature_is_no_image_of_a_mark(tmp_path):
    point = {"type": "Point", "coordinates": [13.2, 55.7, 12.5]}
    one = {"type": "Feature", "properties": {"name": "G1", "photo": "DCIM/x.jpg"}, "geometry": point}
    (tmp_path / "a").write_text(json.dumps({"type": "FeatureCollection", "features": [one]}))
    assert read_control(tmp_path / "a", None).points.ids == ("G1",)
    (tmp_path / "a").write_text(json.dumps({"type": "FeatureCollection", "features": []}))
    with pytest.raises(InputError, match="no features"):
        read_control(tmp_path / "a", None)


@settings(max_examples=20, deadline=None)
@given(
    xyz=st.lists(st.tuples(*[st.floats(-5e3, 5e3)] * 3), min_size=40, max_size=40),
    kind=st.sampled_from(["local", "epsg"]),
)
def test_points_of_a_geo_package_come_back(tmp_path_factory, xyz, kind):
    folder = tmp_path_factory.mktemp("package")
    p = photographs("opencv", kind)._replace(xyz=np.array(xyz))
    with warnings.catch_warnings():
        # Some of these points lie behind a photograph, whose footprint is then nowhere.
        warnings.simplefilter("ignore")
        export(p, folder, "geopackage")
    points = read_control(folder / "photographs.gpkg").points
    assert points.ids == p.points and points.system == ("EPSG:32633" if kind == "epsg" else "local")
    np.testing.assert_allclose(points.coordinates, p.in_map().xyz, rtol=0, atol=1e-9)


def _geo(old, new):
    return files.GEO_JSON.replace(old, new)


GEO_REFUSED = {
    "no point": (_geo('"Point"', '"LineString"'), "a, feature 1: the geometry is not a point"),
    "no number": (_geo("386800.1", '"x"'), "a, feature 1: the geometry is not a point"),
    "no name": (_geo('"name": "G', '"what": "G'), r"a: no attribute with point names \(found fid, what"),
    "role": (_geo('"check"', '"both"'), "a, feature 2: unknown role 'both'"),
    "twice": (_geo('"G2"', '"G1"'), "a, feature 2: point 'G1' is also in a, feature 1"),
    "system": (_geo("EPSG::32633", "ESRI::102100"), "system 'urn:ogc:def:crs:ESRI::102100' is not an EPSG code"),
    "cut": (files.GEO_JSON[:-20], "JSON"),
    "no feature": ('{"type": "FeatureCollection", "features": []}', "no features"),
}  # fmt: skip


@pytest.mark.parametrize("name", GEO_REFUSED)
def test_geo_json_that_is_no_control_is_told_in_a_sentence(tmp_path, name):
    text, message = GEO_REFUSED[name]
    with pytest.raises(InputError, match=message):
        read(tmp_path, text)


def _package(folder, *statements):
    export(photographs("opencv", "epsg"), folder, "geopackage")
    path = folder / "photographs.gpkg"
    with contextlib.closing(sqlite3.connect(path)) as file, file:
        for statement in statements:
            file.execute(statement)
    return path


PACKAGE_REFUSED = {
    "layers": (("ALTER TABLE object_points RENAME COLUMN point TO what",), "0 point layers with an attribute"),
    "geometry": (("UPDATE object_points SET geom = x'4750' WHERE fid = 3",), "feature 3: the geometry is not a point"),
    "system": (("UPDATE gpkg_contents SET srs_id = 0",), "coordinate system has no EPSG code"),
    "tables": (("DROP TABLE gpkg_geometry_columns",), "is not a readable GeoPackage"),
    "column": (("UPDATE gpkg_geometry_columns SET column_name = 'shape'",), "has no column 'shape'"),
    "names": (("UPDATE object_points SET point = 'p7'",), "feature 2: point 'p7' is also in photographs.gpkg, fe"),
}


@pytest.mark.parametrize("name", PACKAGE_REFUSED)
def test_a_geo_package_that_is_no_control_is_told_in_a_sentence(tmp_path, name):
    statements, message = PACKAGE_REFUSED[name]
    with pytest.raises(InputError, match=message):
        read_control(_package(tmp_path, *statements))


def test_a_geo_package_whose_columns_have_no_names_in_text_is_told_in_a_sentence(tmp_path):
    path = _package(tmp_path, "ALTER TABLE object_points RENAME COLUMN point TO point_nr")
    path.write_bytes(path.read_bytes().replace(b"point_nr", b"point_\xff\xfe"))
    with pytest.raises(InputError, match="is not a readable GeoPackage"):
        read_control(path)


def test_a_geo_package_that_another_program_has_open_is_read_when_it_is_closed(tmp_path):
    path = _package(tmp_path, "UPDATE object_points SET point = 'q' || point")
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute("PRAGMA journal_mode = wal")
    assert read_control(path).points.ids[0] == "qp0"
    (tmp_path / "photographs.gpkg-wal").write_bytes(b"x")
    with pytest.raises(InputError, match="open in another program"):
        read_control(path)


def test_control_of_bingo(tmp_path):
    path = tmp_path / "geoin.dat"
    path.write_text(files.GEOIN)
    points = read_control(path).points
    assert points.ids == ("11", "12", "A-3") and points.check.tolist() == [False, True, False]
    np.testing.assert_array_equal(points.coordinates[:2], [[500.5, 600.5, 70.25], [510.5, 610.5, 71.25]])
    assert np.isnan(points.coordinates[2, 2])
    for change, words in ((("620.5 nan", ""), "row 5: 3 cells instead of CONT"), (("12 5", "11 5"), "'11' is also in")):
        path.write_text(files.GEOIN.replace(*change))
        with pytest.raises(InputError, match=words):
            read_control(path)


def test_tables_with_words_of_bingo_in_them_are_tables(tmp_path):
    path = tmp_path / "points.txt"
    path.write_text("point x y z sigma\nCONT 500.5 600.5 70.25 0.01\nA 501.5 601.5 71.25 0.01\n")
    points = read_control(path).points
    assert points.ids == ("CONT", "A") and points.coordinates[0].tolist() == [500.5, 600.5, 70.25]


@pytest.mark.parametrize(
    "text", ["# points in E N of name 25832\nA 1.5 2.5 3.5\n", "# measured by E N name\npoint x y z\nA 1.5 2.5 3.5\n"]
)
def test_a_comment_that_is_a_sentence_is_no_header(tmp_path, text):
    path = tmp_path / "points.txt"
    path.write_text(text)
    assert read_control(path).points.coordinates[0].tolist() == [1.5, 2.5, 3.5]


def test_rows_that_end_before_their_name_are_told(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("x,y,z,point\n1,2,3\n")
    with pytest.raises(InputError, match="row 2: 3 cells are too few for the header"):
        read_control(path)
