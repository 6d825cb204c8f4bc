"""`jax.vmap` over the adjustment: it ends, and is a loop over adjustments."""

import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import adjust, covariance
from tests.adjustment.test_derivatives import STEPS, perturbed, readjusted, result
from tests.blocks import adjusted, simulated
from tests.marks import slow_but
from tests.programs import batched_in

REPOSITORY = Path(__file__).parents[2]
# More than are computed side by side, and no multiple of that.
DRAWS = 70


@pytest.fixture(scope="module", autouse=True)
def adjusted_before():
    """The nominal block is made and adjusted once, outside of what is traced below."""
    adjusted("cross")


@pytest.mark.slow
def test_two_thousand_draws_as_in_the_readme_end():
    """Batched calls of LAPACK would wait for each other, at any number of cores."""
    text = (REPOSITORY / "README.md").read_text()
    given, mapped = (
        next(code for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if word in code)
        for word in ("read_block", "jax.vmap(c_mm)")
    )
    mapped = mapped.replace("jax.jit(jax.grad(c_mm))(0.0)", "").replace(
        "jnp.array([-0.1, 0.0, 0.1])", "jnp.linspace(-0.3, 0.3, 2000)"
    )
    given = given.split("adjusted =")[0] + "adjusted = jaxphoto.adjust(block)\n"
    lines = mapped.rstrip().splitlines()
    code = "\n".join([given, "import jax, jax.numpy as jnp", *lines[:-1], f"print(len(set({lines[-1]}.tolist())))"])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, timeout=900, check=True, capture_output=True, text=True
    )
    assert int(done.stdout.split()[-1]) > 1990


def test_many_draws_are_each_at_their_own_optimum():
    """Draws that steps with the first one's factor lead there, and a blunder of a tenth of the format, which is far."""
    draws = np.random.default_rng(3).normal(size=(DRAWS, 4)) * [0.3, 0.004, 1e-10, 0.05]
    draws[40, 1] = 2.5
    together = np.asarray(jax.jit(jax.vmap(result))(draws))
    chosen = [0, 1, 39, 40, 41, DRAWS - 1]
    apart = np.stack([readjusted(draws[k]) for k in chosen])
    np.testing.assert_allclose(together[chosen], apart, atol=1e-6)
    assert np.abs(together[40] - together[39]).max() > 1


@pytest.mark.slow
@pytest.mark.parametrize("order", ("vmap of grad", "grad of vmap", "jvp of vmap"))
def test_derivatives_of_many_draws(order):
    """Each that of its own draw, at whose optimum differences are taken."""
    draws = np.array([[0.0, 0, 0, 0], [5.0, 0.01, 0, 0]])
    one = lambda p: result(p)[0]  # noqa: E731
    ways = {
        "vmap of grad": jax.vmap(jax.grad(one)),
        "grad of vmap": jax.grad(lambda p: jnp.sum(jax.vmap(one)(p))),
        "jvp of vmap": lambda p: jnp.stack(
            [jax.jvp(jax.vmap(one), (p,), (jnp.zeros_like(p).at[:, k].set(1.0),))[1] for k in range(4)], axis=1
        ),
    }
    program = jax.jit(ways[order]).lower(draws)
    assert not batched_in(program.as_text())
    found = np.asarray(program.compile()(draws))
    for p, gradient in zip(draws, found, strict=True):
        for k in (0, 3):
            at = {m: readjusted(p + m * STEPS[k] * np.eye(4)[k])[0] for m in (-2, -1, 1, 2)}
            expected = (at[-2] - 8 * at[-1] + 8 * at[1] - at[2]) / (12 * STEPS[k])
            assert gradient[k] == pytest.approx(expected, rel=1e-5)
    assert abs(found[0, 0] / found[1, 0] - 1) > 1e-4


@pytest.mark.slow
def test_draws_of_draws_and_a_loop_inside_a_program():
    draws = np.random.default_rng(3).normal(size=(3, 2, 4)) * [0.3, 0.004, 1e-10, 0.05]
    apart = np.stack([readjusted(p) for p in draws.reshape(6, 4)]).reshape(3, 2, -1)
    nested = jax.jit(jax.vmap(jax.vmap(result, 0), 1, 1))(draws)
    np.testing.assert_allclose(nested, apart, atol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda p: jax.lax.map(result, p))(draws[0]), apart[0], atol=1e-6)


@pytest.mark.slow
def test_who_varies_the_start_alone_sees_where_each_leads():
    """No start takes its optimum from another one."""
    block, start = perturbed(np.zeros(4))
    shifts = np.array([0.0, 5.0, 60.0])

    def outcome(shift):
        position = start.exterior.position + shift * jnp.cos(jnp.arange(30.0)).reshape(10, 3)
        found = adjust(block, eqx.tree_at(lambda u: u.exterior.position, start, position))
        return found.steps, found.unknowns.exterior.position

    steps, positions = jax.jit(jax.vmap(outcome))(shifts)
    assert steps[0] < steps[1] <= steps[2]
    np.testing.assert_allclose(positions[1:], np.stack([positions[0]] * 2), atol=1e-5)


@pytest.mark.parametrize("kind", slow_but(("inner",), ("inner", "cross", "everything")))
def test_covariances_of_many_draws_have_no_batched_lapack_call(kind):
    """Nor has the adjustment of a free network before them."""
    block, start = simulated(kind).block, adjusted(kind).unknowns

    def trace(error):
        xy = jnp.asarray(block.image_points.xy).at[0, 0].add(error)
        moved = eqx.tree_at(lambda b: b.image_points.xy, block, xy)
        return jnp.trace(covariance(adjust(moved, start)).matrix)

    assert not batched_in(jax.jit(jax.vmap(trace)).lower(np.zeros(3)).as_text())
