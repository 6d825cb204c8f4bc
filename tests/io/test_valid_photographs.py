"""What of a folder of photographs can be used: each spoilt one costs a sentence, never the rest."""

import shutil

import numpy as np
import pytest
from PIL import Image

from jaxphoto.errors import InputError
from jaxphoto.io.photographs import (
    drone_record,
    photographs,
    skipped_messages,
    skipped_subfolders,
    valid_photographs,
    xmp_fields,
)

PACKET = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF>
<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:AbsoluteAltitude="+129.52"
 drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.01174" drone-dji:RtkStdLat="0.01262" drone-dji:RtkStdHgt="0.02684">
<drone-dji:GimbalYawDegree>-87.20</drone-dji:GimbalYawDegree></rdf:Description></rdf:RDF></x:xmpmeta>"""


@pytest.fixture
def folder(tmp_path):
    """Four photographs of one camera, none like another."""
    rng = np.random.default_rng(1)
    for k in range(4):
        exif = Image.Exif()
        exif[271], exif[272] = "Maker", "Model"
        exif.get_ifd(0x8825).update({1: "N", 2: (55.0, 40.0, float(k)), 3: "E", 4: (13.0, 10.0, 0.0), 6: 120.0})
        picture = Image.fromarray(rng.integers(0, 255, (300, 400), dtype=np.uint8))
        picture.save(tmp_path / f"{k}.jpg", exif=exif, xmp=PACKET.encode())
    return tmp_path


def test_sound_ones_are_kept_with_what_their_files_say(folder):
    kept, left = valid_photographs([folder])
    assert [p.name for p in kept] == ["0", "1", "2", "3"] and not left
    assert kept[0].gps is not None and kept[0].gps.sigma_m == (0.01174, 0.01262, 0.02684)


def test_of_several_copies_each_names_the_one_that_is_kept(folder):
    for n in (1, 2):
        shutil.copy(folder / "2.jpg", folder / f"2 copy {n}.jpg")
    kept, left = valid_photographs([folder])
    assert [p.name for p in kept] == ["0", "1", "2", "3"]
    assert len(left) == 2 and all(why.endswith(f"it is a copy of {folder / '2.jpg'}") for why in left.values())


def test_folders_in_a_folder_and_raw_files_are_told(folder, tmp_path):
    card = tmp_path / "DCIM"
    (card / "100MEDIA").mkdir(parents=True)
    with pytest.raises(InputError, match=r"none is a readable photograph$"):
        valid_photographs([card])
    (folder / "0.jpg").rename(card / "100MEDIA" / "0.jpg")
    with pytest.raises(InputError, match=r"100MEDIA: 1 photograph in a subfolder"):
        valid_photographs([card])
    inner = card / "100MEDIA"
    said = {str(inner): f"{inner}: 1 photograph in a subfolder that is not read; add this folder"}
    assert skipped_subfolders([card]) == said
    assert not skipped_subfolders([card, inner])
    (inner / ".jaxphoto.json").write_text("{}")
    assert not skipped_subfolders([card])


def test_spoilt_ones_are_left_out_each_with_a_sentence(folder):
    whole = (folder / "1.jpg").read_bytes()
    (folder / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (folder / "text.png").write_text("no picture")
    shutil.copy(folder / "2.jpg", folder / "copy.jpg")
    Image.new("RGB", (640, 480)).save(folder / "screenshot.png")
    shutil.copy(folder / "3.jpg", folder / "3.jpeg")
    other = Image.open(folder / "0.jpg")
    exif = other.getexif()
    exif[272] = "Another"
    other.save(folder / "other.jpg", exif=exif)
    (folder / "notes.txt").write_text("not looked at")
    kept, left = valid_photographs([folder])
    assert [p.name for p in kept] == ["0", "1", "2", "3"]
    for name, why in {
        "cut.jpg": "cut off or damaged",
        "text.png": "not a readable image",
        "copy.jpg": "a copy of",
        "3.jpeg": "a copy of",
        "screenshot.png": "its size is 640 x 480 px, that of most is 400 x 300 px",
        "other.jpg": "its camera is Maker Another, that of most is Maker Model",
    }.items():
        assert why in left.pop(str(folder / name))
    assert not left


def test_links_and_hidden_files(folder):
    """A link to a photograph elsewhere is one; one to nothing costs a sentence; what macOS hides beside each none."""
    away = folder / "away"
    away.mkdir()
    (folder / "0.jpg").rename(away / "0.jpg")
    (folder / "0.jpg").symlink_to(away / "0.jpg")
    (folder / "lost.JPG").symlink_to(away / "absent.jpg")
    (folder / "._1.jpg").write_bytes(b"macOS")
    kept, left = valid_photographs([folder])
    assert [p.name for p in kept] == ["0", "1", "2", "3"]
    assert list(left.values()) == [f"{folder / 'lost.JPG'}: the target of this link is missing; correct the name"]
    # Copies of one name in two folders are told by these.
    _, left = valid_photographs([folder, away])
    assert f"{away / '0.jpg'}: it is a copy of {folder / '0.jpg'}" in left.values()


def test_files_left_out_for_one_reason_have_one_sentence(folder):
    for k in range(3):
        Image.new("RGB", (64, 48 + 8 * (k // 2)), (k, 0, 0)).save(folder / f"T{k}.png")
    assert len(skipped_messages(valid_photographs([folder])[1])) == 3
    for k in range(3, 5):
        Image.new("RGB", (64, 48), (k, 0, 0)).save(folder / f"T{k}.png")
    one, other = skipped_messages(valid_photographs([folder])[1])
    assert one.startswith("4 files (T0.png, T1.png, T3.png and 1 more), each: its size is 64 x 48 px, that of most")
    assert other.startswith(f"{folder / 'T2.png'}: its size is 64 x 56 px")


def test_a_second_body_of_the_same_model_and_a_digital_zoom_are_left_out(folder):
    """As lenses of specimens differ, c of one block would be neither's; a zoom that enlarges a part doubles it."""
    for k, (serial, zoom) in enumerate(((" A1", 0.0), ("A1", 1.0), ("A1", 2.0), ("B7", 1.0))):
        picture = Image.open(folder / f"{k}.jpg")
        exif = picture.getexif()
        exif.get_ifd(0x8769).update({0xA431: serial, 0xA404: zoom})
        picture.save(folder / f"{k}.jpg", exif=exif)
    kept, left = valid_photographs([folder])
    assert [p.name for p in kept] == ["0", "1"]
    assert "its digital zoom is 2, that of most is 1" in left[str(folder / "2.jpg")]
    assert "its serial number is B7, that of most is A1" in left[str(folder / "3.jpg")]
    packet = PACKET.replace('RtkFlag="50"', 'CameraSerialNumber="C9"')
    picture.save(folder / "4.jpg", exif=Image.Exif(), xmp=packet.encode())
    assert "its serial number is C9" in valid_photographs([folder])[1][str(folder / "4.jpg")]


def test_what_is_not_there_and_what_leaves_nothing_is_refused(folder, tmp_path):
    with pytest.raises(InputError, match="photograph or folder not found"):
        valid_photographs([folder / "absent"])
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="none is a readable photograph"):
        valid_photographs([empty])


def test_packets_of_others_and_damaged_ones_say_nothing(folder):
    assert xmp_fields(PACKET)["drone-dji:GimbalYawDegree"] == "-87.20"
    assert xmp_fields(PACKET[:-60])["drone-dji:RtkFlag"] == "50"
    for packet in (None, b"", b"<x:xmpmeta/>", PACKET.replace("0.01174", "nan"), PACKET.replace("0.01262", "0")):
        assert drone_record(xmp_fields(packet)).sigma_m is None
    assert photographs([folder / "0.jpg"])[0].gps.sigma_m == (0.01174, 0.01262, 0.02684)
