"""One photograph that is there twice is told, and one that sees the same points is none."""

import dataclasses

import numpy as np

from jaxphoto.report.verdict import duplicate_findings, duplicate_images
from tests.blocks import simulated


def test_an_image_that_has_the_measurements_of_another_is_told():
    block = simulated("cross").block
    assert duplicate_images(block) == []
    rows = block.image_points
    xy = np.array(rows.xy)
    n = 0
    for k in np.flatnonzero(rows.image == 1):
        for other in np.flatnonzero((rows.image == 0) & (rows.point == rows.point[k])):
            xy[k] = xy[other]
            n += 1
    doubled = block.with_observations({"image_points": dataclasses.replace(rows, xy=xy)})
    assert duplicate_images(doubled) == [(*sorted(block.images[:2]), n)]
    (finding,) = duplicate_findings(doubled)
    assert finding.value == n
    # Written with fewer digits, it is the same photograph; measured anew, it is another observation.
    rng, sigma, mine = np.random.default_rng(3), np.asarray(rows.sigma), (rows.image == 1)[:, None]
    for part, told in ((0.05, True), (1.0, False)):
        moved = xy + mine * part * sigma * rng.uniform(-1, 1, xy.shape)
        again = block.with_observations({"image_points": dataclasses.replace(rows, xy=moved)})
        assert bool(duplicate_images(again)) == told
