"""Photographs: what EXIF says of the camera, where the start comes from, and what is refused."""

from fractions import Fraction

import numpy as np
import pytest
from PIL import ExifTags, Image, TiffImagePlugin

from jaxphoto.errors import InputError
from jaxphoto.io.photographs import photographs, sensor_and_interior

BASE, IFD = ExifTags.Base, ExifTags.IFD


def ratio(value):
    exact = Fraction(value).limit_denominator(10**6)
    return TiffImagePlugin.IFDRational(exact.numerator, exact.denominator)


def write(path, size=(640, 480), top=(), taken=(), gps=()):
    exif = Image.Exif()
    exif.update(dict(top))
    exif.get_ifd(IFD.Exif).update({k: ratio(v) if isinstance(v, float) else v for k, v in dict(taken).items()})
    exif.get_ifd(IFD.GPSInfo).update(dict(gps))
    Image.new("L", size, 128).save(path, exif=exif)
    return path


def test_what_exif_says(tmp_path):
    path = write(
        tmp_path / "a.jpg",
        top={BASE.Make: "Canon\0", BASE.Model: "EOS 5D ", BASE.Orientation: 6},
        taken={BASE.FocalLength: 24.0, BASE.FocalLengthIn35mmFilm: 24},
        gps={1: "S", 2: (ratio(33.0), ratio(30.0), ratio(36.0)), 3: "E", 4: (ratio(13.5), ratio(0.0), ratio(0.0)),
             5: b"\x01", 6: ratio(2.5)},
    )  # fmt: skip
    (found,) = photographs([path])
    assert found[:4] == ("a", path, 640, 480)
    assert (found.make, found.model, found.orientation) == ("Canon", "EOS 5D", 6)
    assert (found.focal_length_mm, found.focal_length_35mm_mm) == (24.0, 24.0)
    assert found.gps[:3] == pytest.approx((-33.51, 13.5, -2.5)) and found.gps.sigma_m is None


def test_without_exif_nothing_is_known(tmp_path):
    Image.new("RGB", (64, 48)).save(tmp_path / "a.png")
    (found,) = photographs([str(tmp_path / "a.png")])
    assert found[2:] == (64, 48, None, None, None, None, None, 1, None, None, None, None, None, None, 1.0)


def test_damaged_exif_says_nothing(tmp_path):
    path = write(
        tmp_path / "a.jpg",
        top={BASE.Orientation: 77},
        taken={BASE.FocalLength: TiffImagePlugin.IFDRational(3, 0), BASE.FocalLengthIn35mmFilm: 0},
        gps={1: "N", 2: (ratio(13.0), ratio(0.0), ratio(0.0)), 3: "E", 4: (ratio(203.0), ratio(0.0), ratio(0.0))},
    )
    (found,) = photographs([path])
    assert found[4:] == (None, None, None, None, None, 1, None, None, None, None, None, None, 1.0)


def test_exif_that_is_cut_off_is_no_traceback(tmp_path):
    """What is left of it counts, or nothing; the size is known in any case."""
    usual = {"top": {BASE.Make: "Canon"}, "taken": {BASE.FocalLength: 24.0, BASE.FocalLengthIn35mmFilm: 35}}
    gps = {1: "S", 2: (ratio(33.0), ratio(30.0), ratio(36.0)), 3: "E", 4: (ratio(3.0), ratio(0.0), ratio(0.0))}
    with Image.open(write(tmp_path / "a.jpg", **usual, gps=gps)) as picture:
        whole = picture.info["exif"]
    known = set()
    for n in range(len(whole)):
        for kind in ("jpg", "png"):
            Image.new("L", (64, 48)).save(tmp_path / f"cut.{kind}", exif=whole[:n])
            (found,) = photographs([tmp_path / f"cut.{kind}"])
            assert found[2:4] == (64, 48)
            known.add(found.focal_length_mm)
    assert known == {None, 24.0}


def test_c_of_film_is_by_the_diagonal_whatever_the_format(tmp_path):
    """CIPA's definition: 35 mm on film is 2 atan(43.27 / 70) across the diagonal, of a picture of 4:3 or 16:9 too."""
    for width, height in ((640, 480), (960, 540), (600, 600)):
        path = write(tmp_path / f"{width}.jpg", (width, height), taken=PHONE)
        camera = sensor_and_interior(photographs([path]))
        across = 2 * np.arctan(np.hypot(width, height) * camera.sensor.pixel_mm / 2 / camera.interior.c)
        assert across == pytest.approx(2 * np.arctan(np.hypot(36, 24) / 70), rel=1e-9)


# That of 36 mm x 24 mm, over the 800 pixels of the diagonal of 640 x 480.
DIAGONAL = 43.26661531 / 800
PHONE = {BASE.FocalLength: 4.3, BASE.FocalLengthIn35mmFilm: 35}
FULL_FRAME = {BASE.FocalLength: 50.0, BASE.FocalPlaneXResolution: 4000 / 36 * 10, BASE.FocalPlaneYResolution: 1111.1}


@pytest.mark.parametrize(
    ("taken", "given", "c_mm", "pixel_mm", "origin"),
    [
        # Per centimetre, of a file as it was taken and of one made smaller, whose EXIF keeps the first size.
        (FULL_FRAME | {BASE.FocalPlaneResolutionUnit: 3}, {}, 50.0, 640 / 4000 * 36 / 640, "focal plane resolution"),
        (
            FULL_FRAME
            | {BASE.FocalPlaneResolutionUnit: 3, BASE.ExifImageWidth: 4000, BASE.ExifImageHeight: 3000},
            {}, 50.0, 36 / 640, "focal plane resolution",
        ),
        # Cut from 3:2 since: the resolution is of another width.
        (
            FULL_FRAME
            | {BASE.FocalPlaneResolutionUnit: 3, BASE.ExifImageWidth: 4000, BASE.ExifImageHeight: 2667},
            {}, 768 * 0.005, 0.005, "a guess, 1.2 times the longer side",
        ),
        (PHONE, {}, 4.3, DIAGONAL * 4.3 / 35, "focal lengths"),
        (PHONE, {"pixel_mm": 0.01}, 6.4716, 0.01, "c from 35 mm on film"),
        ({BASE.FocalLengthIn35mmFilm: 35}, {}, 6.4716 / 2, 0.005, "c from 35 mm on film.*pixel size nominal"),
        ({BASE.FocalLength: 8.0}, {"pixel_mm": 0.01}, 8.0, 0.01, "c is the focal length.*pixel size as given"),
        ({BASE.FocalLength: 8.0, BASE.FocalLengthIn35mmFilm: 35}, {"c_mm": 7.5}, 7.5, DIAGONAL * 8 / 35, "c as given"),
        ({}, {}, 768 * 0.005, 0.005, "a guess, 1.2 times the longer side.*pixel size nominal"),
        ({BASE.FocalLengthIn35mmFilm: 65535}, {}, 768 * 0.005, 0.005, "a guess, 1.2 times the longer side"),
        ({}, {"pixel_mm": 0.002}, 1.536, 0.002, "a guess.*pixel size as given"),
        ({}, {"pixel_mm": 0.002, "c_mm": 1.5}, 1.5, 0.002, "c as given; pixel size as given"),
    ],
)  # fmt: skip
def test_the_start_and_where_it_comes_from(tmp_path, taken, given, c_mm, pixel_mm, origin):
    camera = sensor_and_interior(photographs([write(tmp_path / "a.jpg", taken=taken)]), **given)
    assert (camera.sensor.width_px, camera.sensor.height_px) == (640, 480)
    assert camera.sensor.pixel_mm == pytest.approx(pixel_mm, rel=1e-5)
    assert camera.interior.c == pytest.approx(c_mm, rel=1e-4)
    assert camera.origin.endswith(".") and camera.origin.count("\n") == 0
    assert np.all([part in camera.origin for part in origin.split(".*")]), camera.origin


def test_files_that_are_no_photographs(tmp_path):
    good = write(tmp_path / "a.jpg")
    with pytest.raises(InputError, match=r"none.jpg: photograph not found"):
        photographs([good, tmp_path / "none.jpg"])
    (tmp_path / "text.jpg").write_text("no picture")
    with pytest.raises(InputError, match=r"text.jpg: not a readable image"):
        photographs([tmp_path / "text.jpg"])
    (tmp_path / "empty.jpg").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty.jpg: not a readable image"):
        photographs([tmp_path / "empty.jpg"])
    with pytest.raises(InputError, match=r"is a folder; give its photographs"):
        photographs([tmp_path])
    (tmp_path / "other").mkdir()
    twin = write(tmp_path / "other" / "a.png")
    with pytest.raises(InputError, match=r"a.jpg and .*a.png both have the image name 'a'"):
        photographs([good, twin])
    with pytest.raises(InputError, match="both have the image name 'a'"):
        photographs([good, good])


def test_a_photograph_of_many_pixels_is_read(tmp_path):
    """Pillow refuses more than 179 million pixels unless told otherwise; aerial cameras have more."""
    path = tmp_path / "aerial.tif"
    Image.new("1", (17310, 11310)).save(path, compression="group4")
    limit = Image.MAX_IMAGE_PIXELS
    (found,) = photographs([path])
    assert (found.width_px, found.height_px) == (17310, 11310)
    assert limit == Image.MAX_IMAGE_PIXELS


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"size": (480, 640)}, r"different sizes \(640 x 480 px: a.jpg, .* and 1 more; 480 x 640 px: x.jpg\)"),
        ({"top": {BASE.Orientation: 3}}, r"different orientation flags \(1: a.jpg, .* and 1 more; 3: x.jpg\)"),
        ({"top": {BASE.Model: "D800"}}, r"different cameras \(Z6: a.jpg, .* and 1 more; D800: x.jpg\)"),
        ({"taken": {BASE.FocalLength: 35.0}}, r"different focal lengths \(24 mm: a.jpg.*; 35 mm: x.jpg\)"),
    ],
)  # fmt: skip
def test_photographs_of_several_cameras(tmp_path, other, message):
    usual = {"top": {BASE.Model: "Z6"}, "taken": {BASE.FocalLength: 24.0}}
    paths = [write(tmp_path / f"{name}.jpg", **usual) for name in "abcd"]
    x = write(tmp_path / "x.jpg", **(usual | other))
    with pytest.raises(InputError, match=message):
        sensor_and_interior(photographs([*paths, x]))


@pytest.mark.parametrize(("size", "refused"), [((640, 480), False), ((480, 480), True)])
def test_what_is_still_to_be_turned_by_a_quarter_lies_as_the_sensor_saw_it(tmp_path, size, refused):
    """As its size says, which a program that turned it would have changed; that of a square tells nothing."""
    paths = [
        write(tmp_path / f"{flag}.jpg", size=size, top={BASE.Orientation: flag}, taken={BASE.FocalLength: 24.0})
        for flag in (1, 6, 8)
    ]
    if refused:
        with pytest.raises(InputError, match="different orientation flags"):
            sensor_and_interior(photographs(paths))
    else:
        assert sensor_and_interior(photographs(paths)).sensor.width_px == 640


def test_what_is_given_wrong(tmp_path):
    plain = photographs([write(tmp_path / "a.jpg")])
    with pytest.raises(InputError, match="no photographs"):
        sensor_and_interior([])
    with pytest.raises(InputError, match=r"no pixel size .*; give pixel_mm as well"):
        sensor_and_interior(plain, c_mm=5.0)
    for wrong in ({"c_mm": -1.0}, {"pixel_mm": 0.0}, {"pixel_mm": float("nan")}):
        with pytest.raises(InputError, match="give a positive number of millimetres"):
            sensor_and_interior(plain, **wrong)


def test_a_zoom_whose_c_is_given(tmp_path):
    """Focal lengths of EXIF may be rounded one way and the other."""
    both = [write(tmp_path / f"{f}.jpg", taken={BASE.FocalLength: f}) for f in (24.0, 25.0)]
    camera = sensor_and_interior(photographs(both), pixel_mm=0.005, c_mm=24.3)
    assert camera.interior.c == 24.3
