"""The shared property of every model: forward = reverse = numerical derivative, at random and at degenerate points."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxphoto.compiling.fast_compilation import jit_quickly

# Fourth-order central differences: their error is about 30 step^4 of the fifth derivative, plus 1e-16 / step.
_STEP = 1e-3
_TIMES, _WEIGHTS = np.array([-2.0, -1.0, 1.0, 2.0]), np.array([1.0, -8.0, 8.0, -1.0]) / 12


@functools.cache
def _three_ways(fn):
    def of_one_case(args):
        vector, back = ravel_pytree(args)

        def flat(v):
            return ravel_pytree(fn(*back(v)))[0]

        # One trace for all evaluations: what costs here is tracing and compiling.
        moved = vector + _STEP * _TIMES[:, None, None] * jnp.eye(len(vector))
        values = jax.vmap(flat)(moved.reshape(-1, len(vector))).reshape(*moved.shape[:2], -1)
        numerical = jnp.tensordot(_WEIGHTS / _STEP, values, axes=1).T
        forward, value = jax.jacfwd(lambda v: (flat(v),) * 2, has_aux=True)(vector)
        return value, forward, jax.jacrev(flat)(vector), numerical

    # One case after the other: to map them at once is another layer of every trace, a third of the time.
    return jit_quickly(lambda *args: jax.lax.map(of_one_case, args))


def compiled(fn):
    """`fn` compiled quickly, from and to NumPy: eager JAX would compile every single operation of a test."""
    jitted = jit_quickly(fn)

    def call(*args):
        arrays = [np.asarray(a, float) if type(a) in (list, tuple, float, int) else a for a in args]
        return jax.tree.map(np.asarray, jitted(*arrays))

    return call


def check_derivatives(fn, *args, rtol: float = 1e-6) -> None:
    """Check `fn` at every case: each argument is an array (or tree of arrays) with a leading axis over the cases.

    Write `fn` so that its arguments and values are of the order of one (`1e-4 * k1`, not `k1`), and define it once:
    it is compiled once per function and shape. The difference is measured against the largest entry of the case.
    """
    args = jax.tree.map(lambda leaf: np.asarray(leaf, float), args)
    value, forward, reverse, numerical = (np.asarray(v) for v in _three_ways(fn)(*args))
    assert np.isfinite(value).all(), "the value itself is not finite"
    assert np.isfinite(forward).all() and np.isfinite(reverse).all(), "a derivative is not finite"
    scale = np.abs(numerical).max(axis=(1, 2), keepdims=True)
    assert (scale > 1e-12).all(), "nothing depends on anything here: the check would pass for any derivative"
    np.testing.assert_array_less(np.abs(forward - reverse) / scale, 1e-9)
    np.testing.assert_array_less(np.abs(forward - numerical) / scale, rtol)
