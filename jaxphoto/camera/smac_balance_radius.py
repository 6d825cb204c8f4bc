"""Change of the balance radius R0 of SMAC: exact conversion, its inverse, and covariance propagation."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion import Smac
from jaxphoto.camera.interior import InteriorOrientation, get_parameter, parameter_names, set_parameter


def rebalance(interior: InteriorOrientation, r0_mm: Float[Array, ""] | float) -> InteriorOrientation:
    """Convert to the balance radius `r0_mm` and K0 = 0, with the same rays.

    With `s = 1 -+ (K0 - sum Ki R0^2i)` (upper sign: subtracted), c, Ki, P1 and P2 are divided by s to reach R0 = 0, and
    are multiplied by `1 / (1 -+ sum Ki R0^2i)` to reach another R0; P3, P4 and the principal point are unchanged. The
    image rays agree to rounding. `rebalance(rebalance(x, a), x.distortion.r0)` returns x if K0 = 0.

    Raises ValueError for a distortion other than SMAC, and an Equinox error if the conversion is singular for this R0.
    Source: paper 002, section on the equivalence of R0; derivation in docs/models.md.
    """
    d = interior.distortion
    if not isinstance(d, Smac):
        raise ValueError(f"only SMAC has a balance radius to change; this camera has {type(d).__name__}")
    k = jnp.stack([jnp.asarray(v, float) for v in (d.k1, d.k2, d.k3, d.k4)])
    old, new = (jnp.asarray(r, float) ** (2 * jnp.arange(1, 5)) for r in (d.r0, r0_mm))
    to_zero = 1 + d.signum * (d.k0 - k @ old)
    to_new = 1 + d.signum * (k / to_zero) @ new
    factor = 1 / (to_zero * to_new)
    singular = ~jnp.isfinite(factor) | (to_zero * to_new <= 0)
    factor = eqx.error_if(factor, singular, f"SMAC is singular at R0 = {r0_mm} mm: use a smaller R0")
    k1, k2, k3, k4 = k * factor
    smac = Smac(
        k0=jnp.zeros_like(factor), k1=k1, k2=k2, k3=k3, k4=k4, p1=d.p1 * factor, p2=d.p2 * factor,
        p3=d.p3, p4=d.p4, r0=jnp.asarray(r0_mm, float), sign=d.sign,
    )  # fmt: skip
    return dataclasses.replace(interior, c=interior.c * factor, distortion=smac)


def rebalance_covariance(
    interior: InteriorOrientation, r0_mm: Float[Array, ""] | float, covariance: Float[Array, "n n"]
) -> Float[Array, "n n"]:
    """Propagate the covariance to `rebalance(interior, r0_mm)`: J Q J' with the exact Jacobian J.

    `covariance` is ordered as `parameter_names(interior)`, with zero rows and columns for fixed parameters.
    """
    names = parameter_names(interior)

    def mapped(vector):
        tree = interior
        for name, value in zip(names, vector, strict=True):
            tree = set_parameter(tree, name, value)
        new = rebalance(tree, r0_mm)
        return jnp.stack([jnp.asarray(get_parameter(new, name), float) for name in names])

    vector = jnp.stack([jnp.asarray(get_parameter(interior, name), float) for name in names])
    jacobian = jax.jacfwd(mapped)(vector)
    return jacobian @ covariance @ jacobian.T
