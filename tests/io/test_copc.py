"""COPC: read as the LAZ that it is, written with an octree that laspy's own reader of COPC finds its way through."""

import struct

import laspy
import numpy as np
import pytest
from laspy.copc import Bounds, CopcReader

from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.io import clouds
from jaxphoto.io.clouds import copc

N = 8000
LOW, HIGH = np.array([500.0, 200.0, 40.0]), np.array([900.0, 500.0, 90.0])


def cloud(n=N):
    """A slope, with a heap of points that needs deep nodes, and some that lie in one place."""
    rng = np.random.default_rng(5)
    xyz = rng.uniform(LOW, HIGH, (n, 3))
    xyz[: n // 3] = rng.normal([600, 300, 60], 0.5, (n // 3, 3))
    xyz[:50] = [601, 301, 61]
    returns = np.tile(np.array([[1, 2], [2, 2]], np.uint8), (n // 2, 1))
    return Cloud(
        np.round(xyz, 3),
        classification=rng.integers(1, 7, n).astype(np.uint8),
        returns=returns,
        time=np.arange(n, dtype=float),
    )


@pytest.fixture
def written(tmp_path, monkeypatch):
    # Nodes as in a cloud of millions.
    monkeypatch.setattr(copc, "_LEAF", 100)
    path = tmp_path / "strip.copc.laz"
    clouds.write_cloud(cloud(), path)
    return path


def same(back, wanted):
    """Whether the clouds have the same points, in whatever order: each has a time of its own."""
    order = np.argsort(back.time)
    np.testing.assert_array_equal(back.time[order], wanted.time)
    np.testing.assert_allclose(back.xyz[order], wanted.xyz, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(back.classification[order], wanted.classification)
    np.testing.assert_array_equal(back.returns[order], wanted.returns)


def test_what_is_written_is_read_here_and_by_a_reader_of_copc(written):
    wanted = cloud()
    same(clouds.read_cloud(written), wanted)
    with CopcReader.open(str(written)) as reader:
        every = reader.query()
        np.testing.assert_array_equal(np.sort(every.gps_time), wanted.time)
        for low, high in ([600, 300, 0], [640, 340, 99]), ([520, 210, 45], [530, 480, 60]):
            found = reader.query(bounds=Bounds(np.array(low, float), np.array(high, float)))
            inside = ((wanted.xyz >= low) & (wanted.xyz <= high)).all(axis=1)
            assert inside.sum() > 5
            np.testing.assert_array_equal(np.sort(found.gps_time), wanted.time[inside])


def test_a_level_is_a_thinned_cloud_and_every_node_lies_in_its_cube(written):
    with CopcReader.open(str(written)) as reader:
        info = reader.copc_info
        side, lowest = 2 * info.halfsize, info.center - info.halfsize
        np.testing.assert_allclose(lowest, cloud().xyz.min(axis=0), atol=1e-9)
        assert info.spacing == side / 128 and (info.gps_min, info.gps_max) == (0, N - 1)
        levels = [reader.query(level=level) for level in range(12)]
        top = (np.stack([levels[0].x, levels[0].y, levels[0].z], axis=1) - lowest) / info.spacing
    # One point of each cell, whatever the heap is like; the heap's lie below.
    assert len(np.unique(np.floor(top + 1e-9), axis=0)) > 0.97 * len(levels[0]) > 1000
    assert sum(map(len, levels[3:])) > 100
    begin, size = info.hierarchy_root_offset, info.hierarchy_root_size
    keys = list(struct.iter_unpack("<4iQ2i", written.read_bytes()[begin : begin + size]))
    there = {key[:4] for key in keys}
    # A node hangs on its parent.
    assert all((n - 1, x >> 1, y >> 1, z >> 1) in there for n, x, y, z in there if n)
    assert sum(key[-1] for key in keys) == N


def test_rewritten_it_stays_one_or_says_that_it_is_none(written, tmp_path):
    wanted = cloud()
    up = np.array([0.0, 0.0, 1.5])
    moved = Cloud(wanted.xyz + up, wanted.classification, wanted.returns, wanted.time)
    for name in ("up.copc.laz", "up.laz", "up.las"):
        assert clouds.rewrite_cloud(written, tmp_path / name, lambda part: part.xyz + up) == 0
        same(clouds.read_cloud(tmp_path / name), moved)
        with laspy.open(tmp_path / name) as reader:
            said = [record.user_id for record in (*reader.header.vlrs, *(reader.evlrs or []))]
        assert said.count("copc") == (2 if "copc" in name else 0)
    clouds.write_cloud(clouds.read_cloud(written), tmp_path / "like.copc.laz", like=written)
    same(clouds.read_cloud(tmp_path / "like.copc.laz"), wanted)


@pytest.mark.parametrize("n", [2, 300])
def test_points_in_one_place_have_an_octree_too(tmp_path, monkeypatch, n):
    monkeypatch.setattr(copc, "_LEAF", 4)
    path = tmp_path / "one.copc.laz"
    clouds.write_cloud(Cloud(np.tile([5.0, 6.0, 7.0], (n, 1))), path)
    with CopcReader.open(str(path)) as reader:
        assert len(reader.query()) == n == len(clouds.read_cloud(path))


def test_points_of_formats_that_copc_does_not_have_are_refused(tmp_path):
    old = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    old.x, old.y, old.z = np.array([[1.0, 2.0], [1.0, 2.0], [3.0, 4.0]])
    old.write(tmp_path / "old.laz")
    for write in (
        lambda: clouds.rewrite_cloud(tmp_path / "old.laz", tmp_path / "new.copc.laz", lambda part: part.xyz),
        lambda: clouds.write_cloud(
            clouds.read_cloud(tmp_path / "old.laz"), tmp_path / "new.copc.laz", like=tmp_path / "old.laz"
        ),
    ):
        with pytest.raises(
            InputError, match=r"COPC has the point formats 6, 7, 8, and old.laz has 3; name a file .laz"
        ):
            write()
    assert not (tmp_path / "new.copc.laz").exists()
