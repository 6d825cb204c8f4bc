"""Damaged clouds: what would take room, end the process or pass for a point is refused before it does."""

import os
import struct

import laspy
import numpy as np
import pytest

from jaxphoto import InputError
from jaxphoto.io import clouds
from jaxphoto.io.clouds import laz_chunks
from tests.io.test_clouds import complaint, same, sample, write_las

# Where numbers stand in a header: the offset of the points, their number, scale and least X.
POINTS, COUNT, SCALE, LEAST = 96, 247, 131, 187


def laz(path, point_format=6, n=2000):
    cloud = sample(n)
    write_las(path, cloud.xyz, point_format=point_format, classification=cloud.classification, gps_time=cloud.time)
    return bytearray(path.read_bytes())


def number(content, layout, at):
    return struct.unpack_from(layout, content, at)[0]


def with_number(content, layout, at, value):
    changed = bytearray(content)
    struct.pack_into(layout, changed, at, value)
    return changed


def laz_record(content):
    """Where the record begins that says how the points are packed."""
    return content.index(b"laszip encoded") - 2 + 54


@pytest.mark.parametrize("point_format", [3, 8])
def test_a_laz_file_that_lacks_a_byte_is_refused(tmp_path, point_format):
    """Its table of chunks is looked for a byte beside its place, where a number stands for gigabytes."""
    path = tmp_path / "c.laz"
    whole = laz(path, point_format)
    begin = number(whole, "<I", POINTS)
    for at in np.linspace(begin, len(whole) - 1, 40).astype(int):
        path.write_bytes(whole[:at] + whole[at + 1 :])
        assert "cut off or damaged" in complaint(path)


@pytest.mark.parametrize(
    ("place", "layout", "value", "says"),
    [
        ("table", "<q", 2**62, "table of its chunks is not where"),
        ("chunks", "<I", 2**32 - 1, "4294967295 chunks of points have no room"),
        ("chunks", "<I", 0, "0 chunks"),
        ("chunk size", "<I", 7, "1 chunks of 7 points do not hold the 2000"),
        ("items", "<H", 0, "another format"),
        ("layer", "<I", 2**32 - 1, "layers of a chunk are longer"),
    ],
)
def test_numbers_by_which_the_decoder_takes_room(tmp_path, place, layout, value, says):
    path = tmp_path / "c.laz"
    whole = laz(path)
    begin = number(whole, "<I", POINTS)
    at = {
        "table": begin,
        "chunks": number(whole, "<q", begin) + 4,
        "chunk size": laz_record(whole) + 12,
        "items": laz_record(whole) + 32,
        "layer": begin + 8 + 30 + 4,
    }[place]
    path.write_bytes(with_number(whole, layout, at, value))
    assert says in complaint(path)


def test_a_promise_that_its_chunks_do_not_hold(tmp_path):
    path = tmp_path / "c.laz"
    path.write_bytes(with_number(laz(path), "<Q", COUNT, 4_000_000_000))
    assert "do not hold the 4000000000" in complaint(path)


def test_packed_in_other_ways(tmp_path, monkeypatch):
    """Large chunks are unpacked point by point; a writer that cannot go back leaves the offset at the end."""
    path = tmp_path / "c.laz"
    whole = laz(path)
    cloud = clouds.read_cloud(path)
    begin = number(whole, "<I", POINTS)
    path.write_bytes(with_number(whole, "<q", begin, -1) + whole[begin : begin + 8])
    same(clouds.read_cloud(path), cloud)
    chosen = []
    monkeypatch.setattr(laz_chunks, "_LARGEST_CHUNK", 1000)
    unpacker = laz_chunks.unpacker
    monkeypatch.setattr(
        "jaxphoto.io.clouds.las.unpacker", lambda *of: chosen.append(backend := unpacker(*of)) or backend
    )
    same(clouds.read_cloud(path), cloud)
    assert chosen == [laspy.LazBackend.Lazrs]


@pytest.mark.parametrize(("at", "what"), [(SCALE, "scale"), (SCALE + 24, "offset"), (LEAST, "least")])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_headers_whose_numbers_are_none(tmp_path, at, what, value):
    path = write_las(tmp_path / "c.las", sample().xyz)
    path.write_bytes(with_number(path.read_bytes(), "<d", at, value))
    assert f"its header gives {value}, " in (said := complaint(path)) and f"as {what} X, Y, Z" in said
    with pytest.raises(InputError, match="header gives"):
        clouds.extent(path)


@pytest.mark.parametrize("kind", ["las", "laz"])
def test_a_time_that_is_none(tmp_path, kind):
    time = np.where(np.arange(1000) == 700, np.nan, 5.0)
    path = write_las(tmp_path / f"c.{kind}", sample().xyz, gps_time=time)
    assert "the time of the point" in complaint(path)


@pytest.mark.parametrize("length", [2**40, 2**63, 2**64 - 1])
def test_a_record_after_the_points_that_is_longer_than_the_file(tmp_path, length):
    path = write_las(tmp_path / "c.las", sample().xyz)
    las = laspy.read(path)
    las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("own", 7, "", b"said")])
    las.write(path)
    content = path.read_bytes()
    path.write_bytes(with_number(content, "<Q", content.rindex(b"own") + 18, length))
    assert "longer than the file" in complaint(path)


def test_points_that_begin_after_the_end(tmp_path):
    path = write_las(tmp_path / "c.las", sample().xyz)
    path.write_bytes(with_number(path.read_bytes(), "<I", POINTS, 2**32 - 1))
    assert "begin after its end" in complaint(path)


PLY = (
    "ply\nformat ascii 1.0\nelement vertex {n}\n"
    + "".join(f"property double {name}\n" for name in ("x", "y", "z", "classification", "time_s", "strip"))
    + "end_header\n1 2 3 1 5 7\n1 2 3 1 5 7\n{row}"
)


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("1 2 3 1 5", "row 13: the strip is not a whole number"),
        ('1 2 "3 1 5 7', "row 13: there are not 6 numbers"),
        ("1 2 3 one 5 7", "row 13: there are not 6 numbers"),
        ("1 2 " + "9" * 400 + " 1 5 7", "row 13: x, y, z are not three finite numbers"),
        ("1 2 3 1.5 5 7", "row 13: classification is not a whole number"),
        ("1 2 3 1 nan 7", "row 13: the time is not a finite number"),
        ("1 2 3 1 5 1e300", "row 13: the strip is not a whole number"),
    ],
)
def test_rows_of_a_ply_file_in_text(tmp_path, row, says):
    path = tmp_path / "c.ply"
    path.write_text(PLY.format(n=3, row=row))
    assert says in complaint(path)
    path.write_text(PLY.format(n=3, row="1 2 3 1 5 7"))
    assert len(clouds.read_cloud(path)) == 3


@pytest.mark.parametrize("n", ["9" * 17, "9" * 5000, "\u00b2"])
def test_a_promise_that_a_ply_file_cannot_hold(tmp_path, n):
    path = tmp_path / "c.ply"
    path.write_text(PLY.format(n=n, row=""), encoding="utf-8")
    assert "cut off" in (said := complaint(path)) or "header" in said


def test_tables_wider_and_longer_than_any(tmp_path):
    """A million columns, and a name that an array of text would give room for in every row."""
    path = tmp_path / "c.csv"
    path.write_text("X_m,Y_m,Z_m" + "," * 1_000_000 + "\n1,2,3\n")
    assert "row has more than 100000 characters" in complaint(path)
    path.write_text("X_m,Y_m,Z_m" + "," * 1_000 + "\n1,2,3\n")
    assert "1003 columns" in complaint(path)
    path.write_text("X_m,Y_m,Z_m,strip\n" + "1,2,3,a\n" * 100 + f"1,2,3,{'x' * 50_000}\n")
    assert "row 102: the strip 'xxx" in (said := complaint(path)) and "at most 256" in said
    path.write_text("X_m;Y_m;Z_m\n")
    assert "no points" in complaint(path)
    path.write_text("X_m,Y_m,Z_m,X_m\n1,2,3,4\n")
    assert "column X_m stands there twice" in complaint(path)


def test_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(InputError, match="is no file that you may read"):
        clouds.read_cloud(tmp_path / "pipe.csv")
