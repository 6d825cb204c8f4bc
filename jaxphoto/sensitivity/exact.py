"""Exact sensitivity of an adjustment: derivatives of its estimates by its observations, priors and fixed parameters.

At the optimum the gradient of half the weighted square sum vanishes, whatever the observations v; so (implicit function
theorem) an estimate e, a function of the unknowns x, answers a change of v with

    de/dv = -lambda' B,   H lambda = de/dx

with H and B of `hessian`: with the residuals' curvature, the derivative itself; without, the classical first-order
matrix -N^-1 J'P. One adjoint vector lambda for each estimate serves all observations (`adjoint`), and B is sparse: an
image row touches its image, camera and point. `response` answers one direction of change of everything in a block, all
points included, and takes blocks of any size.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment, NormalEquations, PaddedBlock
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.adjustment.model.row_functions import reduced_places
from jaxphoto.adjustment.model.structure import Structure
from jaxphoto.arrays import still
from jaxphoto.compiling import run_compiled
from jaxphoto.errors import InputError
from jaxphoto.observations import AXES
from jaxphoto.sensitivity.adjoint import Estimates, adjoint_vectors
from jaxphoto.sensitivity.curvature import mixed_second, rows_second
from jaxphoto.sensitivity.hessian import Eliminated, check_optimum, eliminated
from jaxphoto.sensitivity.image_rows import ListedRows, image_rows
from jaxphoto.short_repr import shown
from jaxphoto.statistics import EOP_NAMES
from jaxphoto.statistics.covariance import rotation_jacobians
from jaxphoto.tracing import outside_transformations

# Numbers that the derivatives by image points may have: 1.6 GB.
_MOST_NUMBERS = 2e8


@shown
class Sensitivity(eqx.Module):
    """Derivatives of the estimates named by `labels`, one row each, by observations in the block's order.

    `named` has them by group, as the residuals of an adjustment: (estimates, rows), or (estimates, rows, axes). Units
    are those of the estimate (m, rad, mm, the coefficient's own) over those of the observation (mm on the image, m,
    rad). Of surfaces it is by how far they lie along their normals (m). Derivatives of and by what is held fixed are
    zero in the rows and in the groups of observations.
    """

    named: dict[str, Float[np.ndarray, "estimates ..."]]
    labels: tuple[str, ...] = eqx.field(static=True)
    """As those of a `Covariance`; then `points[name].X` and so on for the points asked for."""
    curvature: bool = eqx.field(static=True)
    """Whether the residuals' curvature counts; if not, this is the classical first-order matrix."""
    by_fixed: Callable[[], tuple[np.ndarray, tuple[str, ...]]] = eqx.field(static=True, repr=False)
    """What gives `fixed` and `fixed_labels`: they take as long as all else, and are computed when asked for."""

    def __getitem__(self, name: str) -> Float[np.ndarray, "estimates ..."]:
        return self.named[name]

    @property
    def groups(self) -> dict[str, Float[np.ndarray, "estimates _"]]:
        """The derivatives by group of observations, each as one matrix: the numbers of a row in turn."""
        return {name: v.reshape(len(self.labels), -1) for name, v in self.named.items()}

    @property
    def fixed(self) -> Float[np.ndarray, "estimates fixed"]:
        """By the parameters and coordinates held fixed, named by `fixed_labels`."""
        return self.by_fixed()[0]

    @property
    def fixed_labels(self) -> tuple[str, ...]:
        """Parameter paths of all that is held fixed, then `points[name].X` and so on."""
        return self.by_fixed()[1]

    def of(self, label: str) -> int:
        """The row of the estimate `label`. Raises InputError where there is none."""
        if label not in self.labels:
            raise InputError(f"no estimate is called {label}: there are {', '.join(self.labels[-8:])} and others")
        return self.labels.index(label)


@outside_transformations
def sensitivity(adjusted: Adjustment, *, curvature: bool = True, points: Sequence[str] = ()) -> Sensitivity:
    """d(estimate) / d(observation, prior, fixed parameter) of the optimum that `adjusted` has found.

    Estimates are all exterior orientations (X, Y, Z in m; omega, phi, kappa in rad), shared unknowns (interior
    orientation, mounts, strips), and the coordinates (m) of the `points` named. With `curvature` the derivative is
    exact; without, it is the classical matrix -N^-1 J'P dr/dv.

    Raises InputError for a point that the block does not have, for an adjustment that has not converged, and for a
    block whose matrix is too large to hold; `response` serves that.
    """
    _check_points(adjusted, points)
    check_optimum(adjusted)
    equations = adjusted.equations.on_one_device
    padded, places, scale, s = adjusted.padded, adjusted.padded.places, equations.scale, equations.structure
    own, estimates = adjusted.structure, 6 * len(places.image) + s.n_shared + 3 * len(points)
    _check_size(own, estimates)
    given = equations, image_rows(adjusted), np.array(float(curvature))
    found = jax.tree.map(still, run_compiled(_derivatives, given, adjusted.seconds, "sensitivity"))
    asked = places.point[[adjusted.block.points.index(name) for name in points]] if points else np.zeros(0, int)
    unknowns = np.append(6 * places.image[:, None] + np.arange(6), 6 * s.n_images + np.arange(s.n_shared))
    step = np.append(scale.eop.T, scale.shared)[unknowns]
    of = Estimates(unknowns, step, found.turns[places.image], asked, still(scale.points).T[asked])
    adjoint = adjoint_vectors(found.h, of)

    rows = _observations(found, padded, len(unknowns) + len(found.h.c))
    derivatives = _sparse(list(rows.values()), len(adjoint)) @ adjoint
    shapes = {name: b.shape[:-1] for name, (b, _) in rows.items()}
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])[:-1]
    parts = zip(shapes.items(), np.split(derivatives, ends), strict=True)
    # Estimates last in memory: what belongs to an observation is written in one stretch.
    groups = {name: np.moveaxis(part.reshape(*shape, estimates), -1, 0) for (name, shape), part in parts}
    names = [f"exterior[{i}].{e}" for i in adjusted.block.images for e in EOP_NAMES["omega_phi_kappa"]]
    labels = (*names, *own.labels, *(f"points[{name}].{axis}" for name in points for axis in AXES))
    by_fixed = partial(_by_fixed, adjusted, curvature, labels, adjoint, unknowns)
    return Sensitivity(groups, labels=labels, curvature=curvature, by_fixed=by_fixed)


def _check_points(adjusted: Adjustment, points: Sequence[str]) -> None:
    known = set(adjusted.block.points)
    missing = [name for name in points if name not in known]
    if missing:
        raise InputError(f"the block has no point {missing[0]}, of which the sensitivity is asked for: name one it has")


def _check_size(own: Structure, estimates: int) -> None:
    numbers = 2 * len(own.image) * estimates
    if numbers > _MOST_NUMBERS:
        raise InputError(
            f"all derivatives of a block of {own.n_images} images would be {numbers:.0e} numbers, {_MOST_NUMBERS:.0e} "
            "at most: ask for one change at a time (response), or take a smaller block"
        )


class _Derivatives(NamedTuple):
    """Of a padded block: what is eliminated, and B of all but the image rows (z, observed, ...)."""

    h: Eliminated
    turns: Float[Array, "images 3 3"]
    others: tuple[Float[Array, "z o ..."], ...]


@eqx.filter_jit
def _derivatives(equations: NormalEquations, rows: ListedRows, curved: Array) -> _Derivatives:
    at = equations.at
    others = tuple(second.b for second in rows_second(at, curved))
    return _Derivatives(eliminated(at, rows, curved), rotation_jacobians(at.values.rotation, "omega_phi_kappa"), others)


Rows = tuple[np.ndarray, np.ndarray]
"""-B of some observations, numbers last, and the unknowns that these belong to."""


def _observations(found: _Derivatives, padded: PaddedBlock, first: int) -> dict[str, Rows]:
    """-B of all observations, by the names of their groups; `first` is where the points begin."""
    own, places = padded.own, padded.places
    n, q, axes = 6 * own.n_images, own.n_image_colours, np.arange(3)
    first_of = first + 3 * places.point
    of_image = np.concatenate([6 * np.arange(own.n_images)[:, None] + np.arange(6), n + own.column[:, :q]], axis=1)
    of_rows = of_image[own.image]
    of_rows = np.concatenate([of_rows[:, :6], first_of[own.point][:, None] + axes, of_rows[:, 6:]], axis=1)
    rows: dict[str, tuple[Any, np.ndarray]] = {
        IMAGE_POINTS: (found.h.measured[: len(of_rows)], of_rows[:, None]),
    }
    for g, b in zip(own.observed, found.others, strict=True):
        z, o = b.shape[:2]
        # (z o, rows), then rows first and z last.
        flat = padded.crop_rows(dataclasses.replace(g, scalar=False), np.reshape(b, (z * o, *b.shape[2:])))
        flat = -np.moveaxis(flat.reshape(z, o, -1), 0, -1).swapaxes(0, 1)
        of_points = (first_of[g.point][:, None] + axes[:, None]).reshape(-1, g.n_rows)
        touched = np.concatenate([np.asarray(reduced_places(g, own.n_images)), of_points]).T
        rows[g.name] = (flat[:, 0], touched) if g.scalar else (flat, touched[:, None])
    return {name: (b, np.broadcast_to(unknowns.astype(np.int32), b.shape)) for name, (b, unknowns) in rows.items()}


def _sparse(rows: Sequence[Rows], unknowns: int) -> "scipy.sparse.csr_array":
    """-B, a row each number that is observed."""
    lengths = np.repeat([b.shape[-1] for b, _ in rows], [math.prod(b.shape[:-1]) for b, _ in rows])
    data, columns = (np.concatenate([part[k].ravel() for part in rows]) for k in range(2))
    starts = np.append(0, np.cumsum(lengths)).astype(np.int32)
    return scipy.sparse.csr_array((data, columns, starts), shape=(len(lengths), unknowns))


class _Held(NamedTuple):
    """What is held fixed: shared parameters by their index, then coordinates by place of the point and axis."""

    shared: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "m"]
    axis: Int[np.ndarray, "m"]


def _by_fixed(
    adjusted: Adjustment, curvature: bool, labels: Sequence[str], adjoint: np.ndarray, unknowns: np.ndarray
) -> tuple[Float[np.ndarray, "estimates fixed"], tuple[str, ...]]:
    """-lambda' B of what is held fixed, and its labels: parameter paths of what is not free, then coordinates."""
    block, fixed = adjusted.block, adjusted.block.fixed
    equations = adjusted.equations.on_one_device
    s, places, values = equations.structure, adjusted.padded.places, equations.values
    every = adjusted.parameters
    shared = np.setdiff1d(np.arange(len(values.shared)), s.free)
    held = _Held(*(np.asarray(v, np.int32) for v in (shared, places.point[fixed.who], fixed.axis)))
    given = equations, np.array(float(curvature)), held
    b = still(run_compiled(_fixed_rows, given, adjusted.seconds, "sensitivity"))
    n = 6 * s.n_images + s.n_shared
    found = b[:, unknowns] @ adjoint[: len(unknowns)] + b[:, n:] @ adjoint[len(adjoint) - 3 * s.n_points :]

    coordinates = (f"points[{block.points[p]}].{AXES[a]}" for p, a in zip(fixed.who, fixed.axis, strict=True))
    fixed_labels = (*(every[k] for k in shared), *coordinates)
    # An estimate that is itself held fixed follows what holds it.
    same = np.array(labels)[:, None] == np.array(fixed_labels, dtype=str)
    return same - found.T, fixed_labels


@eqx.filter_jit
def _fixed_rows(equations: NormalEquations, curved: Array, held: _Held) -> Float[Array, "fixed n"]:
    """B of what is held fixed, one after the other: each may touch everything, images, shared unknowns and points."""
    at, values = equations.at, equations.values
    shared, coordinates = jnp.zeros_like(values.shared), jnp.zeros_like(values.points)
    nothing: Any = jax.tree.map(lambda _: None, values)

    def column(shared, coordinates):
        of_these = lambda v: (v.shared, v.points)  # noqa: E731
        change = eqx.tree_at(of_these, nothing, (shared, coordinates), is_leaf=lambda v: v is None)
        b = mixed_second(at, change, curved)
        return jnp.concatenate([b.eop.T.reshape(-1), b.shared, b.points.T.reshape(-1)])

    by_shared = jax.lax.map(lambda k: column(shared.at[k].set(1.0), coordinates), held.shared)
    moved = lambda axis, point: coordinates.at[axis, point].set(1.0)  # noqa: E731
    by_coordinate = jax.lax.map(lambda k: column(shared, moved(*k)), (held.axis, held.point))
    return jnp.concatenate([by_shared, by_coordinate])
