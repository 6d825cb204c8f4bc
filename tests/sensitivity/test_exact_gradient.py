"""`jax.grad` through an adjustment and its statistics, inside `jit` and `vmap`."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import adjust, covariance
from tests.blocks import adjusted

STATION = 14


def scalar(result):
    """Of unknowns, residuals, sigma naught and standard deviations; each part counts."""
    cov = covariance(result)
    sigmas = 100 * cov.shared_sigma[0] + 10 * cov.exterior_sigma[2, 4] + cov.point_sigma[3, 2]
    return result.sigma0 + result.residuals["control_points"][3] + result.unknowns.interior["one"].c + sigmas


def with_station(height, unknowns):
    """The cross block adjusted with the height of one station moved (m)."""
    block = adjusted("cross").block
    move = height * (np.arange(len(block.stations.value)) == STATION)
    return adjust(eqx.tree_at(lambda b: b.stations.value, block, block.stations.value + move), unknowns)


@pytest.mark.slow
def test_gradient_of_statistics_in_jit_and_vmap() -> None:
    start = adjusted("cross").unknowns
    heights = np.array([0.0, 0.2])
    gradient = jax.jit(jax.vmap(jax.grad(lambda h: scalar(with_station(h, start)))))
    found = np.asarray(gradient(jnp.asarray(heights)))

    def readjusted(height: float) -> float:
        unknowns = start
        for _ in range(3):
            result = with_station(height, unknowns)
            unknowns = result.unknowns
        return float(scalar(result))

    step = 0.05
    weights = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
    for k, height in enumerate(heights):
        slope = sum(w * readjusted(height + m * step) for m, w in weights.items()) / (12 * step)
        assert found[k] == pytest.approx(slope, rel=1e-6)


def test_statistics_of_a_batch_are_asked_for_inside() -> None:
    nominal = adjusted("cross")
    values = jax.tree.map(lambda v: np.stack([v, v]), nominal.padded_values)
    with pytest.raises(ValueError, match="inside the function that jax"):
        _ = dataclasses.replace(nominal, padded_values=values, factored=None).equations
