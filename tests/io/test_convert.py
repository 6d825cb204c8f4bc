"""Projects of other programs as blocks, with real data: published counts and orientations."""

import re
import shutil

import jax
import numpy as np
import pytest

from jaxphoto.camera import AffineBrown, get_parameter, parameter_names
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.extras.formats import FORMATS, convert, read_source, read_tables, recognise
from jaxphoto.io import read_block, write_block
from jaxphoto.unknowns import FREE
from tests.io.oriented_files import misfits_px
from tests.sound_files import DBAT


def reported(text, name):
    """The values of a quantity of DBAT's report, one per image."""
    return [float(value) for value in re.findall(name + r":\s+Value:\s+(\S+)", text)]


def free(block):
    (priors,) = block.priors.interior.values()
    return {name for name in parameter_names(priors) if get_parameter(priors, name) == FREE}


def test_sxb(data_dir):
    block = read_source(data_dir / "sxb" / "sxb.xml")
    report = (data_dir / "sxb" / "result" / "report.txt").read_text()

    assert block.images == ("8811", "8936", "8937", "8938", "9111")
    assert len(block.points) == 381
    assert 2 * len(block.image_points.point) == 2392
    assert len(block.control.who) == 42
    assert {block.points[i] for i in block.check.who} == {"351", "410"}
    assert len(block.fixed.who) == 0
    camera = block.start.unknowns.interior["camera"]
    assert float(camera.c) == 123.9392
    np.testing.assert_allclose([camera.xp, camera.yp], [0.0, 0.18], atol=1e-12)
    assert free(block) == set()
    np.testing.assert_allclose(np.unique(np.round(block.image_points.sigma, 12)), [0.003, 0.006])
    # Observations minus unknowns: the redundancy of the report.
    assert int(re.findall(r"Redundancy\s+(\d+)", report)[0]) == 2392 + 42 - 5 * 6 - 381 * 3

    # x = 0.006 col - 26.577, y = -(0.006 row - 38.811), both from the principal point.
    first = block.points.index("317")
    line = np.flatnonzero((block.image_points.point == first) & (block.image_points.image == 0))[0]
    xy = np.asarray(block.image_points.xy)[line] - np.array([camera.xp, camera.yp])
    np.testing.assert_allclose(xy, [0.006 * 5007.6667 - 26.577, -(0.006 * 7275.6667 - 38.811)], atol=1e-12)

    angles = np.deg2rad(np.stack([reported(report, name) for name in ("Omega", "Phi", "Kappa")], axis=1))
    position = np.stack([reported(report, name) for name in ("Xc", "Yc", "Zc")], axis=1)
    points = block.start.unknowns.points
    shown = block.start.point_known[block.image_points.point]
    v = (
        block.sensors["camera"].pixel_mm
        * misfits_px(block, points, ExteriorOrientation.from_angles(position, angles))[shown]
    )
    # Control as surveyed, not as adjusted (it moves by up to 7 cm, nearly a pixel).
    assert np.sqrt(np.mean(v**2)) < 1.2 * 0.006


def test_prior_eo_has_the_measurements_of_sxb(data_dir):
    block = read_source(data_dir / "sxb" / "prior_eo")
    same = read_source(data_dir / "sxb")

    assert len(block.control.who) == 48
    assert len(block.stations.who) == 12
    np.testing.assert_array_equal(block.stations.sigma, [0.05] * 12)
    assert {block.images[i] for i in block.stations.who} == {"8811", "8936", "8937", "8938"}
    np.testing.assert_allclose(block.image_points.sigma, 0.006)
    assert not block.start.image_known.any()
    assert 2392 + 48 + 12 - 5 * 6 - 381 * 3 == 1279
    measured = [
        {
            (b.images[i], b.points[p]): xy
            for i, p, xy in zip(b.image_points.image, b.image_points.point, np.asarray(b.image_points.xy), strict=True)
        }
        for b in (block, same)
    ]
    assert measured[0].keys() == measured[1].keys()
    for key, xy in measured[0].items():
        np.testing.assert_allclose(xy, measured[1][key], atol=1e-12)


def test_camcal(data_dir):
    block = read_source(data_dir / "camcal")

    assert len(block.images) == 21
    assert block.images[0] == "P8250021"
    assert len(block.points) == 100
    assert 2 * len(block.image_points.point) == 4148
    assert {block.points[i] for i in block.fixed.who} == {"1001", "1002", "1003", "1004"}
    assert len(block.control.who) == len(block.check.who) == 0
    assert free(block) == {"c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2", "b1"}
    camera = block.start.unknowns.interior["camera"]
    assert isinstance(camera.distortion, AffineBrown)
    assert (float(camera.c), float(camera.xp), float(camera.yp)) == (7.5, 0.0, 0.0)
    np.testing.assert_allclose(block.sensors["camera"].pixel_mm, 5.43764 / 1704)
    np.testing.assert_allclose(block.image_points.sigma, 0.1 * 5.43764 / 1704)
    assert 4148 - (9 + 126 + 96 * 3) == 3725


@pytest.mark.parametrize("source", ["sxb", "sxb/prior_eo", "camcal/camcaldemo.xml"])
def test_convert_writes_what_it_read(data_dir, tmp_path, source):
    block = convert(data_dir / source, tmp_path / "block")
    again = read_block(tmp_path / "block")
    assert jax.tree.structure(again) == jax.tree.structure(block)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(block), strict=True):
        if isinstance(b, np.ndarray | jax.Array):
            np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-15)


def test_a_block_folder_is_a_format_too(write_folder, tmp_path):
    folder = write_folder()
    write_block(read_block(folder), tmp_path / "copy")
    assert read_source(tmp_path / "copy").points == read_source(folder, "block").points


def test_unknown_formats_list_the_known_ones(tmp_path):
    (tmp_path / "photo.jpg").write_text("")
    for source, name in ((tmp_path / "photo.jpg", None), (tmp_path, "rhinophoto")):
        with pytest.raises(InputError) as caught:
            read_source(source, name)
        assert all(known in str(caught.value) for known in FORMATS)
    with pytest.raises(InputError, match="correct the name"):
        read_source(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("</document>", "", ("project.xml", "line")),
        ("<model>3</model>", "<model>6</model>", ("project.xml", "model '6'", "use one of")),
        ("auto,5.43764", "auto,auto", ("project.xml", "<sensor>", "give width,height")),
        ("<skew>false</skew>", "<focus>false</focus>", ("project.xml", "focus", "use one of")),
        ("<skew>false</skew>", "<skew>no</skew>", ("project.xml", "<skew>", "use one of true, false")),
        ("im,id,x,y,sxy", "im,id,x,y,s", ("project.xml", "markpts.txt", "add sxy")),
        ("im,id,x,y,sxy", "im,label,x,y,sxy", ("project.xml", "image_pts", "no id")),
        ("camcal-fixed.txt", "camcal-free.txt", ("camcal-free.txt", "add it")),
        ("<ctrl_pts>", "<extra/><ctrl_pts>", ("project.xml", "<extra>", "remove it")),
        ("<ctrl_pts>", "<prior_eo/><ctrl_pts>", ("project.xml", "<prior_eo> has no file")),
        ('base_dir="$HERE"', 'base_dir="$DBAT"', ("project.xml", "$DBAT", "$HERE")),
        ("<project_unit>m<", "<project_unit>ft<", ("project.xml", "'ft'", "use one of m")),
    ],
)
def test_a_bad_script_is_refused(data_dir, tmp_path, old, new, words):
    folder = tmp_path / "camcal"
    for name in ("images", "measurements", "reference"):
        shutil.copytree(data_dir / "camcal" / name, folder / name)
    text = (data_dir / "camcal" / "camcaldemo.xml").read_text()
    assert old in text
    (folder / "project.xml").write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_source(folder)
    for word in words:
        assert word in str(caught.value), str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("   0      333 2158.2500", "   9      333 2158.2500", r"pmexport\.txt, row \d+: image 9 is not among"),
        ("0.000500 20 8858 12996", "0.000500 20 8858", "has an unknown format"),
    ],
)
def test_a_bad_export_is_refused(data_dir, tmp_path, old, new, message):
    folder = tmp_path / "prior_eo"
    shutil.copytree(data_dir / "sxb" / "prior_eo", folder)
    path = next(folder.glob("*pmexport*"))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(JaxphotoError, match=message):
        read_source(folder)


def test_the_only_recogniser_of_a_text_export_of_photomodeler_is_its_own(data_dir):
    """Orientations of PATB begin alike."""
    assert recognise(data_dir / "sxb/prior_eo/wsmart-with-orient-pmexport.txt") == ["photomodeler"]


def test_names_in_the_old_code_page_of_windows_are_read(tmp_path):
    script = DBAT | {"images.txt": "1,a/Müller.jpg\n2,a/two.jpg\n"}
    for name, content in script.items():
        (tmp_path / name).write_text(content, encoding="cp1252" if name == "images.txt" else "utf-8")
    assert read_tables(tmp_path, "dbat").tables["images"].text("image").tolist() == ["Müller", "two"]
