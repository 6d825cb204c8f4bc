"""Who meets whom: the lists behind the structured normal equations, and that no order of rows or ids matters."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import adjust
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.block import Start
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.observations import ControlCoordinates, Distances, ImagePoints
from tests.blocks import VARIANTS, adjusted, covariance_of, simulated


@pytest.mark.parametrize("name", VARIANTS)
def test_unknowns_of_one_image_never_share_a_colour(name):
    block = simulated(name).block
    s = structure_of(block, block.priors)
    assert len(s.column) == s.n_images and s.n_image_colours <= s.column.shape[1]
    for i, columns in enumerate(s.column):
        meant = columns[columns < s.n_shared]
        assert len(set(meant.tolist())) == len(meant)
        own = {
            f"interior[{block.image_camera[i]}].",
            f"mounts[{block.image_mount[i]}].",
            f"strips[{block.image_strip[i]}].",
        }
        theirs = [k for k, label in enumerate(s.labels) if any(label.startswith(o) for o in own)]
        assert sorted(meant.tolist()) == theirs
    assert len(set(s.labels)) == len(s.labels)


def test_what_rows_touch_says_how_they_are_eliminated():
    """Nobody declares it: one point, images and what they share, or several points."""
    layouts = {
        g.name: g.elimination for name in ("everything", "surfaces") for g in structure_of_variant(name).observed
    }
    assert layouts == {
        "stations": "reduced",
        "attitudes": "reduced",
        "priors": "reduced",
        "control_points": "point",
        "surfaces": "point",
        "distances": "coupled",
    }
    s = structure_of_variant("everything")
    (distances,) = s.coupled
    np.testing.assert_array_equal(distances.point, simulated("everything").block.distances.points.T)


def structure_of_variant(name):
    block = simulated(name).block
    return structure_of(block, block.priors)


def permuted(block, images, points, seed):
    """The same block with its images and points in another order, and rows of a point shuffled."""
    rng = np.random.default_rng(seed)
    new_image, new_point = np.argsort(images), np.argsort(points)
    rows = block.image_points
    order = rng.permutation(len(rows.point))
    order = order[np.argsort(new_point[rows.point[order]], kind="stable")]
    who = lambda r, place: type(r)(place[r.who], r.axis, r.value, r.sigma)  # noqa: E731
    shuffled = rng.permutation(len(block.control.who))
    control = ControlCoordinates(
        *(
            np.asarray(v)[shuffled]
            for v in (block.control.who, block.control.axis, block.control.value, block.control.sigma)
        )
    )
    u = block.start.unknowns
    exterior = ExteriorOrientation(u.exterior.position[images], u.exterior.camera_from_object[images])
    where = lambda t: (t.exterior, t.points)  # noqa: E731
    pick = lambda names: tuple(names[i] for i in images)  # noqa: E731
    return dataclasses.replace(
        block,
        images=pick(block.images),
        points=tuple(block.points[p] for p in points),
        image_camera=pick(block.image_camera),
        image_mount=pick(block.image_mount),
        image_strip=pick(block.image_strip),
        image_time=np.asarray(block.image_time)[images],
        image_points=ImagePoints(
            new_image[rows.image][order], new_point[rows.point][order], rows.xy[order], rows.sigma[order]
        ),
        control=who(control, new_point),
        check=who(block.check, new_point),
        stations=who(block.stations, new_image),
        start=Start(
            eqx.tree_at(where, u, (exterior, u.points[points])), block.start.image_known, block.start.point_known
        ),
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_no_order_matters(seed):
    one = adjusted("cross")
    rng = np.random.default_rng(seed)
    images, points = rng.permutation(len(one.block.images)), rng.permutation(len(one.block.points))
    block = permuted(one.block, images, points, seed)
    assert block.images != one.block.images
    other = adjust(block, block.start.unknowns)
    assert float(other.sum_of_squares) == pytest.approx(float(one.sum_of_squares), rel=1e-9)
    assert other.redundancy == one.redundancy
    sigma = covariance_of("cross")
    error = np.asarray(other.unknowns.points) - np.asarray(one.unknowns.points)[points]
    np.testing.assert_array_less(np.abs(error), 5e-5 * np.asarray(sigma.point_sigma)[points])
    error = np.asarray(other.unknowns.exterior.position) - np.asarray(one.unknowns.exterior.position)[images]
    np.testing.assert_array_less(np.abs(error), 5e-5 * np.asarray(sigma.exterior_sigma)[images, :3])


def test_names_of_cameras_do_not_matter():
    """Two cameras swapped in name and in order give the same two calibrations."""
    block, _ = simulated("two_cameras")
    swap = {"one": "two", "two": "one"}
    rename = lambda table: {swap[name]: table[name] for name in reversed(table)}  # noqa: E731
    swapped = eqx.tree_at(
        lambda b: (b.start.unknowns.interior, b.priors.interior),
        dataclasses.replace(
            block, sensors=rename(block.sensors), image_camera=tuple(swap[c] for c in block.image_camera)
        ),
        (rename(block.start.unknowns.interior), rename(block.priors.interior)),
    )
    one, other = adjusted("two_cameras"), adjust(swapped, swapped.start.unknowns)
    assert float(other.sum_of_squares) == pytest.approx(float(one.sum_of_squares), rel=1e-9)
    for name in swap:
        assert float(other.unknowns.interior[swap[name]].c) == pytest.approx(
            float(one.unknowns.interior[name].c), abs=1e-6
        )
    assert abs(float(one.unknowns.interior["one"].c) - float(one.unknowns.interior["two"].c)) > 0.1


def test_rows_that_cannot_be_are_refused():
    block = simulated("cross").block
    backwards = block.image_points.take(np.arange(len(block.image_points))[::-1])
    with pytest.raises(ValueError, match="sorted by point"):
        structure_of(eqx.tree_at(lambda b: b.image_points, block, backwards), block.priors)
    twice = block.image_points.take(np.r_[0, np.arange(len(block.image_points))])
    with pytest.raises(ValueError, match="twice"):
        structure_of(eqx.tree_at(lambda b: b.image_points, block, twice), block.priors)


def test_a_point_that_only_a_distance_meets_is_refused():
    block = simulated("inner").block
    lonely = dataclasses.replace(
        block,
        points=(*block.points, "far"),
        distances=Distances(np.array([[0, len(block.points)]]), np.ones(1), np.ones(1)),
    )
    with pytest.raises(BlockError, match="point far is determined by distances only"):
        structure_of(lonely, block.priors)
