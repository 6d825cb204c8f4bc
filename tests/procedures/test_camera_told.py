"""What the images tell of their camera: rays that err alike count for less, the rest is what was known beforehand."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from jaxphoto.camera import InteriorOrientation
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.orientation import orient
from tests.marks import slow_but
from tests.procedures.orientable import PIXEL, SENSOR, Camera, aerial, errors_with_covariance, photographed, projected

pytest.importorskip("pycolmap", reason="pycolmap, which orients images, is not installed (extra photos)")

# So little noise that differences of second order are small: over flat ground small tilts, and what makes up for them,
# are known badly, and at 0.4 px errors of stations are 1.3 times what a linear model says.
START, NOISE_PX = InteriorOrientation(8.0), 0.1


def drawn(seed):
    """A camera such as may be where `START` is said."""
    c, x_p, y_p, k1 = np.random.default_rng(seed).normal(size=4)
    return Camera(8.0 * (1 + 0.1 * c), 0.15 * x_p, 0.15 * y_p, 1.2e-3 * k1, 0.0)


def flown(seed, camera):
    """A scene of flat ground under nearly vertical images, its photographs, and these oriented."""
    scene = aerial(per_strip=3, across=0.5, relief=0.0, tilt=0.01, per_image=100, seed=seed)
    p = photographed(scene, camera, NOISE_PX, seed=seed, clutter=0)
    sigmas = [np.full(len(xy), NOISE_PX * PIXEL) for xy in p.features]
    return scene, p, orient(p.names, SENSOR, START, p.features, p.matches, sigmas)


def over_sigmas(adjusted, scene, camera):
    errors, matrix = errors_with_covariance(adjusted, scene, camera)
    return errors / np.sqrt(np.diagonal(matrix))


def check_scatter(ratios):
    """`ratios` (draws, ...) of errors over standard deviations: of six by image, then of c, x_p, y_p."""
    by_image, of_camera = ratios[:, :-3].reshape(len(ratios), -1, 6), ratios[:, -3:]
    squares = np.concatenate([np.mean(by_image**2, axis=(0, 1)), np.mean(of_camera**2, axis=0)])
    # Of n independent squares; those of an image hang together.
    assert np.abs(squares - 1).max() < 3.5 * np.sqrt(2 / len(ratios)), squares
    assert all(stats.kstest(values, "norm").pvalue > 1e-3 for values in of_camera.T)


@pytest.mark.parametrize("draws", slow_but([30], [30, 100]))
def test_errors_are_those_that_a_block_with_observed_parameters_announces(draws):
    """Flights by cameras drawn from what the block says of c, adjusted by it."""
    scene, p, oriented = flown(3, Camera(8.0, 0.0, 0.0, 0.0, 0.0))
    block = oriented.block
    assert "c_mm" not in oriented.report.estimated
    where = [{tuple(xy): k for xy, k in zip(*v, strict=True)} for v in zip(p.features, p.point_of, strict=True)]
    order = [p.names.index(name) for name in block.images]
    rows = block.image_points
    true = np.array([where[order[i]][tuple(xy)] for i, xy in zip(rows.image, rows.xy, strict=True)])
    ratios = []
    for seed in range(draws):
        camera = drawn(seed)
        xy = NOISE_PX * PIXEL * np.random.default_rng(1000 + seed).normal(size=rows.xy.shape)
        for k, image in enumerate(order):
            own = rows.image == k
            xy[own] += projected(scene, camera, image, scene.points[true[own]])[0]
        again = dataclasses.replace(block, image_points=dataclasses.replace(rows, xy=xy))
        adjusted = adjust(again, max_steps=300)
        ratios.append(over_sigmas(adjusted, scene, camera))
    check_scatter(np.array(ratios))
