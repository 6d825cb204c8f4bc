"""The sigma map against its definition, spelled out with the whole covariance, and what it refuses."""

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
def seen_by(camera, parameters, turns, shifts, turned, positions, distance_m):
    """Where the points at PLACES are seen by a camera with other `parameters`, after the images were turned and moved.

    Each image has the point in the object frame, as it was, and takes it back as it is now; the mean is projected.
    """
    now, here = camera, float(np.isfinite(distance_m))
    for name, value in zip(OWN, parameters, strict=True):
        now = set_parameter(now, name, value)

    def at(xy):
        ray = jnp.stack(camera.direction_from_ideal(camera.ideal_from_measured(xy)))
        p = ray / jnp.linalg.norm(ray) * (distance_m if here else 1.0)
        there = [r.T @ p + here * x for r, x in zip(turned, positions, strict=True)]
        back = [
            small_rotation(turn) @ r @ (point - here * (x + shift))
            for point, r, x, turn, shift in zip(there, turned, positions, turns, shifts, strict=True)
        ]
        return now.measured_from_ideal(now.ideal_from_direction(*(sum(back) / len(back))))

    return jnp.stack([at(xy) for xy in PLACES])


OWN = ("c_mm", "xp_mm", "yp_mm", "k1", "k2")


@pytest.mark.parametrize("distance_m", [np.inf, 900.0])
def test_it_is_what_the_whole_covariance_says(distance_m):
    """Of all images and the camera, by differences of the definition, spelled out."""
    found = adjusted("cross")
    known, n = covariance(found, "camera"), len(found.block.images)
    places = [known.labels.index(f"interior[one].{name}") for name in OWN]
    kept = [*range(6 * n), *places]
    q = np.asarray(known.matrix)[np.ix_(kept, kept)] * float(known.variance_factor)
    camera, exterior = found.unknowns.interior["one"], found.unknowns.exterior
    nominal = np.array([float(get_parameter(camera, name)) for name in OWN])
    images = tuple(exterior.camera_from_object), tuple(exterior.position)

    # Along the principal axes of the errors, each by its standard deviation.
    sizes, axes = np.linalg.eigh(q / np.outer(sigma := np.sqrt(np.diagonal(q)), sigma))
    total = np.zeros((len(PLACES), 2, 2))
    chosen = sizes > 1e-12 * sizes.max()
    for size, axis in zip(sizes[chosen], axes.T[chosen], strict=True):
        step = np.sqrt(size) * axis * sigma
        moved = []
        for side in (1.0, -1.0):
            e = side * step[: 6 * n].reshape(n, 6)
            moved.append(
                seen_by(camera, nominal + side * step[6 * n :], tuple(e[:, 3:]), tuple(e[:, :3]), *images, distance_m)
            )
        d = np.asarray(moved[0] - moved[1]) / 2
        total += d[:, :, None] * d[:, None, :]
    said = sigma_map(found, points=PLACES, distance_m=distance_m)
    np.testing.assert_allclose(said.covariance, total, rtol=1e-4, atol=1e-5 * total.max())
    np.testing.assert_allclose(said.worst, np.sqrt(np.linalg.eigvalsh(total)[:, -1]), rtol=1e-4)


def test_what_matters_at_the_distance_flown_is_less_than_at_infinity():
    """A longer c is a higher flight: at the flown distance both cancel, for a direction only c is left."""
    found = adjusted("cross")
    flown = seen_distance_m(found)
    assert 800 < flown < 1200
    corner = np.array([[17.0, 11.0]])
    assert sigma_map(found, points=corner, distance_m=flown).worst < sigma_map(found, points=corner).worst


def test_cells_go_from_edge_to_edge_and_are_60_by_40():
    found = sigma_map(adjusted("cross"))
    sensor = adjusted("cross").block.sensors["one"]
    assert len(found.points) == 2400 and len(np.unique(found.points[:, 0])) == 60
    np.testing.assert_allclose(np.abs(found.points).max(axis=0), [sensor.width_mm / 2, sensor.height_mm / 2])


def test_what_it_cannot_tell_is_said():
    found = adjusted("cross")
    with pytest.raises(InputError, match="there is no camera two: the block has one"):
        sigma_map(found, "two")
    with pytest.raises(InputError, match="so it is positive, got -3"):
        sigma_map(found, distance_m=-3.0)
    folds = eqx.tree_at(lambda a: a.unknowns.interior["one"].distortion.k1, found, np.array(1e-3))
    corner = sigma_map(folds, points=np.array([[0.0, 0.0], [17.0, 11.0]]))
    assert np.isfinite(corner.worst[0]) and np.isnan(corner.worst[1])
