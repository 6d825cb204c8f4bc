"""How far two adjustments err together, because both of them use some of the same observations.

Two halves of a block have no image in common, but control, distances and what is known beforehand are in both. To first
order an estimate errs by -w'e, e being the errors of the observations over their standard deviations and w = J N^-1 e_p
its weights; so two estimates have the covariance w1'w2, taken over the rows that are in both.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment, NormalEquations, PaddedResiduals
from jaxphoto.adjustment.model.structure import observed_in
from jaxphoto.compiling import run_compiled

Weights = dict[tuple[str, str, int], Float[np.ndarray, "parameters"]]
"""By group, what the row is called, and a number where several are called the same."""


def common_covariance(
    first: Adjustment, second: Adjustment, camera: str, parameters: Sequence[str]
) -> Float[np.ndarray, "parameters parameters"]:
    """A priori covariance of the interior orientation of `camera` in two adjustments that have no image in common.

    Rows are `parameters` of the first, columns those of the second, in their own units; zero where they are held, and
    everywhere where the adjustments share no observation.
    """
    one, other = (_weights(adjusted, camera, parameters) for adjusted in (first, second))
    found = np.zeros((len(parameters), len(parameters)))
    for row in one.keys() & other.keys():
        found += np.outer(one[row], other[row])
    return found


def _weights(adjusted: Adjustment, camera: str, parameters: Sequence[str]) -> Weights:
    """w of the parameters, of every observed number that touches no image."""
    called = _called(adjusted)
    if not called:
        return {}
    place = {label: k for k, label in enumerate(adjusted.structure.labels)}
    own = [place.get(f"interior[{camera}].{name}", -1) for name in parameters]
    free = np.flatnonzero(np.array(own) >= 0)
    which = np.array(own, np.int32)[free]
    seen = run_compiled(_influences, (adjusted.equations.on_one_device, which), adjusted.seconds, "covariance")
    found: Weights = {}
    each = [adjusted.padded.crop_residuals(jax.tree.map(lambda v: v[k], seen)) for k in range(len(free))]  # noqa: B023
    for group, names in called.items():
        w = np.zeros((len(parameters), len(names)))
        w[free] = [np.ravel(one[group]) for one in each]
        taken: dict[str, int] = {}
        for column, name in enumerate(names):
            number = taken[name] = taken.get(name, 0) + 1
            found[group, name, number] = w[:, column]
    return found


def _called(adjusted: Adjustment) -> dict[str, list[str]]:
    """By group that touches no image, what each observed number is called, whichever part of the block it is in."""
    block = adjusted.block
    observed, found = observed_in(block, adjusted.priors), {}
    labels = [entry.label for entry in observed.entries]
    for group, rows in observed.named:
        touched = {what: np.asarray(index) for what, index in rows.indices()}
        if "image" in touched:
            continue
        if "parameter" in touched:
            found[group] = [labels[k] for k in touched["parameter"].ravel()]
        else:
            shape = np.shape(adjusted.residuals[group])
            found[group] = list(np.broadcast_to(rows.words(block.images, block.points), shape).ravel())
    return found


@eqx.filter_jit
def _influences(equations: NormalEquations, which: Int[Array, "parameters"]) -> PaddedResiduals:
    """J N^-1 e of some shared unknowns, in their own units, along a leading axis."""
    at = equations.at
    _, moved = jax.linearize(lambda y: at._replace(increments=y).residuals(), at.increments)
    nothing = jax.tree.map(jnp.zeros_like, at.increments)

    def of_one(k):
        unit = nothing.shared.at[k].set(equations.scale.shared[k])
        return moved(equations.solve(eqx.tree_at(lambda y: y.shared, nothing, unit)))

    return jax.lax.map(of_one, which)
