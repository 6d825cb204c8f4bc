"""Photographs oriented to one another from their matches alone, false ones among them; truth is known."""

import dataclasses

import numpy as np
import pytest

from jaxphoto.adjustment import solve
from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names, set_parameter
from jaxphoto.compiling import run
from jaxphoto.errors import BlockError, GroupsError
from jaxphoto.initial.matches import PairMatches
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.orientation import orient
from jaxphoto.statistics import covariance
from jaxphoto.unknowns import FIXED, Weighted
from tests.procedures.orientable import (
    PIXEL,
    SENSOR,
    Camera,
    Scene,
    convergent,
    errors_over_sigmas,
    looking,
    photographed,
    placed,
)

pytest.importorskip("pycolmap", reason="pycolmap, which orients images, is not installed (extra photos)")

FALSE = 0.3
TRUTH = {"c_mm": 8.0, "xp_mm": 0.04, "yp_mm": -0.03, "k1": 1.5e-3, "k2": -2e-5}


def oriented_from(photographs):
    sigmas = [np.full(len(xy), 0.3 * PIXEL) for xy in photographs.features]
    start = InteriorOrientation(8.6)
    return orient(photographs.names, SENSOR, start, photographs.features, photographs.matches, sigmas)


@pytest.fixture(scope="module")
def scene():
    return convergent(n_images=7, n_points=220)


@pytest.fixture(scope="module")
def clean(scene):
    return oriented_from(photographed(scene))


@pytest.fixture(scope="module")
def spoilt(scene):
    return oriented_from(photographed(scene, false=FALSE))


def parameters(oriented):
    """Estimates and a posteriori sigmas of the interior orientation that is free."""
    adjusted = adjust(oriented.block)
    labels = [label.split("].")[1] for label in adjusted.structure.labels]
    sigmas = dict(zip(labels, np.asarray(covariance(adjusted).shared_sigma), strict=True))
    interior = oriented.block.start.unknowns.interior["camera"]
    return {n: (float(get_parameter(interior, n)), sigmas[n]) for n in oriented.report.estimated}


@pytest.mark.parametrize("which", ["clean", "spoilt"])
def test_camera_and_images_are_those_of_the_truth(which, scene, request):
    oriented = request.getfixturevalue(which)
    assert oriented.block.images == tuple(f"p{k:02d}" for k in range(7))
    assert oriented.report.converged
    assert 0.9 < oriented.report.sigma0 < 1.1
    # Of 0.3 px in each of two axes, less what the unknowns take up.
    assert 0.3 < oriented.report.mean_px < 0.4
    found = parameters(oriented)
    assert set(found) >= {"c_mm", "k1"}
    for name, (value, sigma) in found.items():
        assert abs(value - TRUTH.get(name, 0.0)) < 3.5 * sigma, (name, value, sigma)
    adjusted = adjust(oriented.block)
    order, _, stations, matrices = placed(adjusted, scene)
    # 0.3 px of 1,600 at a distance of 8 m is 1.5 mm; stations are some parts of that to some times that.
    assert np.linalg.norm(stations - scene.positions[order], axis=1).max() < 0.006
    np.testing.assert_allclose(matrices, scene.matrices[order], rtol=0, atol=1e-3)
    ratios = errors_over_sigmas(adjusted, scene)
    assert np.abs(ratios).max() < 3.5
    assert np.sqrt(np.mean(ratios**2)) < 1.5


def test_false_matches_change_nothing_beyond_three_sigma(clean, spoilt, scene):
    a, b = parameters(clean), parameters(spoilt)
    assert set(a) == set(b)
    for name in a:
        assert abs(a[name][0] - b[name][0]) < 3 * a[name][1], name
    # The same rays but for a few, so that their errors are nearly the same.
    assert np.abs(in_order(clean, scene) - in_order(spoilt, scene)).max() < 1.0


def in_order(oriented, scene):
    """Errors over sigmas of stations and rotations, by image."""
    assert len(oriented.block.images) == len(scene.positions)
    return errors_over_sigmas(adjust(oriented.block), scene)[np.argsort(oriented.block.images)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 5))
def test_false_matches_change_nothing_in_other_scenes(seed):
    scene = convergent(7, 220, seed=seed)
    one, other = (oriented_from(photographed(scene, false=f, seed=seed + 1)) for f in (0.0, FALSE))
    one, other = in_order(one, scene), in_order(other, scene)
    assert np.abs(one - other).max() < 3.0
    for ratios in (one, other):
        assert np.abs(ratios).max() < 4.0
        assert np.sqrt(np.mean(ratios**2)) < 1.6


def test_false_matches_are_found_and_counted(scene, clean, spoilt):
    photographs = photographed(scene, false=FALSE)
    ends = [
        [photographs.point_of[image][feature] for image, feature in zip(m[:2], m.features.T, strict=True)]
        for m in photographs.matches
    ]
    # Clutter is no point, and so never the same one.
    n_false = sum(int(((one != other) | (one < 0)).sum()) for one, other in ends)
    n = sum(len(one) for one, _ in ends)
    assert abs(n_false / n - FALSE) < 0.01
    report = spoilt.report
    assert report.n_matches == n
    # A false match is on its epipolar line by chance in few cases; of the true ones hardly any goes.
    assert 0.9 * n_false < report.gross_errors.off_epipolar < 1.02 * n_false + 5
    assert clean.report.gross_errors.off_epipolar < 0.01 * n
    rows = spoilt.block.image_points
    assert report.n_image_points == len(rows.image)
    assert len(rows.image) > 0.97 * len(clean.block.image_points.image)


def test_the_block_is_adjusted_by_the_program_that_oriented_it(spoilt):
    """Where its camera is observed, as that was."""
    block, priors = spoilt.block, observed_camera(spoilt.block)
    before = set(run._programs)
    found = solve(block, block.start.unknowns, priors, sizes=spoilt.sizes)
    assert bool(found.converged)
    assert set(run._programs) == before


def observed_camera(block):
    """Priors that observe all of the camera that is not held."""
    priors, start = block.priors.interior["camera"], block.start.unknowns.interior["camera"]
    for name in parameter_names(priors):
        if get_parameter(priors, name) != FIXED:
            priors = set_parameter(priors, name, Weighted(float(get_parameter(start, name)), 1.0))
    return dataclasses.replace(block.priors, interior={"camera": priors})


def test_block_holds_what_was_oriented(clean):
    block = clean.block
    assert block.start.image_known.all()
    assert block.start.point_known.all()
    assert block.datum.kind == "inner"
    assert np.bincount(block.image_points.point).min() >= 2
    assert sorted(clean.report.order) == sorted(block.images)


def test_two_groups_that_nothing_connects_are_both_named(scene):
    p = photographed(scene)
    matches = [m for m in p.matches if (m.first < 3) == (m.second < 3) and m.second in (1, 2, 4)]
    sigmas = [np.full(len(xy), 0.3 * PIXEL) for xy in p.features]
    with pytest.raises(GroupsError, match=r"2 groups .*\(p00, p01, p02; p03, p04\)") as apart:
        orient(p.names, SENSOR, InteriorOrientation(8.0), p.features, matches, sigmas)
    assert apart.value.groups == ({"p00", "p01", "p02"}, {"p03", "p04"})


def test_too_few_matches(scene):
    p = photographed(scene)
    matches = [PairMatches(0, 1, p.matches[0].features[:6])]
    with pytest.raises(BlockError, match="images p00 and p01 have 6 matches, and 15 are needed"):
        orient(p.names, SENSOR, InteriorOrientation(8.0), p.features, matches)


def test_a_photograph_of_something_else_and_one_twice_from_a_place(scene):
    """The former is named; the latter are both oriented by their pairs with the others."""
    twice = Scene(*(v[[0, 1, 2, 3, 4, 2]] for v in scene[:2]), scene.points)
    p = photographed(twice)
    rng = np.random.default_rng(0)
    half = np.array([SENSOR.width_mm, SENSOR.height_mm]) / 2
    features = [*p.features, rng.uniform(-half, half, (250, 2))]
    false = [
        PairMatches(i, 6, np.column_stack([rng.permutation(len(p.features[i]))[:40], rng.permutation(250)[:40]]))
        for i in range(6)
    ]
    sigmas = [np.full(len(xy), 0.3 * PIXEL) for xy in features]
    names = (*p.names, "elsewhere")
    found = orient(names, SENSOR, InteriorOrientation(8.6), features, [*p.matches, *false], sigmas)
    assert sorted(found.block.images) == list(p.names)
    assert found.report.unoriented == {"elsewhere": "no other image has a relative orientation to it"}
    ratios = errors_over_sigmas(adjust(found.block), twice)
    assert np.abs(ratios).max() < 3.5


@pytest.mark.parametrize("false", [0.0, FALSE])
def test_images_from_one_place_are_recognised(false):
    rng = np.random.default_rng(3)
    centre, angles = np.array([0.0, 0.0, 1.0]), np.deg2rad(np.arange(0, 120, 20))
    matrices = np.stack([looking(centre, centre + np.array([np.cos(a), np.sin(a), 0.1]), 0.0) for a in angles])
    points = rng.normal(size=(600, 3))
    points *= (10 * rng.uniform(0.5, 3, 600) / np.linalg.norm(points, axis=1))[:, None]
    p = photographed(Scene(np.tile(centre, (6, 1)), matrices, points), Camera(8.0, 0.0, 0.0, 0.0, 0.0), false=false)
    with pytest.raises(BlockError, match=r"no two of the 6 images .*were taken from one place"):
        orient(p.names, SENSOR, InteriorOrientation(8.0), p.features, p.matches)


def test_groups_that_one_image_connects_by_three_points_are_named(scene):
    p = photographed(scene)
    matches = [m for m in p.matches if max(m.first, m.second) <= 3 or min(m.first, m.second) >= 3]
    few = [m._replace(features=m.features[:3]) if m.first == 3 else m for m in matches]
    with pytest.raises(BlockError, match=r"2 groups .*\(p00, p01, p02, p03; p04, p05, p06\)"):
        orient(p.names, SENSOR, InteriorOrientation(8.0), p.features, few)
