"""Blunders are detected, identified and rejected; exchanged names are corrected."""

import dataclasses
import itertools

import numpy as np
import pytest

from jaxphoto import adjust, snoop
from jaxphoto.errors import RankError
from jaxphoto.report.residual_findings import snooped_findings
from tests.blocks import adjusted_example, example, simulated
from tests.marks import slow_but


@pytest.fixture(scope="module")
def block():
    return simulated("cross").block


@pytest.fixture(scope="module")
def whole(block):
    return adjust(block)


def with_xy(block, change):
    """`block` with image coordinates changed in place by `change`."""
    xy = np.array(block.image_points.xy)
    change(xy)
    return block.with_observations({"image_points": dataclasses.replace(block.image_points, xy=xy)})


def of_many_rays(block, n):
    """Rows of points with the most rays, one of a point."""
    p = block.image_points
    points = np.argsort(-np.bincount(p.point), kind="stable")[:n]
    return [int(np.flatnonzero(p.point == point)[k % 3]) for k, point in enumerate(points)]


def test_no_observation_is_rejected_without_blunders(block, whole):
    found = snoop(block)
    assert not (found.left_out or found.points or found.exchanged)
    np.testing.assert_allclose(found.adjusted.unknowns.points, whole.unknowns.points, atol=1e-6)
    assert float(found.adjusted.sigma0) == pytest.approx(float(whole.sigma0), rel=1e-6)


def test_blunders_of_every_kind_are_rejected_and_nothing_else(block, whole):
    wrong = of_many_rays(block, 6)

    def spoil(xy):
        for k, row in enumerate(wrong):
            xy[row] += (
                np.asarray(block.image_points.sigma)[row] * [30, -200, 12, 1000, 60, 300][k] * np.array([0.8, 0.6])
            )

    spoilt, station, control = with_xy(block, spoil), block.stations, block.control
    value, surveyed = np.array(station.value), np.array(control.value)
    value[4] += 5.0
    heights = np.flatnonzero(control.axis == 0)
    surveyed[heights[0]] -= 3.0
    spoilt = spoilt.with_observations(
        {
            "stations": dataclasses.replace(station, value=value),
            "control_points": dataclasses.replace(control, value=surveyed),
        }
    )
    found = snoop(spoilt)
    assert {(s.group, s.row) for s in found.left_out} == {
        *(("image_points", row) for row in wrong),
        ("stations", 4),
        ("control_points", int(heights[0])),
    }
    assert not found.points
    by_row = {(s.group, s.row): s for s in found.left_out}
    assert abs(by_row["stations", 4].error - 5.0) < 5 * by_row["stations", 4].sigma
    assert abs(by_row["control_points", int(heights[0])].error + 3.0) < 5 * by_row["control_points", heights[0]].sigma
    assert abs(float(found.adjusted.sigma0) / float(whole.sigma0) - 1) < 0.1


def test_exchanged_names_are_corrected(block, whole):
    p = block.image_points
    first = of_many_rays(block, 1)[0]
    rays = np.bincount(p.point)[p.point]
    far = np.abs(np.asarray(p.xy) - np.asarray(p.xy)[first]).max(axis=1)
    second = int(np.argmax(np.where((p.image == p.image[first]) & (rays >= 4), far, 0.0)))

    def exchange(xy):
        xy[[first, second]] = xy[[second, first]]

    found = snoop(with_xy(block, exchange))
    (exchange,) = found.exchanged
    assert exchange.group == p.group and set(exchange.rows[0]) == {first, second}
    one, other = (block.points[p.point[k]] for k in exchange.rows[0])
    assert exchange.words == f"points {one} and {other} of image {block.images[p.image[first]]} had each other's name"
    assert not found.left_out
    np.testing.assert_allclose(found.adjusted.unknowns.points, whole.unknowns.points, atol=1e-5)


def test_a_point_of_two_contradicting_rays_is_rejected_whole(block, whole):
    p = block.image_points
    rays = np.bincount(p.point, minlength=len(block.points))
    point = int(np.flatnonzero(rays == rays.min())[0])
    rows = np.flatnonzero(p.point == point)

    def spoil(xy):
        xy[rows[0]] += [0.4, 0.5]
        xy[rows[1:]] -= [0.3, 0.5]

    found = snoop(with_xy(block, spoil))
    left = {s.row for s in found.left_out if s.group == "image_points"}
    assert block.points[point] in found.points or left <= set(rows.tolist())
    assert abs(float(found.adjusted.sigma0) / float(whole.sigma0) - 1) < 0.1


@pytest.mark.parametrize("pair", [[202, 206], [202, 208]])
def test_a_second_initial_solution_is_tried_if_the_first_fails(block, pair, whole):
    """Exchanged names in the last image, whose orientation they turn: the first beginning ends at sigma naught 180."""

    def exchange(xy):
        xy[pair] = xy[pair[::-1]]

    found = snoop(with_xy(block, exchange))
    assert len(found.exchanged) == 1
    assert not (found.left_out or found.points)
    assert abs(float(found.adjusted.sigma0) / float(whole.sigma0) - 1) < 1e-6


def test_exchanged_names_of_points_of_two_rays():
    """Both points are gone with their rays; what was measured under the other's name brings them back."""
    block = example()
    p, position = block.image_points, np.asarray(block.start.unknowns.exterior.position)
    rays, image = np.bincount(p.point)[p.point], block.images.index("A2")
    pairs = []
    for a, b in itertools.combinations(np.flatnonzero((p.image == image) & (rays == 2)).tolist(), 2):
        others = [int(p.image[(p.point == p.point[k]) & (p.image != image)][0]) for k in (a, b)]
        (x, y), (along, up) = np.asarray(p.xy)[b] - np.asarray(p.xy)[a], (position[others[0]] - position[image])[:2]
        # Exchanged along their epipolar lines nothing would show.
        if others[0] == others[1] and abs(x * up - y * along) > 4.0 * np.hypot(along, up):
            pairs.append([a, b])
    pair = pairs[0]

    def exchange(xy):
        xy[pair] = xy[pair[::-1]]

    found = snoop(with_xy(block, exchange))
    (exchange,) = found.exchanged
    assert {p.point[k] for k in exchange.rows[0]} == set(p.point[pair])
    assert not (found.left_out or found.points)
    # Whichever of the two images they were exchanged in: the same two places.
    places = np.asarray(adjusted_example().unknowns.points)[p.point[pair]]
    again = np.asarray(found.adjusted.unknowns.points)[p.point[pair]]
    assert min(np.abs(again - places).max(), np.abs(again[::-1] - places).max()) < 1e-4


@pytest.mark.parametrize(
    "case",
    slow_but(
        [("control_points", "T10", "T12"), ("stations", "B7", "B8")],
        [
            # Of many images; such that the first beginning leaves sound rows out, and others seem exchanged.
            ("control_points", "T10", "T12"), ("control_points", "T16", "T21"), ("control_points", "T15", "T31"),
            # The second and the third beginning find it.
            ("control_points", "T11", "T17"), ("stations", "B1", "C1"),
            ("stations", "B7", "B8"),
        ],
    ),
)  # fmt: skip
def test_exchanged_coordinates_are_corrected(case):
    group, one, other = case
    block = example()
    rows = block.named_observations[group]
    names = block.points if group == "control_points" else block.images
    a, b = (np.flatnonzero(rows.who == names.index(name)) for name in (one, other))
    value = np.array(rows.value)
    value[a], value[b] = value[b].copy(), value[a].copy()
    found = snoop(block.with_observations({group: dataclasses.replace(rows, value=value)}))
    (exchange,) = found.exchanged
    assert exchange.group == group and {one, other} <= set(exchange.words.split())
    assert not (found.left_out or found.points)
    assert float(found.adjusted.sigma0) == pytest.approx(float(adjusted_example().sigma0), rel=1e-6)


def test_coordinates_that_are_wrong_are_not_taken_for_an_exchange(block):
    """One control point has the coordinates of another, which are its own as well."""
    control = block.control
    one, other = (np.flatnonzero(control.who == k) for k in np.unique(control.who)[:2])
    value = np.array(control.value)
    value[one] = value[other]
    found = snoop(block.with_observations({"control_points": dataclasses.replace(control, value=value)}))
    assert not found.exchanged
    rows = {s.row for s in found.left_out if s.group == "control_points"}
    assert rows and rows <= set(one.tolist())


def test_a_common_error_of_all_rows_is_rejected_and_nothing_else(block):
    """c and the ground take up nearly all of it; then the sound coordinates of stations contradict what looks right."""
    stations = block.stations
    heights = np.asarray(stations.axis) == 2
    value = np.asarray(stations.value) + 48.0 * heights
    found = snoop(block.with_observations({"stations": dataclasses.replace(stations, value=value)}))
    assert {(s.group, s.row) for s in found.left_out} == {("stations", int(row)) for row in np.flatnonzero(heights)}
    np.testing.assert_allclose([s.error for s in found.left_out], 48.0, atol=4.0)
    (finding,) = [f for f in snooped_findings(found, block) if f.code == "rejected_bias"]
    assert (finding.subject, finding.value) == ("stations along Z", heights.sum())


def test_undetermined_parameters_are_reported_as_by_an_adjustment(block):
    """Not that too much contradicts too much: nothing does."""
    p, stations = block.image_points, block.stations
    of_two_points = (p.image != 3) | np.isin(np.arange(len(p)), np.flatnonzero(p.image == 3)[:2])
    part = block.with_observations(
        {"image_points": p.take(of_two_points), "stations": stations.take(np.asarray(stations.who) != 3)}
    )
    with pytest.raises(RankError) as told:
        snoop(part, part.start.unknowns)
    with pytest.raises(RankError) as plain:
        adjust(part, part.start.unknowns)
    assert str(told.value) == str(plain.value)
