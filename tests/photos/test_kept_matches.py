"""Features and matches on disk: a run that was stopped goes on to the same result; photographs that look alike."""

import numpy as np
import pytest

import jaxphoto.extras.photos.matching as matching
from jaxphoto.extras.photos.features import sift_features
from jaxphoto.extras.photos.matching import match_photographs
from jaxphoto.extras.photos.photograph_pairs import (
    MostSimilar,
    largest_of,
    most_similar,
    photograph_pairs,
    usual_choice,
    usual_count,
)
from jaxphoto.initial.matches import connected_images
from jaxphoto.io.kept_pieces import KeptPieces
from jaxphoto.io.photographs import photographs, sensor_and_interior
from tests.photos.ground import C_MM, SENSOR, photograph, texture

pytest.importorskip("pycolmap", reason="pycolmap, which matches photographs, is not installed (extra photos)")

COUNT = 400


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """Two places, three photographs of each, one after the other in turn, and the camera."""
    folder, rng = tmp_path_factory.mktemp("places"), np.random.default_rng(3)
    for place in "ab":
        ground = texture(rng, 1600).astype(np.float32)
        for k in range(3):
            photograph(folder / f"{k}{place}.png", ground, (6.0 * k - 6, 2.0 * k, 60), (0, 3 * k, 60 * k), rng)
    taken = photographs(sorted(folder.iterdir()))
    return taken, sensor_and_interior(taken, SENSOR.pixel_mm, C_MM)


def matched(taken, pairs, **options):
    read, camera = taken
    return match_photographs(
        read, camera.sensor, camera.interior, pairs, count=COUNT, longest_px=480, in_parts=True, **options
    )


def same(one, other):
    arrays = [(*m.xy_mm, *m.sigma_mm, m.counts, *(p.features for p in m.pairs)) for m in (one, other)]
    return one.sigma_factor == other.sigma_factor and all(
        a.tobytes() == b.tobytes() and a.dtype == b.dtype for a, b in zip(*arrays, strict=True)
    )


class Stopped(Exception):
    pass


def test_a_run_stopped_anywhere_goes_on_to_the_same_result(taken, tmp_path, monkeypatch):
    pairs = photograph_pairs(taken[0])
    whole = matched(taken, pairs)
    found = []

    def counted(path, *rest):
        found.append(path)
        return sift_features(path, *rest)

    monkeypatch.setattr(matching, "sift_features", counted)
    monkeypatch.setattr(matching, "_CHUNK", 4)

    def stop(at):
        def progress(*step):
            if step[:2] == at:
                raise Stopped

        return progress

    pieces = KeptPieces(tmp_path / "kept")
    for at in (("features", 2), ("features", 6), ("matches", 4), ("matches", 12)):
        with pytest.raises(Stopped):
            matched(taken, pairs, keep=pieces, progress=stop(at))
    assert same(matched(taken, pairs, keep=pieces), whole)
    assert len(found) == 6
    # What is damaged is made anew, what depends on other options as well.
    for file in list(pieces.folder.glob("*.piece"))[::3]:
        file.write_bytes(file.read_bytes()[:-9])
    assert same(matched(taken, pairs, keep=pieces), whole)
    found.clear()
    read, camera = taken
    match_photographs(read[::2], camera.sensor, camera.interior, [(0, 1)], count=300, longest_px=480, keep=pieces)
    assert len(found) == 3


def test_those_that_look_alike_are_those_of_one_place(taken):
    read, camera = taken
    largest = [largest_of(sift_features(p.path, camera.sensor, COUNT, 480)) for p in read]
    same_place = [(a, b) for a in range(6) for b in range(a + 1, 6) if (b - a) % 2 == 0]
    assert most_similar(largest, 2, lambda done, of: None) == same_place
    found = matched(taken, photograph_pairs(read, "similar:2"))
    assert found.counts[:, :2].tolist() == [list(pair) for pair in same_place]
    assert [group.tolist() for group in connected_images(6, found.pairs)] == [[0, 2, 4], [1, 3, 5]]
    # Nothing looks like what shows nothing, and few features are as good as many.
    empty = largest[0][:0]
    assert most_similar([empty, largest[0], largest[2], empty], 2, lambda done, of: None) == [(1, 2)]


def test_the_usual_pairs_of_few_and_of_many(taken):
    read, _ = taken
    assert usual_choice(read) == "exhaustive"
    assert (usual_count(40), usual_count(41)) == (10_000, 5_000)
    many = [read[0]] * 41
    assert usual_choice(many) == "similar:20" and photograph_pairs(many, "similar:20") == MostSimilar(20)
