"""Edits of a block: what changes and what stays, inside and outside transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import FIXED, FREE, Brown, InputError, InteriorOrientation, Smac, Weighted, adjust
from jaxphoto.camera import get_parameter, parameter_names
from tests.blocks import SENSOR, adjusted, simulated


def free_of(block, camera="one"):
    own = block.priors.interior[camera]
    return {name for name in parameter_names(own) if get_parameter(own, name) == FREE}


def test_another_distortion_comes_with_its_priors():
    block = simulated("cross").block.weigh("c", 0.01)
    other = block.with_distortion("one", Smac(k1=-9e-5), free=("k1", "k2"))
    assert free_of(other) == {"xp_mm", "yp_mm", "k1", "k2"}
    assert isinstance(other.priors.interior["one"].c, Weighted)
    assert other.priors.interior["one"].distortion.p1 == FIXED == other.priors.interior["one"].distortion.r0
    assert other.start.unknowns.interior["one"].distortion.k1 == -9e-5
    assert type(block.start.unknowns.interior["one"].distortion) is Brown
    back = other.with_distortion("one", block.start.unknowns.interior["one"].distortion, free=("k1", "k2"))
    assert free_of(back) == free_of(block)
    # The same model: the same adjustment.
    start = adjusted("cross").unknowns
    assert jax.tree.structure(back) == jax.tree.structure(block)
    assert float(adjust(back, start).sigma0) == float(adjust(block, start).sigma0)


def test_another_camera_keeps_priors_by_name_or_takes_those_named():
    block = simulated("cross").block
    interior = InteriorOrientation(36.0, 0.0, 0.0, Smac())
    assert free_of(block.with_camera("one", interior)) == free_of(block)
    other = block.with_camera("one", interior, free=("c", "p1"), sensor=SENSOR)
    assert free_of(other) == {"c_mm", "p1"}
    assert other.start.unknowns.interior["one"].c == 36.0 and other.sensors["one"] == SENSOR


def test_a_parameter_is_fixed_at_a_value():
    block = simulated("cross").block
    held = block.fix("c", value=35.0)
    assert (held.start.unknowns.interior["one"].c, held.priors.interior["one"].c) == (35.0, FIXED)
    assert held.start.unknowns.interior["one"].xp == block.start.unknowns.interior["one"].xp
    block, mount, arm = simulated("mount").block, "imu", [0.1, 0.2, 0.3]
    np.testing.assert_array_equal(
        block.fix("lever_arm", value=arm, of=mount).start.unknowns.mounts[mount].lever_arm, arm
    )
    slope = jax.jacobian(lambda v: block.fix("lever_arm", value=v).start.unknowns.mounts[mount].lever_arm)(jnp.ones(3))
    np.testing.assert_array_equal(slope, np.eye(3))


def test_shifts_of_stations_by_block_strip_and_image():
    block = simulated("strips").block
    rows, strips = block.stations, np.array(block.image_strip)
    moved = lambda b: np.asarray(b.stations.value) - np.asarray(rows.value)  # noqa: E731
    np.testing.assert_allclose(moved(block.shift_stations([0.0, 0.1, 0.2])), 0.1 * np.asarray(rows.axis), atol=1e-9)
    shifts = np.array([[0.1, 0.2, 0.3], [-0.4, -0.5, -0.6]])
    names = list(dict.fromkeys(block.image_strip))
    expected = np.array([shifts[names.index(strips[i]), a] for i, a in zip(rows.who, rows.axis, strict=True)])
    np.testing.assert_allclose(moved(block.shift_stations(shifts, per="strip")), expected, atol=1e-9)
    one = block.shift_stations({names[1]: shifts[1]}, per="strip")
    np.testing.assert_allclose(moved(one), np.where(strips[np.asarray(rows.who)] == names[1], expected, 0), atol=1e-9)
    by_image = np.arange(30.0).reshape(10, 3)
    own = moved(block.shift_stations(by_image, per="image"))
    np.testing.assert_allclose(own, by_image[np.asarray(rows.who), np.asarray(rows.axis)], atol=1e-9)
    # The shift goes into the strips, which are free, and nowhere else.
    traced = jax.jit(jax.vmap(lambda s: block.shift_stations(s, per="strip").stations.value))(jnp.array([shifts]))
    np.testing.assert_allclose(np.asarray(traced)[0] - np.asarray(rows.value), expected, atol=1e-9)


def test_control_by_name_and_back():
    block = simulated("cross").block
    names = np.array(block.points)
    control, check = (list(dict.fromkeys(names[rows.who])) for rows in (block.control, block.check))
    swapped = block.with_control(*check, sigma=0.05)
    assert set(names[swapped.control.who]) == set(check) and set(names[swapped.check.who]) == set(control)
    assert (np.asarray(swapped.control.sigma) > 0).all()
    back = swapped.with_control(*control)
    order = lambda rows: np.lexsort((rows.axis, rows.who))  # noqa: E731
    for name in ("who", "axis", "value", "sigma"):
        got, want = (np.asarray(getattr(b.control, name))[order(b.control)] for b in (back, block))
        np.testing.assert_array_equal(got, want)
    assert len(back.control) + len(back.check) == len(block.control) + len(block.check)


def test_without_images_leaves_the_others_as_they_were():
    block = simulated("cross").block
    gone, pairs = block.images[3], lambda b: (b.image_points.image, b.image_points.point)
    part = block.without_images(gone)
    assert part.images == tuple(name for name in block.images if name != gone)
    seen = {(block.images[i], block.points[p]) for i, p in zip(*pairs(block), strict=True)}
    left = {(part.images[i], part.points[p]) for i, p in zip(*pairs(part), strict=True)}
    assert left == {(i, p) for i, p in seen if i != gone and p in part.points}
    assert bool(adjust(part).converged)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda b: b.with_distortion("sony", Smac()), "unknown camera sony"),
        (lambda b: b.with_distortion("one", Smac(), free=("k9",)), "no parameter 'k9'; it has c_mm"),
        (lambda b: b.with_camera("one", InteriorOrientation(35.0), free=("a1",)), "no parameter 'a1'"),
        (lambda b: b.fix("c", "k1", value=1.0), "one value for 2 parameters"),
        (lambda b: b.fix("points", value=[1.0, 2.0]), "array of the shape"),
        (lambda b: b.shift_stations(np.zeros((3, 3)), per="strip"), r"shape \(3, 3\); give"),
        (lambda b: b.shift_stations({"z": np.zeros(3)}, per="image"), "unknown image 'z'"),
        (lambda b: b.shift_stations([0.1]), r"give X, Y, Z in metres"),
        (lambda b: b.with_control("T99"), "point T99 has no surveyed coordinates"),
        (lambda b: b.without_images("B99"), "unknown image 'B99'"),
    ],
)
def test_what_a_block_does_not_have_is_named(call, message):
    with pytest.raises(InputError, match=message):
        call(simulated("cross").block)
