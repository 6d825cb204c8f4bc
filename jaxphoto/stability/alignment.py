"""Aligning two bundles of rays: what remains between them on the virtual image plane of the first.

With the rays (x1, -c1) and (x2, -c2) of the same measured image points, in mm, the offsets v are

    zrot   v = x1 - x2 c1 / c2                                              both axes as they are
    rot    v = x1 + c1 w_xy / w_z,   w = R (x2, -c2)                        second bundle turned, v'v least
    spr    v = -c1 q_xy / q_z - x2 c1 / c2,   q = R (P - X0)                second bundle resected, v'v least

where P = d (x1, -c1) / c1 are object points on the first bundle's rays, at depths d. Bundles that differ by what the
method leaves free are the same to the camera's user: nothing where position and attitude are observed and the camera
is fixed to them (zrot), the attitude where positions are observed (rot), both in indirect georeferencing (spr).
Source: Habib, Pullivelli, Mitishita, Ghanma and Kim, Photogrammetric Record 21 (2006), 29-43.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.linear_algebra import solve
from jaxphoto.rotation import small_rotation

Method = Literal["zrot", "rot", "spr"]
METHODS: tuple[Method, ...] = ("zrot", "rot", "spr")
UNKNOWNS: dict[Method, int] = {"zrot": 0, "rot": 3, "spr": 6}
"""Unknowns u of the alignment: three angles (rad), then the position in units of the object's distance."""
ALIGNED: dict[Method, str] = {
    "zrot": "as they lie in the camera",
    "rot": "turned onto one another",
    "spr": "turned and moved onto one another",
}
"""How bundles lie when they are compared, in words."""

# Gauss-Newton steps at most; bundles of one camera need 3 to 6.
_STEPS = 50
_SMALL = 1e-13
# Cosine of the offsets and their derivatives at an optimum, but for rounding.
_FLAT = 1e-9


def offsets_of(
    alignment: Float[Array, "u"],
    first: Float[Array, "points 3"],
    second: Float[Array, "points 3"],
    depth: Float[Array, "points"],
    method: Method,
) -> Float[Array, "points 2"]:
    """Offsets v (mm) of two bundles under an alignment of `UNKNOWNS` numbers; formulas at the top of this file."""
    c1, c2 = -first[0, 2], -second[0, 2]
    if method == "zrot":
        return first[:, :2] - second[:, :2] * (c1 / c2)
    if method == "rot":
        w = second @ small_rotation(alignment).T
        return first[:, :2] + c1 * w[:, :2] / w[:, 2:]
    q = (first * (depth / c1)[:, None] - alignment[3:]) @ small_rotation(alignment[:3]).T
    return -c1 * q[:, :2] / q[:, 2:] - second[:, :2] * (c1 / c2)


def align(
    first: Float[Array, "points 3"], second: Float[Array, "points 3"], depth: Float[Array, "points"], method: Method
) -> tuple[Float[Array, "u"], Bool[Array, ""]]:
    """The alignment of least v'v, and whether it was found.

    Gauss-Newton from the bundles as they are. Derivatives, to any order, are those of the optimum itself, by the
    implicit function theorem on its gradient.
    """
    if not UNKNOWNS[method]:
        return jnp.zeros(0), jnp.array(True)

    def offsets(alignment):
        return offsets_of(alignment, first, second, depth, method).ravel()

    def gradient(alignment):
        v, transposed = jax.vjp(offsets, alignment)
        return transposed(v)[0]

    def gauss_newton(_, start):
        def moving(state):
            _, step, k = state
            return (k < _STEPS) & (jnp.max(jnp.abs(step)) > _SMALL)

        def body(state):
            alignment, _, k = state
            columns = jax.jacfwd(offsets)(alignment)
            # No more than six well separated unknowns: normal equations will do, and compile in a third of the time.
            step = solve(columns.T @ columns, columns.T @ offsets(alignment))
            return alignment - step, step, k + 1

        return jax.lax.while_loop(moving, body, (start, jnp.ones_like(start), 0))[0]

    def tangent(linear, b):
        return solve(jax.jacfwd(linear)(jnp.zeros_like(b)), b)

    found = jax.lax.custom_root(gradient, jnp.zeros(UNKNOWNS[method]), gauss_newton, tangent)
    columns = jnp.linalg.norm(jax.jacfwd(offsets)(found), axis=0)
    limit = columns * (_FLAT * jnp.linalg.norm(offsets(found)) + _SMALL * jnp.linalg.norm(first))
    return found, jnp.all(jnp.abs(gradient(found)) <= limit)
