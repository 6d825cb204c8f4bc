"""A block in a frame of its own, surveyed points in UTM and marks: the truth again, blunders named, nothing turned."""

import dataclasses
import re

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import FIXED, adjust
from jaxphoto.block import Datum
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.observations import CameraPositions
from jaxphoto.procedures.control import GivenControl, Marks, at_optimum, control_block
from jaxphoto.procedures.control.control_block import check_handedness, check_units, onto_control
from jaxphoto.procedures.control.marks import TURNED, are_undistorted, intersected, turned_marks, without_names
from jaxphoto.procedures.control.marks import marked as marked_rows
from jaxphoto.rotation import matrix_from_omega_phi_kappa
from jaxphoto.simulation import image_coordinates
from tests.blocks import calibration_flight, free_network, simulated
from tests.procedures.controlled import CHECK, CODE, CONTROL, ORIGIN, marked_block, surveyed_and_without


@pytest.fixture(scope="module")
def marked():
    return marked_block()


def found_in(marked, control):
    return control_block(marked.block, control, adjust=adjust)


def in_true_frame(found):
    """The surveyed points of the adjustment in the frame of the truth, by way of the map."""
    a = found.adjusted
    points = np.asarray(a.unknowns.points)[-len(found.ids) :]
    return MapFrame(CODE, None, ORIGIN).local(a.block.frame.map.map(points))


def with_coordinates(control, coordinates):
    return control._replace(points=control.points._replace(coordinates=coordinates))


def test_control_brings_the_block_to_its_place(marked):
    found = found_in(marked, marked.control)
    assert found.adjusted.block.frame.code == CODE and bool(found.adjusted.converged)
    assert found.state == ("control",) * len(CONTROL) + ("check",) * len(CHECK)
    # Against the truth, not against what was surveyed.
    off = in_true_frame(found) - marked.true_xyz
    sigma = found.sigma_m
    assert np.abs(off / sigma).max() < 4.5 and np.sqrt(np.mean((off / sigma) ** 2)) < 1.6
    check = np.array(found.state) == "check"
    assert np.nanmax(found.w[check]) < 3.5 and np.nanmax(found.w[~check]) < 3.5
    assert not [s for s in found.sentences if "rejected" in s]
    # Once more: it lies by control now, and not by any positions.
    again = control_block(at_optimum(found.adjusted), marked.control, adjust=adjust)
    assert any("offset of the control from the block" in s for s in again.sentences)


@pytest.mark.slow
def test_differences_scatter_as_their_standard_deviations_say():
    """Forty surveys and flights drawn anew: check points and residuals of control over their standard deviations."""
    block, truth = free_network(), simulated("cross").truth
    true, sigma = np.asarray(image_coordinates(block, truth)), np.asarray(block.image_points.sigma)
    check, control, left = [], [], 0
    for seed in range(40):
        m = marked_block(seed, true + sigma * np.random.default_rng(1000 + seed).normal(size=true.shape))
        found = found_in(m, m.control)
        state = np.array(found.state)
        left += int((state == "left out").sum())
        check.append(found.w[state == "check"].ravel())
        control.append(found.w[state == "control"].ravel())
    for values, spread in ((np.concatenate(check), 0.25), (np.concatenate(control), 0.2)):
        known = values[np.isfinite(values)]
        assert len(known) > 200 and abs(np.mean(known**2) - 1) < spread, np.mean(known**2)
    # Of 40 x 6 control points hardly one is off by four standard deviations.
    assert left <= 1


def test_a_wrong_coordinate_and_a_wrong_mark_are_named_and_turn_nothing(marked):
    control, sound = marked.control, found_in(marked, marked.control)
    xyz, pixels = control.points.coordinates.copy(), control.marks.column_row.copy()
    xyz[1] += (5.0, 0.0, 0.0)
    pixels[2] += (300.0, 0.0)
    image, name = control.marks.image[2], control.marks.point[2]
    wrong = with_coordinates(control, xyz)._replace(marks=control.marks._replace(column_row=pixels))
    found = found_in(marked, wrong)
    said = " ".join(found.sentences)
    assert f"the mark of {name} in {image[5:7]} contradicts those" in said
    assert f"control point {control.points.ids[1]} contradicts the rest by 5" in said
    assert found.state[1] == "left out" and found.n_marks[0] == sound.n_marks[0] - 1
    moved = in_true_frame(found) - in_true_frame(sound)
    others = np.arange(len(found.ids)) != 1
    assert np.abs(moved / found.sigma_m)[others].max() < 2


def test_control_on_a_line_needs_positions_of_the_photographs(marked):
    """Two places, one of them by two names: what turns about the line through them the stations tell."""
    points, marks = marked.control
    there = at_optimum(found_in(marked, marked.control).adjusted)
    position = np.asarray(there.start.unknowns.exterior.position)
    image, axis = np.indices(position.shape).reshape(2, -1)
    stations = CameraPositions(image, axis, position.ravel(), np.full(image.size, 0.1))
    placed = dataclasses.replace(without_names(there, points.ids), stations=stations)
    again = marks.take(np.array(marks.point) == points.ids[1])
    again = again._replace(point=("again",) * len(again.point))
    own = np.isin(points.ids, ("G0", "G3"))
    ids = (*np.array(points.ids)[own].tolist(), "again", *np.array(points.ids)[points.check].tolist())
    which = [*np.flatnonzero(own), 1, *np.flatnonzero(points.check)]
    line = points._replace(
        ids=ids, coordinates=points.coordinates[which], sigma_m=points.sigma_m[which], check=points.check[which],
        places=tuple(ids),
    )  # fmt: skip
    given = GivenControl(line, Marks.joined(marks, again))
    found = control_block(placed, given, adjust=adjust)
    assert found.state == ("control",) * 3 + ("check",) * 3 and (found.w[3:] < 4).all()
    assert any("3 control points in two photographs or more lie on a line" in s for s in found.sentences)
    with pytest.raises(
        InputError, match="lie on a line, so the rotation about it is undetermined; mark one off the line"
    ):
        control_block(marked.block, given, adjust=adjust)


def test_a_blunder_that_the_places_hide_is_found_by_the_adjustment(marked):
    """2 m, within what a block of this size may be bent by before it is adjusted."""
    points, xyz = marked.control.points, marked.control.points.coordinates.copy()
    xyz[3, 0] += 2.0
    sigma = np.where(points.check[:, None], np.nan, points.sigma_m)
    given = marked.control._replace(points=points._replace(coordinates=xyz, sigma_m=sigma))
    found = found_in(marked, given)
    assert [name for name, state in zip(found.ids, found.state, strict=True) if state == "left out"] == ["G16"]
    # It checks nothing either; and of check points nobody has said how well they were surveyed.
    check = found.adjusted.block.check
    assert len(check) == 3 * len(CHECK) and not np.asarray(check.sigma).any()


@pytest.mark.parametrize("wrong", [("T1", "T2"), ("T2", "T3"), ("T5", "T7")])
def test_two_wrong_heights_of_eight_are_named(wrong):
    """25 m, which a tilt of the block brings within its tolerance for one of the two."""
    block, truth, *_ = calibration_flight()
    given, rest = surveyed_and_without(block)
    empty = {name: rest.named_observations[name].take(np.zeros(0, int)) for name in ("stations", "attitudes")}
    mount = lambda b: b.priors.mounts["default"].boresight  # noqa: E731
    free = dataclasses.replace(eqx.tree_at(mount, rest.with_observations(empty), FIXED), datum=Datum("inner"))
    xyz = given.points.coordinates.copy()
    xyz[[given.points.ids.index(name) for name in wrong], 2] += 25.0
    found = control_block(at_optimum(adjust(free)), with_coordinates(given, xyz))
    assert {name for name, state in zip(found.ids, found.state, strict=True) if state == "left out"} == set(wrong)
    off = dict(zip(found.ids, found.off_m, strict=True))
    assert all(off[name][2] == pytest.approx(25.0, abs=0.5) for name in wrong)
    c = found.adjusted.unknowns.interior["phase"].c
    assert float(c) == pytest.approx(float(truth.interior["phase"].c), abs=0.1)


def test_heights_that_nobody_surveyed_cost_a_sentence(marked):
    xyz = marked.control.points.coordinates.copy()
    xyz[:, 2] = 0.0
    with pytest.raises(
        InputError, match=r"do not fit their coordinates.*all 9 surveyed heights are 0 m; if they were not surveyed"
    ):
        found_in(marked, with_coordinates(marked.control, xyz))


def test_marks_that_fit_nothing_are_why_there_is_no_control(marked):
    """Such as lists whose names are those of other photographs."""
    marks = marked.control.marks
    elsewhere = np.random.default_rng(5).uniform((0, 0), (4500, 3000), np.shape(marks.column_row))
    wrong = marked.control._replace(marks=marks._replace(column_row=elsewhere))
    with pytest.raises(InputError, match=r"control points in two.*the marks of G\d+ in .* contradict one"):
        found_in(marked, wrong)


def test_exchanged_names_are_seen(marked):
    xyz = marked.control.points.coordinates.copy()
    xyz[[0, 4]] = xyz[[4, 0]]
    found = found_in(marked, with_coordinates(marked.control, xyz))
    said = " ".join(found.sentences)
    assert "control point G0 contradicts" in said and "control point G32 contradicts" in said


def test_marks_that_cannot_be_used_cost_a_sentence(marked):
    control = marked.control
    pixels = control.marks.column_row.copy()
    pixels[0] = (9000.0, 10.0)
    image = ("nowhere.jpg", *control.marks.image[1:2], "I2.jpg", *control.marks.image[3:])
    spoilt = control._replace(marks=control.marks._replace(image=image))
    said = " ".join(found_in(marked, spoilt).sentences)
    assert "rejected: 1 mark of photographs that are not used: nowhere.jpg (marks.csv, row 2)" in said
    spoilt = control._replace(marks=control.marks._replace(column_row=pixels))
    assert "rejected: 1 mark outside of the picture" in " ".join(found_in(marked, spoilt).sentences)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: with_coordinates(c, c.points.coordinates[:, [1, 0, 2]]), "with X and Y exchanged"),
        (lambda c: c._replace(points=c.points._replace(system="")), "does not state the coordinate system"),
        (lambda c: c._replace(marks=c.marks.take(np.arange(3))), "1 control point in two photographs or more"),
        (lambda c: c._replace(marks=c.marks._replace(image=("x",) * len(c.marks.image))), "no mark (x) is in"),
        (lambda c: with_coordinates(c, c.points.coordinates[[3, 0, 4, 1, 5, 2, 6, 7, 8]]), "do not fit"),
    ],
)
def test_control_that_cannot_be_is_refused_in_a_sentence(marked, change, words):
    with pytest.raises(InputError) as caught:
        found_in(marked, change(marked.control))
    assert words in str(caught.value), caught.value


@pytest.mark.parametrize("factor", [2400 / 4608, 0.5, 0.25])
def test_marks_of_resized_pictures_are_told_by_their_factor(marked, factor):
    marks = marked.control.marks
    resized = marks._replace(column_row=factor * marks.column_row)
    with pytest.raises(InputError) as error:
        found_in(marked, marked.control._replace(marks=resized))
    told = float(re.search(r"multiplied by ([\d.]+)", str(error.value))[1])
    assert told == pytest.approx(1 / factor, rel=0.01)


@pytest.mark.parametrize("words", TURNED)
def test_marks_by_another_convention_are_named_by_the_one_that_restores_them(marked, words):
    """Such as rows from the bottom, or of pictures that a viewer turned by their EXIF orientation."""
    control, sensor = marked.control, marked.block.sensors["one"]
    size, steps = np.array([[sensor.width_px, sensor.height_px]], float), np.eye(2)
    # Columns and rows that the convention converts into the true ones.
    zero = TURNED[words](np.zeros((1, 2)), size)
    turn = TURNED[words](steps, size) - zero
    column_row = (control.marks.column_row - zero) @ np.linalg.inv(turn)
    inside = ((column_row >= 0) & (column_row <= size)).all(axis=1)
    assert inside.sum() > 6
    rows, _ = marked_rows(marked.block, control.points, control.marks._replace(column_row=column_row))
    start = marked.block.start.unknowns
    good = intersected(marked.block, start, rows, control.points.ids).good
    found = turned_marks(marked.block, start, rows, good)
    restored = TURNED[found](column_row[inside], size)
    np.testing.assert_allclose(restored, control.marks.column_row[inside], atol=1e-6)
    true, _ = marked_rows(marked.block, control.points, control.marks)
    assert turned_marks(marked.block, start, true, np.ones(len(true.image), bool)) is None


def test_marks_of_undistorted_pictures_are_refused(marked):
    control, sensor = marked.control, marked.block.sensors["one"]
    interior = marked.block.start.unknowns.interior["one"]
    xy = sensor.mm_from_px(control.marks.column_row)
    ideal = np.array([interior.ideal_from_measured(p) for p in xy]) + np.asarray(interior.principal_point)
    undistorted = control.marks._replace(column_row=sensor.px_from_mm(ideal))
    start = marked.block.start.unknowns
    for marks, expected in ((control.marks, False), (undistorted, True)):
        rows, _ = marked_rows(marked.block, control.points, marks)
        assert are_undistorted(marked.block, start, rows) is expected
    with pytest.raises(InputError, match="undistorted"):
        found_in(marked, control._replace(marks=undistorted))


@pytest.mark.parametrize("axis", [0, 2])
def test_one_axis_of_the_control_in_another_unit_is_named_with_its_factor(axis):
    rng = np.random.default_rng(7)
    there = rng.uniform(-1.0, 1.0, (9, 3)) * [400.0, 300.0, 12.0]
    turn = np.asarray(matrix_from_omega_phi_kappa(np.array([0.05, -0.03, 2.1])))
    here = 100.0 + 1.7 * there @ turn.T + rng.normal(0, 0.02, there.shape)
    check_units(there, here, "points.csv")
    here[:, axis] /= 0.3048
    with pytest.raises(InputError, match=f"if {'XYZ'[axis]} is multiplied") as error:
        check_units(there, here, "points.csv")
    assert float(re.search(r"multiplied by ([\d.]+)", str(error.value))[1]) == pytest.approx(0.3048, rel=0.01)
    # One wrong point is no unit.
    here[:, axis] *= 0.3048
    here[4, axis] += 30.0
    check_units(there, here, "points.csv")


def test_control_outside_of_the_area_of_its_system_is_refused(marked):
    """In feet, as the system of the file is metric: PROJ returns a position beyond the pole."""
    xyz = marked.control.points.coordinates / 0.3048
    with pytest.raises(InputError, match="outside the area of EPSG"):
        found_in(marked, with_coordinates(marked.control, xyz))


def test_flat_control_with_exchanged_axes_is_refused():
    """On flat ground a mirrored plan is that of a block under the ground, which looks up."""
    block, sigma = simulated("cross").block, np.full(8, 0.1)
    there = np.append(np.random.default_rng(3).uniform(-300, 300, (8, 2)), np.zeros((8, 1)), axis=1)
    exchanged = there[:, [1, 0, 2]]
    mirrored = onto_control(there, exchanged, sigma, "points.csv")
    assert mirrored.agree.all()
    with pytest.raises(InputError, match="X and Y exchanged"):
        check_handedness(block, mirrored, there, exchanged, sigma, "points.csv")
    check_handedness(block, onto_control(there, there, sigma, "points.csv"), there, there, sigma, "points.csv")
