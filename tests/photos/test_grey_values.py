"""Grey values from files of every kind that a camera or a program writes: the same picture each time."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from jaxphoto import InputError
from jaxphoto.extras.photos.features import read_grey

ROW, COLUMN = np.mgrid[:60, :80]
GREY = (3 * COLUMN).astype(np.uint8)
RGB = np.dstack([GREY] * 3)
ALPHA = (4 * ROW).astype(np.uint8)


@pytest.mark.parametrize(
    ("name", "picture"),
    [
        ("grey.png", Image.fromarray(GREY)),
        ("rgb.tif", Image.fromarray(RGB)),
        ("rgba.png", Image.fromarray(np.dstack([RGB, ALPHA]))),
        ("grey_alpha.png", Image.fromarray(np.dstack([GREY, ALPHA]))),
        ("palette.png", Image.fromarray(RGB).quantize(256)),
        ("palette.tif", Image.fromarray(RGB).quantize(256)),
        ("cmyk.jpg", Image.fromarray(RGB).convert("CMYK")),
        ("cmyk.tif", Image.fromarray(RGB).convert("CMYK")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_colours_palettes_and_transparency_become_grey(name, picture, tmp_path):
    picture.save(tmp_path / name, **({"quality": 98} if name.endswith("jpg") else {}))
    read = read_grey(tmp_path / name)
    assert read.dtype == np.uint8
    np.testing.assert_allclose(read.astype(int), GREY.astype(int), atol=2)


@pytest.mark.parametrize("ending", ["tif", "png"])
@pytest.mark.parametrize("layers", [1, 3])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_more_than_eight_bits_keep_their_contrast(bits, layers, ending, tmp_path):
    """The brightest of 240 levels is between half and all of the scale, whatever bits the camera has."""
    values = (3 * COLUMN.astype(np.uint16)) << (bits - 8)
    cv2.imwrite(str(tmp_path / f"a.{ending}"), np.dstack([values] * layers))
    np.testing.assert_array_equal(read_grey(tmp_path / f"a.{ending}"), GREY)


def test_the_flag_about_turning_turns_nothing(tmp_path):
    flag = Image.Exif()
    flag[0x0112] = 6
    Image.fromarray(RGB).save(tmp_path / "turned.jpg", exif=flag, quality=98)
    assert read_grey(tmp_path / "turned.jpg").shape == GREY.shape


def test_dark_pictures_of_twelve_bits_show_their_corners(tmp_path):
    """A chessboard between 0 and 300 of 4,095 would be two grey levels of 256."""
    board = 300 * ((ROW // 20 + COLUMN // 20) % 2).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "dark.tif"), board)
    assert np.ptp(read_grey(tmp_path / "dark.tif")) > 100


@pytest.mark.parametrize("kind", ["missing", "empty", "words", "cut", "float"])
def test_what_is_no_picture_is_one_sentence(kind, tmp_path, capfd):
    path = tmp_path / f"{kind}.png"
    Image.fromarray(RGB).save(tmp_path / "good.png")
    good = (tmp_path / "good.png").read_bytes()
    if kind == "float":
        path = tmp_path / "float.tif"
        cv2.imwrite(str(path), GREY.astype(np.float32))
    elif kind != "missing":
        path.write_bytes({"empty": b"", "words": b"not a picture", "cut": good[: len(good) // 2]}[kind])
    with pytest.raises(InputError) as error:
        read_grey(path)
    assert path.name in str(error.value)
    assert "\n" not in str(error.value)


def png(picture=GREY):
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    return buffer.getvalue()


def test_a_small_file_that_says_it_is_large(tmp_path):
    """900 million pixels, which a file of no content would fill memory with."""
    path = tmp_path / "a.png"
    head = b"IHDR" + struct.pack(">II", 30_000, 30_000) + png()[24:29]
    path.write_bytes(png()[:12] + head + struct.pack(">I", zlib.crc32(head)) + png()[33:])
    with pytest.raises(InputError, match=r"a\.png: OpenCV cannot read this image"):
        read_grey(path)


def test_lengths_within_a_file_that_are_longer_than_it(tmp_path):
    """OpenCV would take gigabytes for them."""
    path = tmp_path / "a.png"
    path.write_bytes(png()[:33] + b"\x7f" + png()[34:])
    with pytest.raises(InputError, match=r"a\.png: OpenCV cannot read this image"):
        read_grey(path)
