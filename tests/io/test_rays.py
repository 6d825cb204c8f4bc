"""How well photographs fit their rays."""

import numpy as np

from jaxphoto.extras.formats.texts import ray_misfit


def test_parallel_rays_of_a_row_that_is_repeated_have_a_misfit():
    # Found among spoilt files: the sum of so many of these rays is singular to the last digit.
    number = 594
    rays, first = np.tile([-0.9, 0.5, 1.5], (number, 1)), np.zeros(number, int)
    assert np.isfinite(ray_misfit(np.zeros((1, 3)), np.eye(3)[None], rays, first, first))
