"""Exact sensitivity of an adjustment: derivatives of its estimates by its observations, priors and fixed parameters.

At the optimum the gradient of half the weighted square sum vanishes, whatever the observations v; so (implicit function
theorem) an estimate e, a function of the unknowns x, answers a change of v with

    de/dv = -lambda' B,   H lambda = de/dx

with H and B of `hessian`: with the residuals' curvature, the derivative itself; without, the classical first-order
matrix -N^-1 J'P. One adjoint vector lambda for each estimate serves all observations (`adjoint`), and B is sparse: an
image row touches its image, camera and point. `response` answers one direction of change of everything in a block, all
points included, and takes blocks of any size.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import sparse

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.normal import At
from jaxphoto.adjustment.optimum import weigh_datum
from jaxphoto.adjustment.padding import Places, crop_residuals
from jaxphoto.adjustment.reduced import other_rows
from jaxphoto.adjustment.residuals import Increments, Residuals, Values
from jaxphoto.adjustment.structure import Structure, structure_of
from jaxphoto.arrays import still
from jaxphoto.block import AXES
from jaxphoto.compiling import run_compiled
from jaxphoto.errors import InputError
from jaxphoto.sensitivity.adjoint import Estimates, adjoint_vectors
from jaxphoto.sensitivity.curvature import attitude_second, mixed_second
from jaxphoto.sensitivity.hessian import Eliminated, check_optimum, eliminated
from jaxphoto.sensitivity.image_rows import ImageRows, image_rows
from jaxphoto.statistics import EOP_NAMES
from jaxphoto.statistics.covariance import turns_of
from jaxphoto.unknowns import FREE, uniform_priors

# Numbers that the derivatives by image points may have: 1.6 GB.
_MOST_NUMBERS = 2e8


class Sensitivity(eqx.Module):
    """Derivatives of the estimates named by `labels`, one row each, by group of observations in the block's order.

    Units are those of the estimate (m, rad, mm, the coefficient's own) over those of the observation (mm on the image,
    m, rad). Derivatives of and by what is held fixed are zero in the rows and in the groups of observations.
    """

    image_points: Float[np.ndarray, "estimates rows 2"]
    stations: Float[np.ndarray, "estimates stations"]
    attitudes: Float[np.ndarray, "estimates attitudes 3"]
    control_points: Float[np.ndarray, "estimates control"]
    surfaces: Float[np.ndarray, "estimates surfaces"]
    """By how far the laser scanner's surfaces lie along their normals (m)."""
    distances: Float[np.ndarray, "estimates distances"]
    priors: Float[np.ndarray, "estimates weighted"]
    labels: tuple[str, ...] = eqx.field(static=True)
    """As those of a `Covariance`; then `points[name].X` and so on for the points asked for."""
    curvature: bool = eqx.field(static=True)
    """Whether the residuals' curvature counts; if not, this is the classical first-order matrix."""
    by_fixed: Callable[[], tuple[np.ndarray, tuple[str, ...]]] = eqx.field(static=True, repr=False)
    """What gives `fixed` and `fixed_labels`: they take as long as all else, and are computed when asked for."""

    @property
    def groups(self) -> dict[str, Float[np.ndarray, "estimates n"]]:
        """The derivatives by group of observations, each as one matrix: x and y, roll, pitch, yaw of a row in turn."""
        names = ("image_points", "stations", "attitudes", "control_points", "surfaces", "distances", "priors")
        return {name: getattr(self, name).reshape(len(self.labels), -1) for name in names}

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
    places, values, scale, s = _padded(adjusted)
    own, estimates = adjusted.structure, 6 * len(places.image) + s.n_shared + 3 * len(points)
    _check_size(own, estimates)
    given = values, scale, image_rows(adjusted), s, np.array(float(curvature))
    found = jax.tree.map(still, run_compiled(_derivatives, given, adjusted.seconds, "sensitivity"))
    asked = places.point[[adjusted.block.points.index(name) for name in points]] if points else np.zeros(0, int)
    unknowns = np.append(6 * places.image[:, None] + np.arange(6), 6 * s.n_images + np.arange(s.n_shared))
    step = np.append(scale.eop.T, scale.shared)[unknowns]
    of = Estimates(unknowns, step, found.turns[places.image], asked, scale.points.T[asked])
    adjoint = adjoint_vectors(found.h, of)

    rows = _observations(found, values, own, places, len(unknowns) + len(found.h.c))
    derivatives = _sparse(list(rows.values()), len(adjoint)) @ adjoint
    shapes = {name: b.shape[:-1] for name, (b, _) in rows.items()}
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])[:-1]
    parts = zip(shapes.items(), np.split(derivatives, ends), strict=True)
    # Estimates last in memory: what belongs to an observation is written in one stretch.
    groups = {name: np.moveaxis(part.reshape(*shape, estimates), -1, 0) for (name, shape), part in parts}
    names = [f"exterior[{i}].{e}" for i in adjusted.block.images for e in EOP_NAMES["omega_phi_kappa"]]
    labels = (*names, *own.labels, *(f"points[{name}].{axis}" for name in points for axis in AXES))
    by_fixed = partial(_by_fixed, adjusted, curvature, labels, adjoint, unknowns)
    return Sensitivity(**groups, labels=labels, curvature=curvature, by_fixed=by_fixed)


def _padded(adjusted: Adjustment) -> tuple[Places, Any, Any, Structure]:
    """What an adjustment was computed with: places, values, scale and structure."""
    computed = adjusted.computed.on_one_device
    return computed.places, computed.values, computed.factored.scale, computed.structure


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
    """Of a padded block: what is eliminated, and -B of all but the image rows."""

    h: Eliminated
    turns: Float[Array, "images 3 3"]
    stations: Float[Array, "stations 6+colours"]
    attitudes: Float[Array, "attitudes 3 6+colours"]
    control: Float[Array, "points 3"]
    surfaces: Float[Array, "rows points 3+scanner"]
    distances: Float[Array, "distances 6"]
    priors: Float[Array, "weighted"]


@eqx.filter_jit
def _derivatives(values: Values, scale: Increments, rows: ImageRows, s: Structure, curved: Array) -> _Derivatives:
    at = At(jax.tree.map(jnp.zeros_like, scale), scale, weigh_datum(values, s), s)
    rest = other_rows(at)
    j = rest.blocks
    stations = jnp.concatenate([j.station_eop, j.station_shared]) / values.sigma_stations
    return _Derivatives(
        eliminated(at, rows, curved),
        turns_of(values.rotation, "omega_phi_kappa"),
        -stations.T,
        -jnp.concatenate(attitude_second(at, curved), axis=1).transpose(2, 0, 1),
        -(rest.control / values.sigma_control).T,
        -jnp.moveaxis(jnp.concatenate([rest.surfaces, rest.surfaces_scanner]) / values.sigma_surfaces, 0, -1),
        -(j.distances / values.sigma_distances).reshape(6, -1).T,
        -j.priors / values.sigma_priors,
    )


Rows = tuple[np.ndarray, np.ndarray]
"""-B of some observations, numbers last, and the unknowns that these belong to."""


def _observations(found: _Derivatives, values: Values, own: Structure, places: Places, first: int) -> dict[str, Rows]:
    """-B of all observations, by the names that `Sensitivity` gives them; `first` is where the points begin."""
    n, q, axes = 6 * own.n_images, own.n_image_colours, np.arange(3)
    first_of = first + 3 * places.point
    of_image = np.concatenate([6 * np.arange(own.n_images)[:, None] + np.arange(6), n + own.column], axis=1)
    of_rows = of_image[own.image]
    of_rows = np.concatenate([of_rows[:, :6], first_of[own.point][:, None] + axes, of_rows[:, 6 : 6 + q]], axis=1)
    stations, attitudes, control = len(own.station_image), len(own.attitude_image), own.control_point
    of_surfaces, of_laser = _surfaces(found, values, own, places, first_of)
    of_ends = first_of[own.distance_points][:, :, None] + axes
    rows: dict[str, tuple[Any, np.ndarray]] = {
        "image_points": (found.h.measured[: len(of_rows)], of_rows[:, None]),
        "stations": (found.stations[:stations], of_image[own.station_image]),
        "attitudes": (found.attitudes[:attitudes], of_image[own.attitude_image, None]),
        "control_points": (
            found.control[places.point[control], own.control_axis, None],
            (first_of[control] + own.control_axis)[:, None],
        ),
        "surfaces": (of_surfaces, of_laser),
        "distances": (found.distances, of_ends.reshape(-1, 6)),
        "priors": (found.priors[:, None], n + own.weighted[:, None]),
    }
    return {name: (b, np.broadcast_to(unknowns.astype(np.int32), b.shape)) for name, (b, unknowns) in rows.items()}


def _surfaces(found: Any, values: Any, own: Structure, places: Places, first_of: Int[np.ndarray, "points"]) -> Rows:
    """-B of the rows of surfaces: of the coordinates of the point, and of the scanner's unknowns."""
    scanner = 6 * own.n_images + own.n_interior + np.arange(own.n_scanner)
    b = found.surfaces.reshape(-1, 3 + own.n_scanner)
    if len(own.surface_point):
        names = ("stations", "attitudes", "control", "distances", "priors")
        shaped: Any = {name: getattr(values, name) for name in names} | {"image": values.xy, "datum": np.zeros(0)}
        which: Any = np.arange(len(b)).reshape(values.sigma_surfaces.shape)
        b = b[crop_residuals(Residuals(surfaces=which, **shaped), own, places).surfaces]
    of_point = first_of[own.surface_point][:, None] + np.arange(3)
    return b, np.concatenate([of_point, np.broadcast_to(scanner, (len(of_point), own.n_scanner))], axis=1)


def _sparse(rows: Sequence[Rows], unknowns: int) -> sparse.csr_array:
    """-B, a row each number that is observed."""
    lengths = np.repeat([b.shape[-1] for b, _ in rows], [math.prod(b.shape[:-1]) for b, _ in rows])
    data, columns = (np.concatenate([part[k].ravel() for part in rows]) for k in range(2))
    starts = np.append(0, np.cumsum(lengths)).astype(np.int32)
    return sparse.csr_array((data, columns, starts), shape=(len(lengths), unknowns))


class _Held(NamedTuple):
    """What is held fixed: shared parameters by their index, then coordinates by point and axis."""

    shared: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "m"]
    axis: Int[np.ndarray, "m"]


def _by_fixed(
    adjusted: Adjustment, curvature: bool, labels: Sequence[str], adjoint: np.ndarray, unknowns: np.ndarray
) -> tuple[Float[np.ndarray, "estimates fixed"], tuple[str, ...]]:
    """-lambda' B of what is held fixed, and its labels: parameter paths of what is not free, then coordinates."""
    block, fixed = adjusted.block, adjusted.block.fixed
    places, values, scale, s = _padded(adjusted)
    shared = np.setdiff1d(np.arange(len(values.shared)), s.free)
    held = _Held(*(np.asarray(v, np.int32) for v in (shared, places.point[fixed.who], fixed.axis)))
    given = values, scale, s, np.array(float(curvature)), held
    b = still(run_compiled(_fixed_rows, given, adjusted.seconds, "sensitivity"))
    n = 6 * s.n_images + s.n_shared
    found = b[:, unknowns] @ adjoint[: len(unknowns)] + b[:, n:] @ adjoint[len(adjoint) - 3 * s.n_points :]

    every = structure_of(block, uniform_priors(adjusted.unknowns, FREE)).labels
    coordinates = (f"points[{block.points[p]}].{AXES[a]}" for p, a in zip(fixed.who, fixed.axis, strict=True))
    fixed_labels = (*(every[k] for k in shared), *coordinates)
    # An estimate that is itself held fixed follows what holds it.
    same = np.array(labels)[:, None] == np.array(fixed_labels, dtype=str)
    return same - found.T, fixed_labels


@eqx.filter_jit
def _fixed_rows(values: Values, scale: Increments, s: Structure, curved: Array, held: _Held) -> Float[Array, "fixed n"]:
    """B of what is held fixed, one after the other: each may touch everything, images, shared unknowns and points."""
    at = At(jax.tree.map(jnp.zeros_like, scale), scale, weigh_datum(values, s), s)
    shared, coordinates = jnp.zeros_like(values.shared), jnp.zeros_like(values.points)
    nothing: Values = jax.tree.map(lambda _: None, values)

    def column(shared, coordinates):
        of_these = lambda v: (v.shared, v.points)  # noqa: E731
        change = eqx.tree_at(of_these, nothing, (shared, coordinates), is_leaf=lambda v: v is None)
        b = mixed_second(at, change, curved)
        return jnp.concatenate([b.eop.T.reshape(-1), b.shared, b.points.T.reshape(-1)])

    by_shared = jax.lax.map(lambda k: column(shared.at[k].set(1.0), coordinates), held.shared)
    of_points = (held.axis, held.point)
    by_coordinate = jax.lax.map(lambda k: column(shared, coordinates.at[k].set(1.0)), of_points)
    return jnp.concatenate([by_shared, by_coordinate])
