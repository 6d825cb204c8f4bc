"""Projection uncertainty compared with its definition by the full covariance, and error messages."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import InputError, covariance
from jaxphoto.camera import get_parameter, set_parameter
from jaxphoto.rotation import small_rotation
from jaxphoto.statistics.sigma_map import seen_distance_m, sigma_map
from tests.blocks import adjusted

PLACES = np.array([[0.0, 0.0], [14.0, -9.0], [-16.0, 10.0]])


@functools.partial(jax.jit, static_argnames="distance_m")
def projected(camera, parameters, turns, shifts, rotations, positions, distance_m):
    """Image coordinates at PLACES of a camera with other `parameters`, after rotations and shifts of its images.

    Each image transforms the point to the object frame as adjusted, and back with the errors; the mean is projected.
    """
    changed, finite = camera, float(np.isfinite(distance_m))
    for name, value in zip(PARAMETERS, parameters, strict=True):
        changed = set_parameter(changed, name, value)

    def at(xy):
        ray = jnp.stack(camera.direction_from_ideal(camera.ideal_from_measured(xy)))
        p = ray / jnp.linalg.norm(ray) * (distance_m if finite else 1.0)
        points = [r.T @ p + finite * x for r, x in zip(rotations, positions, strict=True)]
        back = [
            small_rotation(turn) @ r @ (point - finite * (x + shift))
            for point, r, x, turn, shift in zip(points, rotations, positions, turns, shifts, strict=True)
        ]
        return changed.measured_from_ideal(changed.ideal_from_direction(*(sum(back) / len(back))))

    return jnp.stack([at(xy) for xy in PLACES])


PARAMETERS = ("c_mm", "xp_mm", "yp_mm", "k1", "k2")


@pytest.mark.parametrize("distance_m", [np.inf, 900.0])
def test_it_is_what_the_whole_covariance_says(distance_m):
    """Covariance of all images and the camera, propagated by finite differences of the definition."""
    result = adjusted("cross")
    cov, n = covariance(result, "camera"), len(result.block.images)
    places = [cov.labels.index(f"interior[one].{name}") for name in PARAMETERS]
    index = [*range(6 * n), *places]
    q = np.asarray(cov.matrix)[np.ix_(index, index)] * float(cov.variance_factor)
    camera, exterior = result.unknowns.interior["one"], result.unknowns.exterior
    nominal = np.array([float(get_parameter(camera, name)) for name in PARAMETERS])
    images = tuple(exterior.camera_from_object), tuple(exterior.position)

    # Along the principal axes of the errors, by one standard deviation each.
    sizes, axes = np.linalg.eigh(q / np.outer(sigma := np.sqrt(np.diagonal(q)), sigma))
    total = np.zeros((len(PLACES), 2, 2))
    chosen = sizes > 1e-12 * sizes.max()
    for size, axis in zip(sizes[chosen], axes.T[chosen], strict=True):
        step = np.sqrt(size) * axis * sigma
        ends = []
        for side in (1.0, -1.0):
            e = side * step[: 6 * n].reshape(n, 6)
            ends.append(
                projected(camera, nominal + side * step[6 * n :], tuple(e[:, 3:]), tuple(e[:, :3]), *images, distance_m)
            )
        d = np.asarray(ends[0] - ends[1]) / 2
        total += d[:, :, None] * d[:, None, :]
    computed = sigma_map(result, points=PLACES, distance_m=distance_m)
    np.testing.assert_allclose(computed.covariance, total, rtol=1e-4, atol=1e-5 * total.max())
    np.testing.assert_allclose(computed.worst, np.sqrt(np.linalg.eigvalsh(total)[:, -1]), rtol=1e-4)


def test_what_matters_at_the_distance_flown_is_less_than_at_infinity():
    """A longer c is a greater flying height: at the flown distance both cancel, for a direction only c remains."""
    result = adjusted("cross")
    flown = seen_distance_m(result)
    assert 800 < flown < 1200
    corner = np.array([[17.0, 11.0]])
    assert sigma_map(result, points=corner, distance_m=flown).worst < sigma_map(result, points=corner).worst


def test_cells_go_from_edge_to_edge_and_are_60_by_40():
    result = sigma_map(adjusted("cross"))
    sensor = adjusted("cross").block.sensors["one"]
    assert len(result.points) == 2400 and len(np.unique(result.points[:, 0])) == 60
    np.testing.assert_allclose(np.abs(result.points).max(axis=0), [sensor.width_mm / 2, sensor.height_mm / 2])


def test_what_it_cannot_tell_is_said():
    result = adjusted("cross")
    with pytest.raises(InputError, match="unknown camera two: the block has one"):
        sigma_map(result, "two")
    with pytest.raises(InputError, match="distance_m must be positive, got -3"):
        sigma_map(result, distance_m=-3.0)
    not_invertible = eqx.tree_at(lambda a: a.unknowns.interior["one"].distortion.k1, result, np.array(1e-3))
    corner = sigma_map(not_invertible, points=np.array([[0.0, 0.0], [17.0, 11.0]]))
    assert np.isfinite(corner.worst[0]) and np.isnan(corner.worst[1])
