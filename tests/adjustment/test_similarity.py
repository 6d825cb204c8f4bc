"""Free networks: brought to their datum as a whole, and found from starts that are far off."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import adjust
from jaxphoto.adjustment import Linearised
from jaxphoto.adjustment.model.numbers import Increments, zero_increments
from jaxphoto.adjustment.solver.optimum import unit_scale
from jaxphoto.adjustment.solver.similarity import after, motions, n_open_motions, onto_datum, similarity
from jaxphoto.block import Datum
from jaxphoto.observations import CameraPositions, Distances
from jaxphoto.rotation import small_angles, small_rotation
from tests.adjustment.dense import prepared
from tests.blocks import free_network, from_afar, simulated

BAR = Distances(np.array([[3, 37]]), np.zeros(1), np.array([0.01]))


@pytest.mark.parametrize("kind", ["inner", "minimal"])
@pytest.mark.parametrize(("distances", "motions"), [(None, 7), (BAR, 6)])
def test_a_similarity_meets_the_constraints_and_changes_nothing_else(kind, distances, motions):
    values, s, _ = prepared(free_network(kind, distances))
    assert n_open_motions(values, s) == motions
    rng = np.random.default_rng(3)
    eop, shared, points = zero_increments(s)
    draw = lambda v, size: jnp.asarray(rng.normal(0, size, v.shape))  # noqa: E731
    # With a turn and a shear of all, so that no constraint is determined by chance.
    moved = draw(points, 40.0) + 0.1 * jnp.roll(values.points, 1, axis=0)
    y = eop.at[:3].set(draw(eop[:3], 80.0)).at[3:].set(draw(eop[3:], 0.2)), shared, moved
    at = Linearised(type(zero_increments(s))(*y), unit_scale(s), values, s)
    before, after = (a.residuals() for a in (at, at._replace(increments=onto_datum(at))))
    assert np.abs(before.datum).min() > 1.0
    np.testing.assert_allclose(after.datum, 0.0, atol=1e-8)
    np.testing.assert_allclose(after.image, before.image, rtol=1e-7, atol=1e-7 * np.abs(before.image).max())
    for one, two in zip(before.others, after.others, strict=True):
        np.testing.assert_allclose(two, one, atol=1e-6)


def linearised(values, s, seed):
    """Far from the start: residuals of image points there are not small."""
    rng = np.random.default_rng(seed)
    draw = lambda v, size: jnp.asarray(rng.normal(0, size, v.shape))  # noqa: E731
    eop, shared, points = zero_increments(s)
    y = eop.at[:3].set(draw(eop[:3], 80.0)).at[3:].set(draw(eop[3:], 0.2)), shared, draw(points, 40.0)
    return Linearised(Increments(*y), unit_scale(s), values, s)


@pytest.mark.parametrize("kind", ["turn", "scale", "all"])
def test_a_step_along_a_motion_changes_no_image_coordinate_however_long_it_is(kind):
    values, s, _ = prepared(simulated("cross").block)
    at = linearised(values, s, 3)
    state = at.state
    centre, size = np.array([300.0, -200.0, 50.0]), 1000.0
    rng = np.random.default_rng(5)
    parameters = 0.7 * {"turn": np.eye(7)[3], "scale": np.eye(7)[6], "all": rng.normal(size=7)}[kind]

    def moved(parameters):
        image = lambda x, r: similarity(parameters, x, r, centre, size)  # noqa: E731
        x, r = jax.vmap(image, (1, 2), (1, 2))(state.position, state.rotation)
        turned = jax.vmap(lambda a, b: small_angles(a @ b.T), (2, 2), 1)(r, values.rotation)
        points = jax.vmap(lambda x: image(x, jnp.eye(3))[0], 1, 1)(state.points)
        return Increments(jnp.concatenate([x - values.position, turned]), at.increments.shared, points - values.points)

    step = jax.jvp(moved, (jnp.zeros(7),), (jnp.asarray(parameters),))[1]
    image = lambda y: at._replace(increments=y).residuals().image  # noqa: E731
    here = image(at.increments)
    largest = np.abs(here).max()
    weight = jax.tree.map(lambda v: jnp.asarray(rng.uniform(0.2, 1.0, v.shape)), step)
    np.testing.assert_allclose(image(after(at, step, weight)), here, atol=1e-7 * largest)
    if kind != "scale":
        # Added up, it bends the block.
        assert np.abs(image(jax.tree.map(jnp.add, at.increments, step)) - here).max() > 1e-3 * largest


def test_a_short_step_is_what_it_says():
    """To first order, in any metric, whatever is held."""
    values, s, _ = prepared(simulated("everything").block)
    at = linearised(values, s, 4)
    rng = np.random.default_rng(7)
    draw = lambda v: jnp.asarray(rng.uniform(0.1, 2.0, v.shape))  # noqa: E731
    free = Increments(jnp.asarray(s.eop_free), jnp.ones(s.n_shared), jnp.asarray(s.point_free))
    step, weight = (jax.tree.map(lambda v: draw(v) * v, free) for _ in range(2))
    found = jax.jvp(lambda t: after(at, jax.tree.map(lambda v: t * v, step), weight), (0.0,), (1.0,))[1]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), found, step)


def test_of_a_single_image_motions_are_not_independent():
    """Seven of them move six numbers, where all else is held."""
    values, s, _ = prepared(simulated("cross").block)
    eop, shared, points = unit_scale(s)
    at = Linearised(zero_increments(s), Increments(eop.at[:, 1:].set(0.0), shared, 0 * points), values, s)
    step = jax.tree.map(lambda scale: 1e-5 * scale, at.scale)
    found = after(at, step, jax.tree.map(jnp.ones_like, step))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=3e-7), found, step)


def turned(start, degrees):
    """Images and points turned as a whole about a slanted axis."""
    turn = np.asarray(small_rotation(np.radians(degrees) * np.array([0.6, -0.64, 0.48])))
    centre = start.points.mean(axis=0)
    exterior = dataclasses.replace(
        start.exterior,
        position=centre + (start.exterior.position - centre) @ turn.T,
        camera_from_object=start.exterior.camera_from_object @ turn.T,
    )
    points = centre + (start.points - centre) @ turn.T
    return eqx.tree_at(lambda u: (u.exterior, u.points), start, (exterior, points))


@pytest.mark.parametrize(("sigma_m", "degrees"), [(3.0, 20.0), (30.0, 20.0)])
def test_a_block_that_hardly_knows_how_it_lies_is_turned_as_a_whole(sigma_m, degrees):
    """Stations alone tell it, and badly: a turn along what they see would be judged by how it bends the images."""
    block, rng = free_network("inner"), np.random.default_rng(3)
    start = block.start.unknowns
    stations = np.asarray(start.exterior.position) + rng.normal(0, sigma_m, (len(block.images), 3))
    index = np.indices(stations.shape).reshape(2, -1)
    rows = CameraPositions(*index, stations.ravel(), np.full(stations.size, sigma_m))
    block = dataclasses.replace(block, datum=Datum("control"), stations=rows)
    near, far = adjust(block, start), adjust(block, turned(start, degrees))
    assert bool(far.converged)
    # 28 and more than 100 steps where increments are added up.
    assert int(far.steps) < 12
    assert float(far.sum_of_squares) == pytest.approx(float(near.sum_of_squares), rel=1e-9)


def test_motions_are_the_derivatives_of_a_similarity():
    rng = np.random.default_rng(5)
    position, points, centre, size = rng.normal(size=(3, 4)), rng.normal(size=(3, 6)), rng.normal(size=3), 2.5
    rotation = np.stack([small_rotation(theta) for theta in rng.normal(size=(4, 3))], axis=-1)
    found = motions(position, rotation, points, centre, size)
    assert isinstance(found.eop, np.ndarray)

    def image(parameters, k):
        place, turned = similarity(parameters, position[:, k], rotation[:, :, k], centre, size)
        return jnp.concatenate([place, small_angles(turned @ rotation[:, :, k].T)])

    for k in range(4):
        np.testing.assert_allclose(found.eop[:, :, k].T, jax.jacfwd(image)(jnp.zeros(7), k), atol=1e-14)
    for k in range(6):
        point = lambda p, k=k: similarity(p, points[:, k], jnp.eye(3), centre, size)[0]  # noqa: E731
        np.testing.assert_allclose(found.points[:, :, k].T, jax.jacfwd(point)(jnp.zeros(7)), atol=1e-14)


def test_a_network_turned_and_stretched_far_is_brought_back():
    """Newton's method alone would not find it from there."""
    values, s, _ = prepared(free_network("inner"))
    turn = np.asarray(small_rotation(np.array([1.0, -1.5, 0.8])))
    points = 3.0 * turn @ np.asarray(values.points) + 5000.0
    at = Linearised(zero_increments(s)._replace(points=jnp.asarray(points - values.points)), unit_scale(s), values, s)
    found = onto_datum(at)
    np.testing.assert_allclose(found.points, 0.0, atol=1e-6)


@pytest.mark.parametrize("name", ["inner_shift", "everything"])
def test_motions_that_depend_on_the_place_are_left_to_the_solver(name):
    values, s, _ = prepared(simulated(name).block)
    assert n_open_motions(values, s) == 0


def shape_of(adjusted):
    """Distances of points from the first, in units of one of them."""
    points = np.asarray(adjusted.unknowns.points)
    length = np.linalg.norm(points[1:] - points[0], axis=1)
    return length / length[0]


def test_a_free_network_is_found_from_afar():
    """Steps are rejected from there: the path goes on without the datum, and its end is brought to it."""
    block = free_network("inner")
    near = adjust(block)
    afar = from_afar(block, near.unknowns)
    points = afar.start.unknowns.points
    far = adjust(afar, afar.start.unknowns)
    assert bool(far.converged)
    # 20 with the constraints held all along, 12 as it is.
    assert int(far.steps) < 16
    assert float(far.sum_of_squares) == pytest.approx(float(near.sum_of_squares), rel=1e-9)
    np.testing.assert_allclose(shape_of(far), shape_of(near), rtol=1e-6)
    # The inner constraints over the points, about the start: no shift, no turn, no change of scale.
    moved, arm = far.unknowns.points - points, points - points.mean(axis=0)
    size = np.abs(moved).max()
    assert size > 100
    np.testing.assert_allclose(moved.mean(axis=0) / size, 0.0, atol=1e-9)
    np.testing.assert_allclose(np.cross(arm, moved).mean(axis=0) / np.abs(arm).max() / size, 0.0, atol=1e-9)
    np.testing.assert_allclose((arm * moved).mean() / np.abs(arm).max() / size, 0.0, atol=1e-9)
