"""Files of control in every form: told apart by content, read to the number, refused in a sentence."""

import numpy as np
import pytest

from jaxphoto.errors import InputError
from jaxphoto.extras.formats import read_control
from jaxphoto.procedures.control.surveyed import places, system_of
from tests.io import control_files as files


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


LISTED = "16.6 59.3 62.6 2799.29 2159.83 a.JPG\n16.61 59.3 62.6 1676.11 2488.37 b.JPG\n"


@pytest.mark.parametrize(
    ("system", "code"),
    [
        ("WGS84\t", 4326), ("wgs 84", 4326), ("EPSG:4326", 4326), ("WGS84 UTM 33N", 32633),
        ("WGS 84 / UTM zone 33N", 32633),
        ("+proj=utm +zone=33 +datum=WGS84 +units=m +no_defs", 32633), ("local", None),
    ],
)  # fmt: skip
def test_a_gcp_list_in_every_form_of_its_system(tmp_path, system, code):
    points, marks = read(tmp_path, f"{system}\n{LISTED}")
    assert system_of(points.system, "a").code == code and marks.image == ("a.JPG", "b.JPG")
    np.testing.assert_array_equal(points.coordinates[0], (16.6, 59.3, 62.6))


def test_a_gcp_list_without_a_known_system_names_the_line(tmp_path):
    assert read(tmp_path, LISTED).points.system == ""
    for system in ("mine", "x y z im_x im_y image"):
        with pytest.raises(InputError, match=f"a, row 2: '{system}' is not a coordinate system; write EPSG"):
            read(tmp_path, f"# of May\n{system}\n{LISTED}")


def test_a_table_with_its_system_in_the_first_line(tmp_path):
    points = read(tmp_path, "EPSG:32633\nG1,386800.5,6175010.2,30.5\nG2,386800.5,6175020.2,30.5\n").points
    assert points.system == "EPSG:32633" and points.coordinates[1].tolist() == [386800.5, 6175020.2, 30.5]


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
    with pytest.raises(InputError, match="a, row 1: 'who knows what this may be'"):
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
        ("hello\nworld\n", None, "a, row 1: 'hello' is neither a header nor"),
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
        (files.MARKERS.replace('camera_id="0"', 'camera_id="5"'), None, "unknown marker or camera"),
        (files.MARKERS.replace('x="100.25"', 'x="nan"'), None, "x is 'nan', not a valid number"),
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
