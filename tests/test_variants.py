"""Variants of a block: nothing is lost, nothing doubled, and indices still mean the same ids."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto import FIXED, FREE, BlockError, Outcome, adjust
from jaxphoto.block import Block, Datum, Motion
from jaxphoto.compiling.fast_compilation import jit_quickly
from jaxphoto.observations import ControlCoordinates
from jaxphoto.simulation import remeasure
from jaxphoto.statistics import check_discrepancies
from jaxphoto.unknowns import is_prior
from jaxphoto.variants import (
    MODES,
    all_control,
    common_shift,
    control_only,
    direct,
    hold_interior,
    indirect,
    integrated,
    strips,
    vertical_control,
    without_attitudes,
    without_control,
    without_stations,
)
from tests import blocks

bounded = settings(max_examples=30, deadline=None, derandomize=True, database=None)


def everything() -> Block:
    return blocks.simulated("everything").block


def named(rows: ControlCoordinates, ids) -> dict:
    """ControlRows by what they say, whatever the numbering; fails on a row that is there twice."""
    found = {(ids[w], int(a)): (float(v), float(s)) for w, a, v, s in zip(*vars(rows).values(), strict=True)}
    assert len(found) == len(rows.who)
    return found


def coordinates(block: Block) -> dict:
    """All surveyed coordinates, of whatever role."""
    return named(ControlCoordinates.joined(block.control, block.fixed, block.check), block.points)


def measured(block: Block) -> dict:
    r = block.image_points
    pairs = [(block.images[i], block.points[p]) for i, p in zip(r.image, r.point, strict=True)]
    assert len(set(pairs)) == len(pairs)
    return dict(zip(pairs, np.column_stack([r.xy, r.sigma]).tolist(), strict=True))


def without_sigmas(rows: dict) -> dict:
    return {key: value for key, (value, _) in rows.items()}


def survey(rng: np.random.Generator, block: Block) -> Block:
    """The block with its surveyed coordinates dealt anew to control, fixed and check."""
    n = len(block.points)
    role = rng.integers(0, 4, (n, 3))
    rows = []
    for k in range(3):
        who, axis = np.nonzero(role == k)
        sigma = np.array([0.03, 0.0, 0.0])[k] * np.ones(len(who))
        rows.append(ControlCoordinates(who, axis, rng.normal(size=len(who)), sigma))
    return dataclasses.replace(block, control=rows[0], fixed=rows[1], check=rows[2])


# Control and check ------------------------------------------------------------------------------------------


@bounded
@given(st.integers(0, 2**32 - 1))
def test_no_coordinate_is_lost_or_doubled(seed):
    rng = np.random.default_rng(seed)
    block = survey(rng, everything())
    before = without_sigmas(coordinates(block))
    with_control = sorted({block.points[w] for w in (*block.control.who, *block.fixed.who)})
    kept = [str(name) for name in rng.choice(with_control, rng.integers(0, 5), replace=False)]
    for variant in (without_control, vertical_control, all_control, lambda b: control_only(b, kept)):
        after = variant(block)
        assert without_sigmas(coordinates(after)) == before
        assert measured(after) == measured(block)
        assert np.all(np.asarray(after.control.sigma) > 0)


@bounded
@given(st.integers(0, 2**32 - 1))
def test_roles_after_each_variant(seed):
    block = survey(np.random.default_rng(seed), everything())
    none = without_control(block)
    assert len(none.control.who) == len(none.fixed.who) == 0
    heights = vertical_control(block)
    assert set(heights.control.axis) | set(heights.fixed.axis) <= {2} and set(heights.check.axis) <= {0, 1}
    everywhere = all_control(block)
    assert len(everywhere.check.who) == 0
    # Back again: control that was demoted keeps its sigma, so promoting it changes nothing.
    demoted = dataclasses.replace(
        without_control(dataclasses.replace(block, fixed=ControlCoordinates.none(), check=ControlCoordinates.none()))
    )
    assert named(all_control(demoted).control, block.points) == named(block.control, block.points)


def test_control_only_keeps_the_points_named():
    block = everything()
    chosen = [block.points[block.control.who[0]], block.points[block.fixed.who[0]]]
    kept = control_only(block, chosen)
    assert {kept.points[w] for w in kept.control.who} <= set(chosen)
    assert {kept.points[w] for w in kept.fixed.who} == {chosen[1]}
    assert not {kept.points[w] for w in kept.check.who} & set(chosen)
    with pytest.raises(ValueError, match="p0 is not a control point"):
        control_only(block, ["p0"])


def test_check_points_take_the_sigma_of_the_control_or_the_one_given():
    block = blocks.simulated("cross").block
    per_axis = np.array([0.02, 0.03, 0.05])
    block = dataclasses.replace(block, control=dataclasses.replace(block.control, sigma=per_axis[block.control.axis]))
    promoted = all_control(block).control
    np.testing.assert_array_equal(promoted.sigma, per_axis[promoted.axis])
    given = all_control(block, 0.5)
    assert sorted(set(given.control.sigma)) == [0.02, 0.03, 0.05, 0.5]
    np.testing.assert_array_equal(vertical_control(block).control.sigma, 0.05)
    with pytest.raises(ValueError, match=r"in X have no sigma.*control has no sigmas in that axis"):
        all_control(dataclasses.replace(block, control=ControlCoordinates.none()))
    mixed = dataclasses.replace(
        block, control=dataclasses.replace(block.control, sigma=0.01 + 0.01 * block.control.who)
    )
    with pytest.raises(ValueError, match="in Z have no sigma"):
        vertical_control(mixed)


# Strips -----------------------------------------------------------------------------------------------------


def moving(block: Block) -> Block:
    """With a motion that tells images apart, a datum over points, and unknown approximations."""
    n = len(block.images)
    return dataclasses.replace(
        block,
        motion=Motion(np.arange(3.0 * n).reshape(n, 3), -np.arange(3.0 * n).reshape(n, 3)),
        datum=Datum("inner", block.points[::3]),
        start=dataclasses.replace(block.start, image_known=np.arange(n) % 3 > 0),
    )


@pytest.mark.parametrize("kept", [("a",), ("b",), ("b", "a")])
def test_strips_keep_what_their_images_show(kept):
    block = moving(everything())
    part = strips(block, kept)
    names = [i for i, s in zip(block.images, block.image_strip, strict=True) if s in kept]
    assert list(part.images) == names
    rays = [p for i, p in measured(block) if i in names]
    assert set(part.points) == {p for p in block.points if rays.count(p) >= 2}
    assert measured(part) == {k: v for k, v in measured(block).items() if k[0] in part.images and k[1] in part.points}
    assert (np.diff(part.image_points.point) >= 0).all()

    for role in ("control", "fixed", "check"):
        want = named(getattr(block, role), block.points)
        assert named(getattr(part, role), part.points) == {k: v for k, v in want.items() if k[0] in part.points}
    want = named(block.stations, block.images)
    assert named(part.stations, part.images) == {k: v for k, v in want.items() if k[0] in names}

    old, new = (
        {b.images[i]: tuple(v) for i, v in zip(b.attitudes.image, b.attitudes.roll_pitch_yaw, strict=True)}
        for b in (block, part)
    )
    assert new == {k: v for k, v in old.items() if k in names}
    old, new = (
        {(b.points[p], b.points[q]): v for (p, q), v in zip(b.distances.points, b.distances.value, strict=True)}
        for b in (block, part)
    )
    assert new == {k: v for k, v in old.items() if set(k) <= set(part.points)}
    assert part.datum.over == tuple(p for p in block.datum.over if p in part.points)

    image, point = [block.images.index(i) for i in part.images], [block.points.index(p) for p in part.points]
    for get, index in (
        (lambda b: b.image_time, image),
        (lambda b: b.motion.velocity, image),
        (lambda b: b.motion.rate, image),
        (lambda b: b.start.image_known, image),
        (lambda b: b.start.unknowns.exterior.position, image),
        (lambda b: b.start.unknowns.exterior.camera_from_object, image),
        (lambda b: b.start.unknowns.points, point),
        (lambda b: b.start.point_known, point),
        (lambda b: np.array(b.image_camera), image),
        (lambda b: np.array(b.image_mount), image),
    ):
        np.testing.assert_array_equal(get(part), get(block)[index])
    assert set(part.start.unknowns.strips) == set(part.priors.strips) == set(kept)
    if set(kept) == {"a", "b"}:
        assert part.points == block.points


def test_strips_drop_the_cameras_and_mounts_that_took_none_of_their_images():
    block = blocks.simulated("strips").block
    unknowns, priors = block.start.unknowns, block.priors
    camera = ("one",) * 5 + ("two",) * 5
    both = lambda tree: {"one": tree["one"], "two": tree["one"]}  # noqa: E731
    where = lambda b: (b.start.unknowns.interior, b.priors.interior)  # noqa: E731
    block = eqx.tree_at(where, block, (both(unknowns.interior), both(priors.interior)))
    block = dataclasses.replace(block, sensors=both(block.sensors), image_camera=camera)
    part = strips(block, ["b"])
    assert set(part.sensors) == set(part.start.unknowns.interior) == set(part.priors.interior) == {"two"}
    for wrong in ("c", ""):
        with pytest.raises(ValueError, match=f"unknown strip '{wrong}'; use one of a, b"):
            strips(block, [wrong])


# Modes ------------------------------------------------------------------------------------------------------


def test_without_sensors_what_only_they_see_is_held():
    block = everything()
    no_stations = without_stations(block)
    assert len(no_stations.stations.who) == 0 and eqx.tree_equal(no_stations.attitudes, block.attitudes)
    mount = no_stations.priors.mounts["imu"]
    assert mount.lever_arm == FIXED and mount.boresight == FREE
    assert {bias.shift for bias in no_stations.priors.strips.values()} == {FIXED}
    no_attitudes = without_attitudes(block)
    mount = no_attitudes.priors.mounts["imu"]
    assert mount.lever_arm != FIXED and mount.boresight == FIXED and mount.time_offset == FIXED
    assert eqx.tree_equal(no_attitudes.stations, block.stations) and no_attitudes.priors.strips["a"].shift == FREE
    neither = indirect(eqx.tree_at(lambda b: b.priors.mounts["imu"].time_offset, block, FREE))
    assert len(neither.stations.who) == len(neither.attitudes.image) == 0
    assert set(jax.tree.leaves(neither.priors.mounts, is_leaf=is_prior)) == {FIXED}
    assert measured(neither) == measured(block)


def test_an_interior_held_takes_the_values_named_and_keeps_the_others():
    block = everything()
    camera, *others = block.start.unknowns.interior
    held = hold_interior(block, camera, {"c_mm": 33.3, "yp_mm": -0.4})
    before, after = (b.start.unknowns.interior[camera] for b in (block, held))
    assert (float(after.c), float(after.yp)) == (33.3, -0.4)
    assert jax.tree.leaves(after.distortion) == jax.tree.leaves(before.distortion)
    assert float(after.xp) == float(before.xp)
    assert all(prior == FIXED for prior in jax.tree.leaves(held.priors.interior[camera], is_leaf=is_prior))
    assert all(eqx.tree_equal(held.priors.interior[name], block.priors.interior[name]) for name in others)
    assert any(prior != FIXED for prior in jax.tree.leaves(block.priors.interior[camera], is_leaf=is_prior))


def test_modes_by_name():
    block = everything()
    assert [MODES[name] for name in ("direct", "integrated", "indirect")] == [direct, integrated, indirect]
    assert integrated(block) is block


def with_true_sensors(block: Block, truth) -> Block:
    """Stations and attitudes without noise, and mount and strips as they are: direct must then find the truth."""
    exact = sharp(block)
    draw = jit_quickly(lambda key: blocks.observed(remeasure(exact, truth, key)))
    sensed = jax.tree.map(np.asarray, draw(jax.random.key(0)))
    block = eqx.tree_at(lambda b: b.start.unknowns.mounts, block, truth.mounts)
    block = eqx.tree_at(lambda b: b.start.unknowns.strips, block, truth.strips)
    return eqx.tree_at(lambda b: (b.attitudes.roll_pitch_yaw, b.stations.value), block, sensed[1:3])


def sharp(block: Block) -> Block:
    sigmas = lambda b: (b.stations.sigma, b.attitudes.sigma)  # noqa: E731
    return eqx.tree_at(sigmas, block, jax.tree.map(np.zeros_like, sigmas(block)))


def test_direct_takes_the_sensors_where_there_are_both_and_the_start_elsewhere():
    block, truth = blocks.simulated("everything")
    held = direct(with_true_sensors(block, truth))
    sensed = block.attitudes.image
    assert 0 < len(sensed) < len(block.images)
    others = np.setdiff1d(np.arange(len(block.images)), sensed)
    for field in ("position", "camera_from_object"):
        got, true, start = (getattr(u.exterior, field) for u in (held.start.unknowns, truth, block.start.unknowns))
        np.testing.assert_allclose(got[sensed], true[sensed], rtol=0, atol=1e-10)
        np.testing.assert_array_equal(got[others], start[others])
    priors = (held.priors.exterior, held.priors.mounts, held.priors.strips)
    assert set(jax.tree.leaves(priors, is_leaf=is_prior)) == {FIXED}
    assert len(held.stations.who) == len(held.attitudes.image) == 0
    assert held.start.image_known.all()
    unknown = eqx.tree_at(lambda b: b.start.image_known, block, np.arange(10) != others[0])
    with pytest.raises(BlockError, match=f"image {block.images[others[0]]} has neither"):
        direct(unknown)


def test_direct_is_differentiable_in_the_mount():
    block = blocks.simulated("mount").block

    def position(arm):
        moved = eqx.tree_at(lambda b: b.start.unknowns.mounts["imu"].lever_arm, block, arm)
        return direct(moved).start.unknowns.exterior.position[0]

    by = np.asarray(jax.jit(jax.jacfwd(position))(jnp.array([0.1, 0.2, 0.3])))
    np.testing.assert_allclose(by @ by.T, np.eye(3), rtol=0, atol=1e-12)


def test_adjustment_with_held_images_is_an_intersection():
    block, truth = blocks.simulated("mount")
    block = direct(without_control(with_true_sensors(block, truth)))
    block = dataclasses.replace(block, priors=eqx.tree_at(lambda p: p.interior["one"], block.priors, fixed(block)))
    block = eqx.tree_at(lambda b: b.start.unknowns.interior, block, truth.interior)
    result = adjust(block, block.start.unknowns)
    assert result.outcome is Outcome.CONVERGED
    np.testing.assert_array_equal(result.unknowns.exterior.position, block.start.unknowns.exterior.position)
    # Two observations a ray, three unknowns a point, and nothing else is adjusted.
    assert result.redundancy == 2 * len(block.image_points.image) - 3 * len(block.points)
    assert 0.85 < result.sigma0 < 1.15
    check = check_discrepancies(result)
    assert len(check.who) == len(blocks.CONTROL) * 3 + len(blocks.CHECK) * 3
    # Noise of 4 um at 1000 m and 35 mm: 0.11 m in a ray.
    assert 0.01 < np.sqrt(np.mean(np.asarray(check.value)[check.axis < 2] ** 2)) < 0.15


def test_a_common_shift_takes_the_place_of_the_strips():
    block = everything()
    common = common_shift(block)
    assert (set(common.image_strip), set(common.priors.strips)) == ({"block"}, {"block"})
    bias = common.priors.strips["block"]
    assert (bias.shift, bias.drift) == (FREE, FIXED)
    assert not np.any(jax.tree.leaves(common.start.unknowns.strips))
    back = dataclasses.replace(common, image_strip=block.image_strip, start=block.start, priors=block.priors)
    assert eqx.tree_equal(back, block)


def fixed(block: Block):
    return jax.tree.map(lambda _: FIXED, block.start.unknowns.interior["one"])
