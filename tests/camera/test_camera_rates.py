"""A camera that changes in time: simulated, recovered, and in files."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import FIXED, FREE, ExteriorOrientation, Outcome, RankError, adjust, covariance, project
from jaxphoto.block import exposures
from jaxphoto.camera import Balanced, CameraRates
from jaxphoto.collinearity import image_residual
from jaxphoto.georeferencing import Exposure
from jaxphoto.io import read_block, write_block
from tests.blocks import BROWN, simulated
from tests.derivatives import check_derivatives

TRUE = CameraRates(0.06, -0.14, 0.2, -3e-5)
"""An hour; large ones, so that a small block shows them."""
NAMES = {"c_rate": "c_rate_mm_per_h", "xp_rate": "xp_rate_mm_per_h", "yp_rate": "yp_rate_mm_per_h",
         "k1_rate": "k1_rate_per_h"}  # fmt: skip


def at(seconds) -> Exposure:
    return Exposure(0.0, np.zeros(3), np.zeros(3), flight_time=seconds)


def with_rates(block, priors: CameraRates):
    start = dataclasses.replace(block.start.unknowns, more={"camera_rates": {"one": CameraRates(*np.zeros(4))}})
    return dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=start),
        priors=dataclasses.replace(block.priors, more={"camera_rates": {"one": priors}}),
    )


@functools.cache
def changing_block(true=TRUE):
    """Images of a camera that changes over an hour; stations tell it from heights, two directions from shifts."""
    block, truth = simulated("cross")
    rows, seconds = block.image_points, np.linspace(-1800.0, 1800.0, len(block.images))
    exterior, points = jax.tree.map(jnp.asarray, (truth.exterior, truth.points))
    camera = jax.tree.map(jnp.asarray, truth.interior["one"])

    @jax.jit
    @jax.vmap
    def moved(seconds, image, point):
        own = ExteriorOrientation(exterior.position[image], exterior.camera_from_object[image])
        changed = true.interior(camera, at(seconds))
        return project(changed, own, points[point]) - project(camera, own, points[point])

    xy = np.asarray(rows.xy) + np.asarray(moved(seconds[rows.image], rows.image, rows.point))
    block = dataclasses.replace(block, flight_time=seconds, image_points=dataclasses.replace(rows, xy=xy))
    return with_rates(block, CameraRates(FREE, FREE, FREE, FREE))


@pytest.fixture
def changing():
    return changing_block()


def test_each_rate_changes_its_own_parameter():
    half_an_hour = TRUE.interior(BROWN, at(1800.0))
    for name, rate in (("c", 0.06), ("xp", -0.14), ("yp", 0.2)):
        assert float(getattr(half_an_hour, name)) == pytest.approx(float(getattr(BROWN, name)) + rate / 2, abs=1e-12)
    assert float(half_an_hour.distortion.k1) == pytest.approx(float(BROWN.distortion.k1) - 1.5e-5, abs=1e-15)
    assert half_an_hour.distortion.k2 == BROWN.distortion.k2
    other = dataclasses.replace(BROWN, distortion=Balanced())
    assert TRUE.interior(other, at(1800.0)).distortion == other.distortion


def test_derivatives():
    camera = jax.tree.map(jnp.asarray, BROWN)
    level = ExteriorOrientation(jnp.zeros(3), jnp.eye(3))

    def residual(rates, hours, point, xy):
        own = CameraRates(*rates[:3], 1e-4 * rates[3])
        return image_residual(own.interior(camera, at(3600.0 * hours)), level, point + jnp.array([0, 0, -4.0]), xy)

    rng = np.random.default_rng(2)
    check_derivatives(
        residual, rng.normal(size=(3, 4)), np.array([0.5, -0.5, 0.3]), rng.normal(size=(3, 3)),
        5 * rng.normal(size=(3, 2)),
    )  # fmt: skip


def test_the_rates_are_recovered(changing):
    found = adjust(changing)
    assert found.outcome is Outcome.CONVERGED
    assert 0.9 < found.sigma0 < 1.1
    sigma = dict(zip(found.structure.labels, np.asarray(covariance(found).shared_sigma), strict=True))
    own = found.unknowns.more["camera_rates"]["one"]
    for field, label in NAMES.items():
        true, known = getattr(TRUE, field), sigma[f"camera_rates[one].{label}"]
        assert abs(float(getattr(own, field)) - true) < 3 * known < 0.7 * abs(true), field
    assert abs(float(found.unknowns.interior["one"].c) - float(BROWN.c)) < 3 * sigma["interior[one].c_mm"]


def test_without_the_rates_the_block_does_not_fit(changing):
    assert adjust(with_rates(changing, CameraRates(FIXED, FIXED, FIXED, FIXED))).sigma0 > 1.2


def test_they_come_back_from_a_block_folder(changing, tmp_path):
    write_block(changing, tmp_path / "block")
    again = read_block(tmp_path / "block")
    assert again.priors.more == changing.priors.more
    np.testing.assert_allclose(exposures(again).in_flight, changing.flight_time, rtol=1e-12)
    assert all(float(v) == 0.0 for v in jax.tree.leaves(again.start.unknowns.more))


def test_rates_that_nothing_can_show_are_refused(changing):
    still = dataclasses.replace(changing, flight_time=np.zeros(len(changing.images)))
    with pytest.raises(RankError, match=r"camera_rates\[one\]\.c_rate is free, but all images .* have one time"):
        adjust(still)
    other = lambda tree, zero: {"one": dataclasses.replace(tree["one"], distortion=Balanced(*[zero] * 6))}  # noqa: E731
    start = dataclasses.replace(changing.start.unknowns, interior=other(changing.start.unknowns.interior, 0.0))
    with pytest.raises(RankError, match="k1_rate is free, but the distortion balanced has no k1"):
        adjust(changing, start, dataclasses.replace(changing.priors, interior=other(changing.priors.interior, FIXED)))
