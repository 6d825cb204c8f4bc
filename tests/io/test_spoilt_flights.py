"""Whatever one photograph or file of a flight has, it costs exactly one sentence, and all others go on as before.

A receiver that jumps by less than kilometres shows against the network only: `test_georeference_photographs.py`.
"""

import shutil
from datetime import datetime, timedelta

import numpy as np
import pytest
from PIL import Image

from jaxphoto.georeferencing.exposure_times import LEAP_SECONDS
from jaxphoto.io.exposures import located
from jaxphoto.io.photographs import valid_photographs
from tests.io.test_exposures import ALL, FLIGHT

GPS, ZONE_S = 0x8825, 7200
TAKE_OFF_M = 40.0


def picture(path, k, place=None, above_m=None, model="Model", seed=0):
    """A photograph of `FLIGHT` with its position (`place` instead: latitude, longitude; () for none) and heights."""
    at = datetime(1980, 1, 6) + timedelta(seconds=int(FLIGHT.time[k] - LEAP_SECONDS + ZONE_S))
    exif = Image.Exif()
    exif[271], exif[272] = "Maker", model
    exif.get_ifd(0x8769).update({0x9003: f"{at:%Y:%m:%d %H:%M:%S}", 0x9011: "+02:00"})
    place = FLIGHT.camera[k][:2] if place is None else place
    if place:
        latitude, longitude = ((v, 0, 0) for v in place)
        exif.get_ifd(GPS).update({1: "N", 2: latitude, 3: "E", 4: longitude, 5: b"\0", 6: 57.0 + k})
    heights = {"Absolute": TAKE_OFF_M + 17 + k if above_m is None else above_m, "Relative": 17 + k}
    xmp = "<rdf:Description " + " ".join(f'drone-dji:{n}Altitude="+{h}"' for n, h in heights.items()) + "/>"
    grey = np.random.default_rng(100 * seed + k).integers(0, 255, (300, 400), dtype=np.uint8)
    Image.fromarray(grey).save(path / f"DJI_{k + 1:04}.jpg", exif=exif, xmp=xmp.encode())


def marks(path, shift_s=0.0):
    # Names that carry no number of the marks: times alone join them.
    (path / "a.MRK").write_text("".join(FLIGHT.mark(k, k + 31, shift_s) for k in ALL))


def cut(path):
    whole = (path / "DJI_0003.jpg").read_bytes()
    (path / "cut.jpg").write_bytes(whole[: len(whole) // 2])


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clean")
    for k in ALL:
        picture(folder, k)
    return folder


def said_of(folder):
    """All sentences, each without its folder, and the photographs that are left with their positions."""
    kept, left = valid_photographs([folder])
    taken, sentences = located(kept, [folder])
    said = [s.replace(f"{folder}/", "") for s in (*left.values(), *sentences)]
    return said, {p.name: p.gps for p in taken}


FAR = (56.7, 13.2)
SPOILT = {
    "truncated": (cut, "cut.jpg: the picture is cut off or damaged", ()),
    "no picture": (lambda f: (f / "x.jpg").write_text("none"), "x.jpg: this is no picture", ()),
    "doubled": (lambda f: shutil.copy(f / "DJI_0002.jpg", f / "DJI_0002 (1).jpg"), "it is a copy of DJI_0002", ()),
    "screenshot": (lambda f: Image.new("RGB", (640, 480)).save(f / "s.png"), "s.png: its size is 640 x 480 px", ()),
    "other camera": (lambda f: picture(f, 4, model="Other"), "its camera is Maker Other", ("DJI_0005",)),
    "without a position": (
        lambda f: picture(f, 4, ()),
        "1 of 10 photographs has no position (DJI_0005)",
        ("DJI_0005",),
    ),
    "at (0, 0)": (lambda f: picture(f, 4, (0.0, 0.0)), "DJI_0005 are (0, 0)", ("DJI_0005",)),
    "swapped": (lambda f: picture(f, 4, FLIGHT.camera[4][1::-1]), "DJI_0005 have changed places", ()),
    "far away": (lambda f: picture(f, 4, FAR), "DJI_0005 are more than 50 km from the others", ("DJI_0005",)),
    "above take-off": (lambda f: picture(f, 4, above_m=21), "DJI_0005 are above take-off", ()),
    "file of no marks": (lambda f: (f / "b.MRK").write_text("no\n"), "b.MRK, row 1", ()),
}


@pytest.mark.parametrize("kind", SPOILT)
def test_each_spoilt_input_costs_one_sentence_and_the_rest_goes_on(clean, tmp_path, kind):
    spoil, words, lost = SPOILT[kind]
    before, sound = said_of(clean)
    folder = shutil.copytree(clean, tmp_path / "flight")
    spoil(folder)
    said, found = said_of(folder)
    assert [words in s for s in said if s not in before] == [True], said
    assert {n: g for n, g in found.items() if g} == {n: g for n, g in sound.items() if n not in lost}


@pytest.mark.parametrize(("zone_s", "words"), [(-8 * 3600.0, "+8 h (time zone)"), (7200.0, "-2 h (time zone)")])
def test_a_wrong_time_zone_of_marks_is_one_sentence(clean, tmp_path, zone_s, words):
    right, wrong = (shutil.copytree(clean, tmp_path / name) for name in ("right", "wrong"))
    # Names with numbers that are not those of the marks.
    for folder in (right, wrong):
        for path in folder.glob("*.jpg"):
            path.rename(folder / path.name.replace("DJI_", "IMG"))
    marks(right)
    marks(wrong, zone_s)
    (before, sound), (said, found) = said_of(right), said_of(wrong)
    assert [words in s and s.endswith("which is corrected") for s in said if s not in before] == [True], said
    assert found == sound and all(g.heights == "ellipsoid" for g in found.values())


def test_a_wrong_row_of_marks_is_one_sentence(clean, tmp_path):
    right, wrong = (shutil.copytree(clean, tmp_path / name) for name in ("right", "wrong"))
    for folder in (right, wrong):
        marks(folder)
    (wrong / "a.MRK").write_text((right / "a.MRK").read_text().replace("34\t", "34\tx"))
    (before, sound), (said, found) = said_of(right), said_of(wrong)
    mine = [s for s in said if s.startswith("a.MRK")]
    assert len(mine) == 1 and mine[0] not in before and "1 of 10 rows is left out (4); row 4: " in mine[0], mine
    assert [n for n, g in found.items() if g != sound[n]] == ["DJI_0004"] and found["DJI_0004"] is not None
