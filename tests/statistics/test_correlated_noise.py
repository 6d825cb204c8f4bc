"""Spatially correlated errors of image points: their sizes, and standard deviations that cover the truth."""

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import adjust, covariance
from jaxphoto.camera import get_parameter
from jaxphoto.statistics import correlated_noise
from tests.simulation.small import made


@pytest.fixture(scope="module")
def flight():
    """A block of 14 images, without noise."""
    return made({"points.ties": 250})


def disturbed(flight, rng, size, length, common):
    """Independent errors of 0.8 stated standard deviations, and a field with the exact covariance by Cholesky."""
    block = flight.block
    rows, (sensor,) = block.image_points, block.sensors.values()
    image, sigma = np.asarray(rows.image), np.asarray(rows.sigma)
    at = np.asarray(rows.xy) / max(sensor.width_mm, sensor.height_mm)
    errors = 0.8 * rng.normal(size=sigma.shape)
    for group in [np.arange(len(image))] if common else [np.flatnonzero(image == i) for i in np.unique(image)]:
        apart = np.sum((at[group, None] - at[group]) ** 2, axis=2)
        root = np.linalg.cholesky(np.exp(-apart / (2 * length**2)) + 1e-9 * np.eye(len(group)))
        errors[group] += size * root @ rng.normal(size=(len(group), 2))
    stations, control = (
        np.asarray(one.sigma) * rng.normal(size=one.sigma.shape) for one in (block.stations, block.control)
    )
    return eqx.tree_at(
        lambda b: (b.image_points.xy, b.stations.value, b.control.value),
        block,
        (rows.xy + sigma * errors, block.stations.value + stations, block.control.value + control),
    )


def test_independent_errors_keep_their_covariance(flight):
    adjusted = adjust(disturbed(flight, np.random.default_rng(1), 0.0, 1.0, False), flight.truth)
    found, stated = correlated_noise(adjusted), covariance(adjusted)
    n = 6 * stated.n_images
    np.testing.assert_allclose(found.independent, np.asarray(stated.matrix)[n:, n:], rtol=1e-6, atol=1e-30)
    assert found.size[0] == pytest.approx(0.8, rel=0.05) and found.size[1:].max() < 0.2
    # Control and stations, whose errors are as stated, are not scaled.
    assert all(0.9 < factor < 1.4 for factor in found.factors.values())
    wide = found.widened(stated)
    np.testing.assert_allclose(np.asarray(wide.shared_sigma) ** 2, np.diagonal(found.covariance), rtol=1e-9)
    np.testing.assert_allclose(wide.exterior_sigma, stated.exterior_sigma)


@pytest.mark.parametrize(
    ("size", "length", "common"), [(0.7, 1 / 10, False), (0.6, 1 / 6, True)], ids=["image", "camera"]
)
def test_standard_deviations_cover_the_truth(flight, size, length, common):
    rng, ratios, stated, sizes = np.random.default_rng(2), [], [], []
    (camera,) = flight.truth.interior
    for _ in range(40):
        adjusted = adjust(disturbed(flight, rng, size, length, common), flight.truth)
        found = correlated_noise(adjusted)
        names = [label.rpartition(".")[2] for label in found.labels if label.startswith("interior[")]
        pair = adjusted.unknowns.interior[camera], flight.truth.interior[camera]
        estimate, truth = (np.array([float(get_parameter(one, name)) for name in names]) for one in pair)
        error, n = estimate - truth, len(names)
        ratios.append(error / np.sqrt(np.diagonal(found.covariance)[:n]))
        stated.append(error / np.sqrt(np.diagonal(found.independent)[:n]))
        sizes.append(found.size**2)
    rms = np.sqrt(np.mean(np.square(ratios), axis=0))
    # Of 40 errors that are nearly independent the RMS has a standard deviation of 11 %.
    assert np.all((rms > 0.65) & (rms < 1.4)), rms
    assert 0.8 < np.sqrt(np.mean(rms**2)) < 1.2, rms
    assert np.sqrt(np.mean(np.square(stated))) > 1.5
    fields = np.mean(sizes, axis=0)[1:].reshape(2, -1).sum(axis=1)
    assert np.sqrt(fields[int(common)]) == pytest.approx(size, rel=0.25)
    assert np.sqrt(np.mean(sizes, axis=0)[0]) == pytest.approx(0.8, rel=0.05)
