"""Matching: what share is right, how far it is off, which pairs, what hangs together, errors."""

import itertools

import cv2
import equinox as eqx
import numpy as np
import pytest

from jaxphoto.errors import InputError
from jaxphoto.extras.photos.features import FEATURES, OF_FEW
from jaxphoto.extras.photos.matching import match_photographs, nearest_pairs, photograph_pairs
from jaxphoto.extras.photos.rendered_photographs import SENSOR, ground_texture
from jaxphoto.georeferencing.recorded_positions import Gps
from jaxphoto.initial.matches import PairMatches, connected_images
from jaxphoto.io.photographs import photographs, sensor_and_interior
from tests.photos.ground import C_MM, mapped, photograph

pytest.importorskip("pycolmap", reason="pycolmap, which matches photographs, is not installed (extra photos)")

STATIONS = [
    ((-10, 0, 60), (0, 0, 0)),
    ((10, 2, 62), (4, -6, 20)),
    ((0, 14, 66), (-10, 3, 90)),
    ((4, -12, 80), (12, 5, 200)),
]


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """Photographs of the ground, the camera, their matrices, and the matches of all."""
    folder, rng = tmp_path_factory.mktemp("ground"), np.random.default_rng(1)
    ground = ground_texture(rng, 2400).astype(np.float32)
    matrices = [photograph(folder / f"{k}.png", ground, *at, rng) for k, at in enumerate(STATIONS)]
    taken = photographs([folder / f"{k}.png" for k in range(len(STATIONS))])
    camera = sensor_and_interior(taken, SENSOR.pixel_mm, C_MM)
    steps = []
    pairs = photograph_pairs(taken)
    matched = match_photographs(
        taken, camera.sensor, camera.interior, pairs, count=FEATURES, progress=lambda *s: steps.append(s)
    )
    assert steps == [*(("features", k, 4) for k in range(1, 5)), ("matches", 6, 6)]
    return taken, camera, matrices, matched


def pixels(matched, image, features):
    return SENSOR.px_from_mm(matched.xy_mm[image][features]) - 0.5


def offsets(matched, matrices, pair):
    """Of the matches of a pair, in pixels of the second image, and their sigmas by both features' own."""
    first, second, features = pair
    one, other = pixels(matched, first, features[:, 0]), pixels(matched, second, features[:, 1])
    matrix = matrices[second] @ np.linalg.inv(matrices[first])
    step = 1e-3 * np.eye(2)
    slopes = np.stack([(mapped(matrix, one + d) - mapped(matrix, one - d)) / 2e-3 for d in step], axis=2)
    sigmas = (matched.sigma_mm[k][f] / SENSOR.pixel_mm for k, f in zip((first, second), features.T, strict=True))
    one_sigma, other_sigma = (np.square(s)[:, None] for s in sigmas)
    return other - mapped(matrix, one), np.sqrt(np.square(slopes).sum(axis=2) * one_sigma + other_sigma)


def test_matches_are_right_and_scatter_as_stated(taken):
    _, _, matrices, matched = taken
    assert [pair[:2] for pair in matched.pairs] == list(itertools.combinations(range(4), 2))
    for pair in matched.pairs:
        off, sigma = offsets(matched, matrices, pair)
        right = np.linalg.norm(off, axis=1) < 2
        assert len(off) > 1000 and right.mean() > 0.99
        assert np.abs(off[right].mean(axis=0)).max() < 0.02
        normalised = off[right] / sigma[right]
        # Features have longer tails than a normal distribution.
        assert 0.9 < np.sqrt(np.mean(normalised**2)) < 1.35
        assert 0.7 < 1.4826 * np.median(np.abs(normalised)) < 1.05
        assert len(np.unique(pair.features[:, 0])) == len(np.unique(pair.features[:, 1])) == len(off)
    assert 0.75 < matched.sigma_factor < 1.25


def test_large_and_small_features_scatter_as_stated_alike(taken):
    _, _, matrices, matched = taken
    all_ = [offsets(matched, matrices, pair) for pair in matched.pairs]
    off, sigma = (np.concatenate(part) for part in zip(*all_, strict=True))
    right = np.linalg.norm(off, axis=1) < 2
    normalised, size = (off / sigma)[right], sigma[right, 0]
    bounds = np.quantile(size, [0, 0.5, 0.9, 0.98, 1])
    assert bounds[3] > 2 * bounds[0]
    for low, high in itertools.pairwise(bounds):
        part = (size >= low) & (size <= high)
        assert 0.9 < np.sqrt(np.mean(normalised[part] ** 2)) < 1.35


def test_faint_features_scatter_as_stated_too(taken):
    """Twice as many as such small photographs have clear ones: `sigma_factor` says that these scatter more."""
    images, camera, matrices, matched = taken
    more = match_photographs(images, camera.sensor, camera.interior, photograph_pairs(images))
    assert len(more.xy_mm[0]) > 0.75 * OF_FEW
    assert len(more.pairs[0].features) > 1.5 * len(matched.pairs[0].features)
    all_ = [offsets(more, matrices, pair) for pair in more.pairs]
    off, sigma = (np.concatenate(part) for part in zip(*all_, strict=True))
    right = np.linalg.norm(off, axis=1) < 2
    assert right.mean() > 0.99
    assert 1.1 < more.sigma_factor / matched.sigma_factor < 1.4
    normalised, size = (off / sigma)[right], sigma[right, 0]
    for part in (size < np.median(size), size >= np.median(size)):
        assert 0.9 < np.sqrt(np.mean(normalised[part] ** 2)) < 1.35


def test_matches_are_counted_and_the_same_again(taken):
    images, camera, _, matched = taken
    again = match_photographs(images[:2], camera.sensor, camera.interior, [(1, 0), (0, 1)], count=FEATURES)
    np.testing.assert_array_equal(again.pairs[0].features, matched.pairs[0].features)
    first, second, alike, kept = matched.counts.T
    np.testing.assert_array_equal(kept, [len(pair.features) for pair in matched.pairs])
    assert [*zip(first, second, strict=True)] == [pair[:2] for pair in matched.pairs]
    assert matched.n_gross == (alike - kept).sum()


def test_pairs_are_chosen(taken):
    images = taken[0]
    assert photograph_pairs(images) == list(itertools.combinations(range(4), 2))
    assert photograph_pairs(images, "sequence:1") == [(0, 1), (1, 2), (2, 3)]
    assert photograph_pairs(images, "sequence:9") == photograph_pairs(images)
    placed = [p._replace(gps=Gps(55.0, 13.0 + east / 1e4, None)) for p, east in zip(images, (0, 9, 1, 8), strict=True)]
    assert photograph_pairs(placed, "position:1") == [(0, 2), (1, 3)]
    # At 55 degrees a minute of latitude is longer than one of longitude.
    north = [images[0]._replace(gps=Gps(*at, 5.0)) for at in ((55.0, 13.0), (55.01, 13.0), (55.0, 13.015))]
    assert photograph_pairs(north, "position:1") == [(0, 1), (0, 2)]
    xy = np.random.default_rng(5).normal(size=(12, 3))
    distance = np.linalg.norm(xy[:, None] - xy, axis=2) + np.diag(np.full(12, np.inf))
    near = {(k, j) for k in range(12) for j in np.argsort(distance[k])[:3].tolist()}
    assert nearest_pairs(xy, 3) == sorted({(min(pair), max(pair)) for pair in near})
    for wrong in ("nearest", "sequence", "sequence:0", "position:x", "exhaustive:3"):
        with pytest.raises(InputError, match="give exhaustive, sequence:K, position:K or similar:K"):
            photograph_pairs(images, wrong)
    with pytest.raises(InputError, match=r"4 photograph\(s\) have no GPS position in their EXIF \(0.png, 1.png"):
        photograph_pairs(images, "position:3")


def test_connected_images():
    joined = connected_images(5, [PairMatches(1, 3, np.array([[0, 0]])), PairMatches(3, 4, np.array([[0, 0]]))])
    assert [group.tolist() for group in joined] == [[1, 3, 4], [0], [2]]


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory):
    """Two photographs of other ground."""
    folder, rng = tmp_path_factory.mktemp("elsewhere"), np.random.default_rng(7)
    ground = ground_texture(rng, 2400).astype(np.float32)
    for k, at in enumerate(STATIONS[:2]):
        photograph(folder / f"far{k}.png", ground, *at, rng)
    return [folder / "far0.png", folder / "far1.png"]


def test_photographs_that_do_not_hang_together(taken, elsewhere):
    images, camera, _, _ = taken
    near = [p.path for p in images[:2]]
    groups = photographs([near[0], *elsewhere, near[1]])
    with pytest.raises(
        InputError, match=r"2 groups of photographs without matches .*\(0.png, 1.png; far0.png, far1.png\)"
    ):
        match_photographs(groups, camera.sensor, camera.interior, photograph_pairs(groups), count=800)
    apart = photographs([near[0], elsewhere[0]])
    with pytest.raises(InputError, match=r"no two of the 2 photographs \(0.png, far0.png\) have 15 points in common"):
        match_photographs(apart, camera.sensor, camera.interior, [(0, 1)], count=800)


def test_photographs_that_match_no_other_one_are_left_out_by_name(taken, elsewhere, tmp_path):
    images, camera, _, _ = taken
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((480, 640), 90, np.uint8))
    odd = photographs([images[0].path, tmp_path / "blank.png", images[1].path, elsewhere[0]])
    found = match_photographs(odd, camera.sensor, camera.interior, photograph_pairs(odd), count=800)
    assert [pair[:2] for pair in found.pairs] == [(0, 2)]
    assert found.counts[:, 3].astype(bool).tolist() == [False, True, False, False, False, False]
    assert len(found.xy_mm[1]) == len(found.sigma_mm[1]) == 0
    assert found.left_out == {
        "blank": "no features: blank or out of focus",
        "far0": "fewer than 15 points in common with each compared photograph",
    }


def test_too_few_photographs_with_features(taken, tmp_path):
    images, camera, _, _ = taken
    for k in range(2):
        cv2.imwrite(str(tmp_path / f"blank{k}.png"), np.full((480, 640), 90, np.uint8))
    one = photographs([tmp_path / "blank0.png", images[0].path, tmp_path / "blank1.png"])
    with pytest.raises(InputError, match=r"in common; blank0.png, blank1.png have no features: blank or out of focus"):
        match_photographs(one, camera.sensor, camera.interior, photograph_pairs(one), count=800)
    with pytest.raises(InputError, match="an orientation needs at least two overlapping photographs"):
        match_photographs(images[:1], camera.sensor, camera.interior, [], count=800)


def test_a_camera_with_distortion_is_matched_by_its_ideal_coordinates(taken, tmp_path):
    """The start of a wide lens: bent images of the same ground keep their matches where the distortion is known."""
    images, camera, _, _ = taken
    k1 = -0.06
    column, row = np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5)
    xy = SENSOR.mm_from_px(np.column_stack([column.ravel(), row.ravel()]))
    ideal = xy * (1 - k1 * np.sum(xy**2, axis=1, keepdims=True))
    there = (SENSOR.px_from_mm(ideal) - 0.5).reshape(480, 640, 2).astype(np.float32)
    for p in images[:2]:
        picture = cv2.imread(str(p.path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(tmp_path / p.path.name), cv2.remap(picture, there, None, cv2.INTER_CUBIC))
    bent = photographs([tmp_path / p.path.name for p in images[:2]])
    known = eqx.tree_at(lambda i: i.distortion.k1, camera.interior, k1)
    found = match_photographs(bent, camera.sensor, known, [(0, 1)])
    unknown = match_photographs(bent, camera.sensor, camera.interior, [(0, 1)])
    assert found.counts[0, 3] > 0.98 * found.counts[0, 2]
    # Pictures interpolated twice scatter a little more; without the distortion matches scatter up to COLMAP's inlier
    # limit of 4 px, which bounds the ratio.
    assert found.sigma_factor < 2 and 3 * found.sigma_factor < unknown.sigma_factor
