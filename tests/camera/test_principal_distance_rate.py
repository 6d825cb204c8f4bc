"""A principal distance that changes in time: simulated, recovered, and in files."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import FREE, ExteriorOrientation, Outcome, adjust, covariance, project
from jaxphoto.camera import PrincipalDistanceRate
from jaxphoto.io import read_block, write_block
from tests.blocks import BROWN, simulated

RATE = 0.01


@pytest.fixture(scope="module")
def warming():
    """Images of a camera whose c grows by 10 micrometres a second, over 14 s; stations tell it from heights."""
    block, truth = simulated("cross")
    rows, time = block.image_points, np.linspace(-7.0, 7.0, len(block.images))
    exterior, points = jax.tree.map(jnp.asarray, (truth.exterior, truth.points))

    def measured(c, image, point):
        camera = dataclasses.replace(truth.interior["one"], c=c)
        own = ExteriorOrientation(exterior.position[image], exterior.camera_from_object[image])
        return project(camera, own, points[point])

    c = truth.interior["one"].c
    at = jax.jit(jax.vmap(measured))
    moved = at(c + RATE * time[rows.image], rows.image, rows.point) - at(
        np.full(len(rows.image), c), rows.image, rows.point
    )
    start = dataclasses.replace(block.start.unknowns, more={"c_rates": {"one": PrincipalDistanceRate(0.0)}})
    return dataclasses.replace(
        block,
        image_time=time,
        image_points=dataclasses.replace(rows, xy=np.asarray(rows.xy) + np.asarray(moved)),
        start=dataclasses.replace(block.start, unknowns=start),
        priors=dataclasses.replace(block.priors, more={"c_rates": {"one": PrincipalDistanceRate(FREE)}}),
    )


def test_it_changes_c_alone():
    class Exposure:
        in_flight = 5.0

    bent = PrincipalDistanceRate(0.2).interior(BROWN, Exposure)
    assert float(bent.c) == pytest.approx(float(BROWN.c) + 1.0, abs=1e-12)
    assert dataclasses.replace(bent, c=BROWN.c) == BROWN


def test_the_rate_is_recovered(warming):
    found = adjust(warming)
    assert found.outcome is Outcome.CONVERGED
    sigma = dict(zip(found.structure.labels, np.asarray(covariance(found).shared_sigma), strict=True))
    own = sigma["c_rates[one].c_rate_mm_per_s"]
    rate, c = float(found.unknowns.more["c_rates"]["one"].rate), float(found.unknowns.interior["one"].c)
    assert abs(rate - RATE) < 3 * own < 0.3 * RATE
    assert abs(c - float(BROWN.c)) < 3 * sigma["interior[one].c_mm"]
    assert 0.9 < found.sigma0 < 1.1


def test_without_the_rate_the_block_does_not_fit(warming):
    still = dataclasses.replace(
        warming,
        start=dataclasses.replace(warming.start, unknowns=dataclasses.replace(warming.start.unknowns, more={})),
        priors=dataclasses.replace(warming.priors, more={}),
    )
    assert adjust(still).sigma0 > 1.2


def test_it_comes_back_from_a_block_folder(warming, tmp_path):
    write_block(warming, tmp_path / "block")
    again = read_block(tmp_path / "block")
    assert again.priors.more == warming.priors.more
    assert float(again.start.unknowns.more["c_rates"]["one"].rate) == 0.0
