"""Derivatives through the whole adjustment: exact, against re-adjusted central differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import adjust
from tests.blocks import adjusted, simulated

STATION = 3 * 4 + 2  # Z of image i4
IMAGE_POINT = 40
# Steps of the differences: about one standard deviation of each observation.
STEPS = np.array([0.1, 0.004, 1e-10, 0.03])


@pytest.fixture(scope="module", autouse=True)
def adjusted_before():
    """The nominal block is made and adjusted once, outside of what is traced below."""
    adjusted("cross")


def perturbed(p):
    """The cross block with a station's height, an image coordinate, the fixed k3 and a control coordinate moved."""
    block = simulated("cross").block
    start = adjusted("cross").unknowns
    height = jnp.asarray(block.stations.value).at[STATION].add(p[0])
    xy = jnp.asarray(block.image_points.xy).at[IMAGE_POINT, 0].add(p[1])
    control = jnp.asarray(block.control.value).at[4].add(p[3])
    where = lambda b: (b.stations.value, b.image_points.xy, b.control.value)  # noqa: E731
    moved = eqx.tree_at(where, block, (height, xy, control))
    return moved, eqx.tree_at(lambda u: u.interior["one"].distortion.k3, start, p[2])


def outcomes(unknowns):
    """Principal distance, k1, a projection centre, a rotation, a point: all scaled to be of the order of one."""
    camera = unknowns.interior["one"]
    return jnp.stack(
        [
            camera.c,
            1e5 * camera.distortion.k1,
            unknowns.exterior.position[2, 0],
            1e3 * unknowns.exterior.camera_from_object[2, 0, 1],
            unknowns.points[7, 2],
        ]
    )


def result(p):
    block, start = perturbed(p)
    return outcomes(adjust(block, start).unknowns)


def readjusted(p):
    """As `result`, adjusted thrice in a row, so that nothing of the iteration is left."""
    block, start = jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, perturbed(p))
    for _ in range(3):
        start = adjust(block, start).unknowns
    return np.asarray(outcomes(start))


@pytest.fixture(scope="module")
def differences():
    """Fourth-order central differences, by parameter."""
    columns = []
    for k, step in enumerate(STEPS):
        at = {m: readjusted(m * step * np.eye(4)[k]) for m in (-2, -1, 1, 2)}
        columns.append((at[-2] - 8 * at[-1] + 8 * at[1] - at[2]) / (12 * step))
    return np.stack(columns, axis=1)


@pytest.mark.slow
def test_forward(differences):
    """Along a direction in which all four parameters count alike."""
    found = np.asarray(jax.jit(lambda p, d: jax.jvp(result, (p,), (d,))[1])(jnp.zeros(4), STEPS))
    expected = differences @ STEPS
    # Relative to the largest of the four parts, lest they cancel.
    size = np.abs(differences * STEPS).max(axis=1)
    assert (np.abs(found - expected) < 1e-6 * size).all(), (found, expected)


def test_principal_distance_by_station_height_backwards(differences):
    gradient = np.asarray(jax.jit(jax.grad(lambda p: result(p)[0]))(jnp.zeros(4)))
    np.testing.assert_allclose(gradient, differences[0], rtol=1e-6)
    assert abs(gradient[0]) > 1e-5


@pytest.mark.slow
def test_a_fixed_control_coordinate_moves_what_hangs_on_it():
    block, start = simulated("fixed_control").block, adjusted("fixed_control").unknowns

    def height(rise):
        value = jnp.asarray(block.fixed.value).at[2].add(rise)
        return adjust(eqx.tree_at(lambda b: b.fixed.value, block, value), start).unknowns.exterior.position[0, 2]

    def readjusted_height(rise: float) -> float:
        value = np.asarray(block.fixed.value) + rise * (np.arange(len(block.fixed.value)) == 2)
        return float(adjust(eqx.tree_at(lambda b: b.fixed.value, block, value), start).unknowns.exterior.position[0, 2])

    step = 0.02
    slope = float(jax.jvp(jax.jit(height), (0.0,), (1.0,))[1])
    difference = (readjusted_height(step) - readjusted_height(-step)) / (2 * step)
    assert slope == pytest.approx(difference, rel=1e-4)
    assert abs(slope) > 1e-3


@pytest.mark.slow
def test_derivatives_do_not_depend_on_the_start():
    """From rough start values as from the optimum, although everything is linearised somewhere."""
    block, near = simulated("cross").block, adjusted("cross").unknowns

    def outcome(rise, start):
        value = jnp.asarray(block.stations.value).at[STATION].add(rise)
        return outcomes(adjust(eqx.tree_at(lambda b: b.stations.value, block, value), start).unknowns)

    slope = jax.jit(lambda start: jax.jvp(lambda rise: outcome(rise, start), (0.0,), (1.0,))[1])
    far = np.asarray(slope(block.start.unknowns))
    np.testing.assert_allclose(far, np.asarray(slope(near)), rtol=1e-6)
