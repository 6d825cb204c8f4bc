"""What the images tell of their camera: rays that err alike count for less."""

import dataclasses

import numpy as np
import pytest

from jaxphoto.block import ImageRows
from jaxphoto.camera import Sensor
from jaxphoto.io import read_block
from jaxphoto.procedures.orientation.finish import erring_alike

N_IMAGES, PER_IMAGE = 9, 800


@pytest.fixture(scope="module")
def block():
    """Nine images of 8 x 6 square cells, with rays all over them."""
    rng = np.random.default_rng(1)
    block = read_block("examples/cross_block")
    assert len(block.images) >= N_IMAGES
    image = np.repeat(np.arange(N_IMAGES), PER_IMAGE)
    xy = rng.uniform([-4, -3], [4, 3], (len(image), 2))
    rows = ImageRows(image, np.zeros(len(image), int), xy, np.ones((len(image), 2)))
    camera = block.image_camera[0]
    return dataclasses.replace(block, image_points=rows, sensors={camera: Sensor(1600, 1200, 0.005)})


def test_independent_residuals_keep_their_standard_deviations(block):
    rng = np.random.default_rng(2)
    for _ in range(10):
        assert 1 <= erring_alike(block, rng.normal(size=(2, N_IMAGES * PER_IMAGE))) < 1.1


@pytest.mark.parametrize("part", [0.1, 0.5, 1.0])
def test_what_cells_have_in_common_counts_once(block, part):
    """The sigma of a mean over all rays, by many draws, is what the design effect of one draw says."""
    rng, rows = np.random.default_rng(3), block.image_points
    cell = rows.image * 48 + np.floor(np.asarray(rows.xy) + np.array([4, 3])).astype(int) @ [6, 1]
    found, means = [], []
    for _ in range(300):
        v = np.sqrt(part) * rng.normal(size=(2, N_IMAGES * 48))[:, cell]
        v += np.sqrt(1 - part) * rng.normal(size=v.shape)
        found.append(erring_alike(block, v))
        means.append(v.mean(axis=1))
    independent = 1 / np.sqrt(N_IMAGES * PER_IMAGE)
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(np.std(means) / independent, rel=0.1)
    assert np.std(found) < 0.05 * np.mean(found)
