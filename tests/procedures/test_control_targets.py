"""Targets that are predicted, found among others and believed: with made candidates, then in rendered photographs."""

import dataclasses
from collections import Counter

import cv2
import numpy as np
import pytest

from jaxphoto import adjust, covariance
from jaxphoto.block import Block, Frame
from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.extras.photos.control_targets import make_target_search
from jaxphoto.extras.photos.targets.on_ground import read_target
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.procedures.control import (
    GivenControl,
    Marks,
    SurveyedPoints,
    at_optimum,
    control_block,
    control_block_with_targets,
)
from jaxphoto.procedures.control.targets import Candidates, TargetSearch
from tests.photos.ground import C_MM, GROUND_M, SENSOR, mapped, photograph, texture
from tests.procedures.controlled import CODE, ORIGIN, marked_block

BY_HAND = ("G0", "G16", "G32", "G34")


def known_only(control, names):
    """With marks of some points only."""
    return control._replace(marks=control.marks.take(np.isin(control.marks.point, names)))


def search_of(control, seen_twice=()):
    """One that sees the targets of `control` where they were measured, and other things in one place and two."""
    marks = control.marks
    true = {
        (image[5:7], point): at for image, point, at in zip(marks.image, marks.point, marks.column_row, strict=True)
    }
    looked: list[float] = []

    def look(at, radius, images, ids):
        row, place = [], []
        for k in range(len(at.image)):
            looked.append(radius[k])
            target = true.get((images[at.image[k]], ids[at.point[k]]))
            # A stone, in one photograph only.
            near = [] if k % 3 else [at.column_row[k] + (2.0, 3.0)]
            near += [] if target is None else [target]
            if target is not None and ids[at.point[k]] in seen_twice:
                near.append(target + at.px_per_m[k] @ [0.8, 0.0, 0.0])
            inside = [p for p in near if np.linalg.norm(p - at.column_row[k]) < radius[k]]
            row += [k] * len(inside)
            place += inside
        return Candidates(
            np.array(row, int), np.array(place).reshape(-1, 2), np.full(len(row), 0.5), np.full(len(row), 0.5)
        )

    return TargetSearch(look, False), looked


def test_targets_are_found_from_three_marked_by_hand():
    m = marked_block()
    target_search, looked = search_of(m.control)
    found = control_block_with_targets(
        m.block, known_only(m.control, ("G0", "G16", "G32", "G34")), target_search, adjust=adjust
    )
    assert found.state[:6] == ("control",) * 6 and found.state[6:] == ("check",) * 3
    assert any("G21 in 9 of 9" in said for said in found.sentences)
    # Three sigma of an adjusted block: far less than the photograph, more than the noise.
    assert 4 < np.max(looked) < 200
    points = np.asarray(found.adjusted.unknowns.points)[-9:]
    off = MapFrame(CODE, None, ORIGIN).local(found.adjusted.block.frame.map.map(points)) - m.true_xyz
    assert np.abs(off / found.sigma_m).max() < 4.5
    # A block that lies by control already is not searched as one that only receivers have placed.
    target_search, again = search_of(m.control)
    control_block_with_targets(at_optimum(found.adjusted), known_only(m.control, ()), target_search, adjust=adjust)
    assert np.max(again) <= np.max(looked)


def test_two_things_that_look_alike_are_not_believed():
    m = marked_block()
    target_search, _ = search_of(m.control, seen_twice=("G21",))
    found = control_block_with_targets(
        m.block, known_only(m.control, ("G0", "G16", "G32", "G34")), target_search, adjust=adjust
    )
    assert any("the target of G21" in said and "mark it by hand" in said for said in found.sentences)
    assert found.state[found.ids.index("G21")] == "not marked"


def test_another_thing_at_a_check_point_gives_way_to_its_target():
    """At first the other thing is seen, 0.8 m away; then the target, or that thing again, which is said to be far."""
    m = marked_block()
    true, _ = search_of(m.control)
    calls = []

    def look(at, radius, images, ids):
        calls.append(1)
        seen = true.look(at, radius, images, ids)
        if len(calls) > 1 and target:
            return seen
        own = np.array([ids[at.point[k]] == "G21" for k in seen.row])
        away = at.px_per_m[seen.row] @ [0.8, 0.0, 0.0]
        return seen._replace(column_row=seen.column_row + np.where(own[:, None], away, 0.0))

    for target in (True, False):
        calls.clear()
        by_hand = known_only(m.control, BY_HAND)
        found = control_block_with_targets(m.block, by_hand, TargetSearch(look, False), adjust=adjust)
        off = np.linalg.norm(found.off_m[found.ids.index("G21")])
        said = "the target of G21 was found anew, 0.8" if target else "what was found for check point G21 lies 0.8"
        assert (off < 0.5) == target and any(said in text for text in found.sentences)


def test_without_a_place_nobody_knows_where_to_look():
    m = marked_block()
    with pytest.raises(InputError, match="mark three control points by hand"):
        control_block_with_targets(
            m.block, m.control._replace(marks=Marks.none()), search_of(m.control)[0], adjust=adjust
        )


SIDE_M = 1.6
SURVEYED = np.array(
    [[-22.13, -17.31], [24.4, -15.87], [1.27, 2.33], [-20.2, 18.61], [21.05, 19.44], [9.31, -8.2], [-9.45, 9.06]]
)
FIRST_M = 30.0
"""Height of the ground above the ellipsoid by the survey; the receivers say 20 m more, and 1.5 m east."""


def painted(ground, kind):
    """Targets of `SIDE_M` at `SURVEYED`."""
    size, n = len(ground), 16
    reach = int(SIDE_M / GROUND_M)
    for x, y in SURVEYED:
        column, row = x / GROUND_M + size / 2, -y / GROUND_M + size / 2
        first = np.floor([column, row]).astype(int) - reach
        fine = (np.arange(2 * reach * n) + 0.5) / n
        dx, dy = np.meshgrid((fine + first[0] - column) * GROUND_M, -(fine + first[1] - row) * GROUND_M)
        if kind == "circle":
            inside, grey = np.hypot(dx, dy) < SIDE_M / 2, np.full(dx.shape, 250.0)
        else:
            inside = (np.abs(dx) < SIDE_M / 2) & (np.abs(dy) < SIDE_M / 2)
            grey = np.where(dx * dy > 0, 5.0, 250.0)
        part, mean = (v.reshape(2 * reach, n, 2 * reach, n).mean(axis=(1, 3)) for v in (inside * 1.0, inside * grey))
        where = slice(first[1], first[1] + 2 * reach), slice(first[0], first[0] + 2 * reach)
        ground[where] = ground[where] * (1 - part) + mean


def flown(folder, kind, rng):
    """Twelve photographs of ground with targets, their block at positions of receivers, and the survey."""
    ground = cv2.GaussianBlur(texture(rng, 2400).astype(np.float32), (0, 0), 2) * 0.5 + 60
    painted(ground, kind)
    ties = np.stack(np.meshgrid(np.linspace(-40, 40, 9), np.linspace(-34, 34, 8)), axis=-1).reshape(-1, 2)
    ties += rng.uniform(-3, 3, ties.shape)
    rows, images = [], []
    for k in range(12):
        at = np.array([14.0 * (k % 4) - 21, 14.0 * (k // 4) - 14, 60.0 + 8 * (k % 3)])
        angles = (*rng.uniform(-14, 14, 2), 90.0 * (k % 4))
        matrix = photograph(folder / f"a{k:02}.png", ground, at, angles, rng)
        pixels = mapped(matrix, ties) + 0.5
        seen = ((pixels > 3) & (pixels < (SENSOR.width_px - 3, SENSOR.height_px - 3))).all(axis=1)
        xy = SENSOR.mm_from_px(pixels[seen] + rng.normal(0, 0.2, (seen.sum(), 2)))
        rows += [(f"a{k:02}", f"t{p}", *row) for p, row in zip(np.flatnonzero(seen), xy, strict=True)]
        recorded = at + np.array([1.5, 0.0, FIRST_M + 20.0])
        images.append((f"a{k:02}", *recorded, *angles))
    often = Counter(row[1] for row in rows)
    rows = [row for row in rows if often[row[1]] > 2]
    seen = dict(zip(("image", "point", "x_mm", "y_mm"), zip(*rows, strict=True), strict=True))
    names = ("image", "X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg")
    listed = dict(zip(names, zip(*images, strict=True), strict=True))
    block = Block.of(
        {name: list(v) for name, v in seen.items()},
        {"drone": (SENSOR, InteriorOrientation(C_MM))},
        sigma_mm=0.2 * SENSOR.pixel_mm,
        images={name: list(v) for name, v in listed.items()},
        stations={name: list(listed[name]) for name in names[:4]} | {"sigma_m": [0.5] * 12},
    )
    block = dataclasses.replace(block, frame=Frame("epsg", CODE, None, origin=ORIGIN))
    true = np.column_stack([SURVEYED, np.full(len(SURVEYED), FIRST_M)])
    points = SurveyedPoints(
        "survey.csv", tuple(f"P{k}" for k in range(len(true))),
        MapFrame(CODE, None, ORIGIN).map(true + rng.normal(0, 0.01, true.shape)), np.full(true.shape, 0.01),
        np.arange(len(true)) >= 5, ("survey.csv",) * len(true), f"EPSG:{CODE}",
    )  # fmt: skip
    return block, GivenControl(points, Marks.none()), true


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["circle", "cross"])
def test_targets_are_found_in_photographs_by_the_survey_alone(tmp_path, kind):
    block, control, true = flown(tmp_path, kind, np.random.default_rng(5))
    description = {"circle": f"circle:diameter_mm={SIDE_M * 1000}", "cross": f"cross:side_mm={SIDE_M * 1000}"}[kind]
    target_search = make_target_search(read_target(description), {path.stem: path for path in tmp_path.glob("*.png")})
    found = control_block_with_targets(block, control, target_search, adjust=adjust)
    assert found.state == ("control",) * 5 + ("check",) * 2
    assert sum(found.n_marks) > 30
    off = np.asarray(found.adjusted.unknowns.points)[-len(true) :] - true
    assert np.abs(off).max() < 0.06 and np.abs(off / found.sigma_m).max() < 4.5
    assert np.sqrt(np.mean(found.marks_px**2)) < 0.25
    shift = np.asarray(found.adjusted.unknowns.more["flight_bias"][""].shift)
    np.testing.assert_allclose(shift, (1.5, 0.0, 20.0), atol=0.3)
    # One control point leaves the block at its stations, but for their shift.
    marks, names = found.marks, found.adjusted.block.images
    own = marks.point == 2
    column_row = SENSOR.px_from_mm(marks.xy_mm[own])
    images = tuple(names[i] for i in marks.image[own])
    by_hand = Marks(images, ("P2",) * len(images), column_row, np.full(len(images), 0.2), ("a",) * len(images))
    one = control_block(at_optimum(adjust(block)), control._replace(marks=by_hand), adjust=adjust)
    assert one.state[2] == "control" and one.state.count("not marked") == 6
    assert any("the block stays at its positions" in said for said in one.sentences)
    label = one.adjusted.structure.labels.index("flight_bias.shift_Z_m")
    sigma = float(covariance(one.adjusted).shared_sigma[label])
    assert sigma < 0.5 and abs(float(one.adjusted.unknowns.more["flight_bias"][""].shift[2]) - 20) < 3 * sigma + 0.05
