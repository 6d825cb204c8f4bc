"""Exact sensitivity of an adjustment: derivatives of its estimates by its observations, priors and fixed parameters.

At the optimum the gradient of half the weighted square sum vanishes, whatever the observations v; so (implicit function
theorem) an estimate e, a function of the unknowns x, answers a change of v with

    de/dv = -lambda' B,   H lambda = de/dx

with H and B of `hessian`: with the residuals' curvature, the derivative itself; without, the classical first-order
matrix -N^-1 J'P. One adjoint vector lambda for each estimate serves all observations. `response` answers one direction
of change of everything in a block, all points included, and takes blocks of any size.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.band import Band, factor_band, invert_band
from jaxphoto.adjustment.normal import At, unwhiten, whiten
from jaxphoto.adjustment.optimum import weigh_datum
from jaxphoto.adjustment.reduced import other_rows
from jaxphoto.adjustment.residuals import Increments, Residuals, Values
from jaxphoto.adjustment.shards import on_one_device
from jaxphoto.adjustment.structure import Structure, structure_of
from jaxphoto.arrays import still
from jaxphoto.block import AXES
from jaxphoto.compiling import run_compiled
from jaxphoto.errors import InputError
from jaxphoto.sensitivity.curvature import attitude_second, mixed_second
from jaxphoto.sensitivity.hessian import Eliminated, eliminated, image_columns
from jaxphoto.statistics import EOP_NAMES
from jaxphoto.statistics.covariance import turns_of
from jaxphoto.unknowns import FREE, uniform_priors

# Numbers that the derivatives by image points may have, empty slots included: 1.6 GB.
_MOST_NUMBERS = 2e8
# Points are asked for in multiples of this many, so that what is compiled serves most requests.
_POINTS = 8


class Sensitivity(eqx.Module):
    """Derivatives of the estimates named by `labels`, one row each, by group of observations in the block's order.

    Units are those of the estimate (m, rad, mm, the coefficient's own) over those of the observation (mm on the image,
    m, rad). Derivatives of and by what is held fixed are zero in the rows and in the groups of observations.
    """

    image_points: Float[np.ndarray, "estimates rows 2"]
    stations: Float[np.ndarray, "estimates stations"]
    attitudes: Float[np.ndarray, "estimates attitudes 3"]
    control_points: Float[np.ndarray, "estimates control"]
    distances: Float[np.ndarray, "estimates distances"]
    priors: Float[np.ndarray, "estimates weighted"]
    fixed: Float[np.ndarray, "estimates fixed"]
    """By the parameters and coordinates held fixed, named by `fixed_labels`."""
    labels: tuple[str, ...] = eqx.field(static=True)
    """As those of a `Covariance`; then `points[name].X` and so on for the points asked for."""
    fixed_labels: tuple[str, ...] = eqx.field(static=True)
    curvature: bool = eqx.field(static=True)
    """Whether the residuals' curvature counts; if not, this is the classical first-order matrix."""

    @property
    def groups(self) -> dict[str, Float[np.ndarray, "estimates n"]]:
        """The derivatives by group of observations, each as one matrix: x and y, roll, pitch, yaw of a row in turn."""
        names = ("image_points", "stations", "attitudes", "control_points", "distances", "priors")
        return {name: getattr(self, name).reshape(len(self.labels), -1) for name in names}

    def of(self, label: str) -> int:
        """The row of the estimate `label`. Raises InputError where there is none."""
        if label not in self.labels:
            raise InputError(f"no estimate is called {label}: there are {', '.join(self.labels[-8:])} and others")
        return self.labels.index(label)


class Derivatives(NamedTuple):
    """Rows of `Sensitivity` in the padded order: those of the reduced unknowns, then three for each point."""

    groups: Residuals
    fixed: Float[Array, "estimates fixed"]


def sensitivity(adjusted: Adjustment, *, curvature: bool = True, points: Sequence[str] = ()) -> Sensitivity:
    """d(estimate) / d(observation, prior, fixed parameter) of the optimum that `adjusted` has found.

    Estimates are all exterior orientations (X, Y, Z in m; omega, phi, kappa in rad), shared unknowns (interior
    orientation, mounts, strips), and the coordinates (m) of the `points` named. With `curvature` the derivative is
    exact; without, it is the classical matrix -N^-1 J'P dr/dv.

    Raises InputError for a point that the block does not have, for an adjustment that has not converged, and for a
    block whose matrix is too large to hold; `response` serves that.
    """
    _check_points(adjusted, points)
    s, computed = adjusted.structure, adjusted.computed
    places, padded = computed.places, on_one_device(computed.structure)
    number = {name: k for k, name in enumerate(adjusted.block.points)}
    asked = np.array([number[name] for name in points], int)
    index = np.zeros(-(-len(asked) // _POINTS) * _POINTS, np.int32)
    index[: len(asked)] = places.point[asked]
    _check_size(padded, index)
    held = adjusted.block.fixed
    fixed = _Fixed(
        np.setdiff1d(np.arange(len(adjusted.values.shared)), s.free).astype(np.int32),
        places.point[held.who].astype(np.int32),
        np.asarray(held.axis, np.int32),
    )
    values, scale = jax.tree.map(still, (computed.values, computed.factored.scale))
    h = eliminated(adjusted, curvature)
    arguments = (values, scale, h, padded, np.array(float(curvature)), index, fixed)
    found = run_compiled(_derivatives, arguments, adjusted.seconds, "sensitivity")

    n = 6 * padded.n_images
    own = (6 * places.image[:, None] + np.arange(6)).ravel()
    rows = np.concatenate([own, n + np.arange(s.n_shared + 3 * len(asked))])
    image, groups = places.row, found.groups
    crop = {name: still(getattr(groups, name))[rows] for name in groups._fields if name != "image"}
    of_rows = np.take(still(groups.image).reshape(len(groups.image), 2, -1), image, axis=2)[rows]
    names = [f"exterior[{i}].{e}" for i in adjusted.block.images for e in EOP_NAMES["omega_phi_kappa"]]
    labels = (*names, *s.labels, *(f"points[{name}].{axis}" for name in points for axis in AXES))
    fixed_labels = _fixed_labels(adjusted, fixed)
    # An estimate that is itself held fixed follows what holds it.
    same = np.array(labels)[:, None] == np.array(fixed_labels, dtype=str)
    return Sensitivity(
        image_points=of_rows.transpose(0, 2, 1),
        stations=crop["stations"][:, : len(s.station_image)],
        attitudes=crop["attitudes"].transpose(0, 2, 1)[:, : len(s.attitude_image)],
        control_points=crop["control"][:, s.control_axis, places.point[s.control_point]],
        distances=crop["distances"],
        priors=crop["priors"],
        fixed=still(found.fixed)[rows] + same,
        labels=labels,
        fixed_labels=fixed_labels,
        curvature=curvature,
    )


class _Fixed(NamedTuple):
    """What is held fixed: shared parameters by their index, then coordinates by point and axis."""

    shared: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "m"]
    axis: Int[np.ndarray, "m"]


def _fixed_labels(adjusted: Adjustment, fixed: _Fixed) -> tuple[str, ...]:
    """Parameter paths: of everything shared, if it were free, those of what is not."""
    block = adjusted.block
    every = structure_of(block, uniform_priors(adjusted.unknowns, FREE)).labels
    held = zip(block.fixed.who, block.fixed.axis, strict=True)
    return (*(every[k] for k in fixed.shared), *(f"points[{block.points[p]}].{AXES[a]}" for p, a in held))


def _check_points(adjusted: Adjustment, points: Sequence[str]) -> None:
    known = set(adjusted.block.points)
    missing = [name for name in points if name not in known]
    if missing:
        raise InputError(f"the block has no point {missing[0]}, of which the sensitivity is asked for: name one it has")


def _check_size(s: Structure, points: np.ndarray) -> None:
    n = 6 * s.n_images + s.n_shared
    numbers = 2 * (n + 3 * len(points)) * s.in_tiles.image.size * s.in_tiles.per_tile
    if numbers > _MOST_NUMBERS:
        raise InputError(
            f"all derivatives of a block of {s.n_images} images would be {numbers:.0e} numbers, "
            f"{_MOST_NUMBERS:.0e} at most: ask for one change at a time (response), or take a smaller block"
        )


class _Adjoint(NamedTuple):
    """lambda of every estimate, in scaled increments."""

    reduced: Float[Array, "estimates n"]
    points: Float[Array, "tiles 3 estimates p"]


@eqx.filter_jit
def _derivatives(
    values: Values, scale: Increments, h: Eliminated, s: Structure, curved: Array, points: Array, fixed: _Fixed
) -> Derivatives:
    at = At(jax.tree.map(jnp.zeros_like, scale), scale, weigh_datum(values, s), s)
    adjoint = _adjoint(h, at, points)
    rest = other_rows(at)
    j = rest.blocks
    # A last column of zeros serves colours that mean nothing in an image.
    reduced = jnp.pad(adjoint.reduced, ((0, 0), (0, 1)))
    columns = jnp.concatenate([6 * jnp.arange(s.n_images)[:, None] + jnp.arange(6), 6 * s.n_images + s.column], axis=1)
    of_points = _by_point(adjoint.points)

    def touching(b, image):
        """lambda' B of rows that touch an image and its shared unknowns."""
        return jnp.einsum("ena,an->en", reduced[:, columns[image]], b)

    eop, shared = attitude_second(at, curved)
    attitudes = jnp.concatenate([eop, shared], axis=1)
    stations = jnp.concatenate([j.station_eop, j.station_shared]) / values.sigma_stations
    ends = (of_points[:, :, s.distance_points[:, k]] * j.distances[k] for k in range(2))
    groups = Residuals(
        image=-_of_image_rows(h, adjoint, s),
        stations=-touching(stations, s.station_image),
        attitudes=-jnp.stack([touching(b, s.attitude_image) for b in attitudes], axis=1),
        control=-of_points * rest.control / values.sigma_control,
        surfaces=jnp.zeros((len(reduced), *values.sigma_surfaces.shape)),
        distances=-jnp.sum(sum(ends), axis=1) / values.sigma_distances,
        priors=-adjoint.reduced[:, 6 * s.n_images + s.weighted] * j.priors / values.sigma_priors,
        datum=jnp.zeros((len(reduced), 0)),
    )
    return Derivatives(groups, _of_fixed(adjoint.reduced, of_points, at, curved, fixed))


def _adjoint(h: Eliminated, at: At, points: Array) -> _Adjoint:
    """Of the reduced unknowns as they are reported, and of the coordinates of `points`."""
    scale, s = at.scale, at.structure
    n_images, n, k = s.n_images, 6 * s.n_images + s.n_shared, len(h.c)
    inverse = _inverse(h, s)
    of_reduced = inverse[:, :n].T * jnp.concatenate([scale.eop.T.reshape(-1), scale.shared])[:, None]
    images = of_reduced[: 6 * n_images].reshape(n_images, 2, 3, n + k)
    turned = jnp.einsum("nij,njk->nik", turns_of(at.values.rotation, "omega_phi_kappa"), images[:, 1])
    images = jnp.stack([images[:, 0], turned], axis=1).reshape(6 * n_images, n + k)

    # e of a coordinate is taken down to M, as any right-hand side.
    tile, slot = points // s.in_tiles.per_tile, points % s.in_tiles.per_tile
    unit = jnp.eye(3)[:, :, None] * scale.points.T[points].T[:, None]
    z = jnp.stack(whiten(unit, h.l[tile, :, slot].T))
    down = jnp.einsum("nfi,ien->nef", h.f[tile, :, :, slot], z)
    each = jnp.arange(len(points))
    right = jnp.zeros((len(points), 3, n + k)).at[each[:, None], :, h.touched[tile]].add(-down.transpose(0, 2, 1))
    right = right.reshape(3 * len(points), n + k)
    right = jnp.concatenate([right[:, :n], right[:, n:] @ h.c.T], axis=1)
    reduced = jnp.concatenate([images, of_reduced[6 * n_images :], right @ inverse.T])

    own = jnp.zeros((len(h.f), 3, len(points), 3, s.in_tiles.per_tile))
    own = own.at[tile, :, each, :, slot].set(z.transpose(2, 0, 1))
    own = jnp.pad(own.reshape(len(h.f), 3, 3 * len(points), s.in_tiles.per_tile), ((0, 0), (0, 0), (n, 0), (0, 0)))

    def up(tile):
        f, l, touched, own = tile  # noqa: E741
        met = (reduced[:, touched] @ f.reshape(len(f), -1)).reshape(len(reduced), 3, -1)
        return jnp.stack(unwhiten(own - met.transpose(1, 0, 2), l))

    return _Adjoint(reduced[:, :n], jax.lax.map(up, (h.f, h.l, h.touched, own)))


def _inverse(h: Eliminated, s: Structure) -> Float[Array, "n+k n+k"]:
    """Of M, which is positive definite where nothing couples points."""
    if len(h.c):
        return jnp.linalg.inv(h.m)
    m, q = 6 * s.n_images, s.n_shared
    return invert_band(factor_band(Band(jnp.zeros((0, 2 * m, m)), jnp.zeros((q, 0)), h.m)))


def _of_image_rows(h: Eliminated, adjoint: _Adjoint, s: Structure) -> Float[Array, "estimates 2 tiles m p"]:
    """lambda' B of all slots: products of small matrices, tile by tile."""
    columns = image_columns(s)
    image = s.in_tiles.image.reshape(len(h.f), -1)

    def tile(numbers):
        image, points, b = numbers
        own = adjoint.reduced.at[:, columns[image]].get(mode="fill", fill_value=0.0).transpose(1, 0, 2)
        a, shape = own.shape[2], b.shape[1:]
        of_image = own @ b[:a].transpose(2, 0, 1, 3).reshape(shape[1], a, -1)
        of_image = of_image.reshape(shape[1], -1, 2, shape[2]).transpose(1, 2, 0, 3)
        return of_image + sum(points[k][:, None, None] * b[a + k] for k in range(3))

    return jax.lax.map(tile, (image, adjoint.points, h.measured)).transpose(1, 2, 0, 3, 4)


def _by_point(points: Float[Array, "tiles 3 estimates p"]) -> Float[Array, "estimates 3 points"]:
    tiles, _, estimates, p = points.shape
    return points.transpose(2, 1, 0, 3).reshape(estimates, 3, tiles * p)


def _of_fixed(
    reduced: Array, points: Float[Array, "estimates 3 points"], at: At, curved: Array, fixed: _Fixed
) -> Float[Array, "estimates fixed"]:
    """-lambda' B of what is held fixed, one after the other: each may touch everything."""
    shared, coordinates = jnp.zeros_like(at.values.shared), jnp.zeros_like(at.values.points)

    nothing: Values = jax.tree.map(lambda _: None, at.values)

    def column(shared, coordinates):
        of_these = lambda v: (v.shared, v.points)  # noqa: E731
        change = eqx.tree_at(of_these, nothing, (shared, coordinates), is_leaf=lambda v: v is None)
        b = mixed_second(at, change, curved)
        of_reduced = reduced @ jnp.concatenate([b.eop.T.reshape(-1), b.shared])
        return -of_reduced - jnp.einsum("ecp,cp->e", points, b.points)

    by_shared = jax.lax.map(lambda k: column(shared.at[k].set(1.0), coordinates), fixed.shared)
    of_points = (fixed.axis, fixed.point)
    by_coordinate = jax.lax.map(lambda k: column(shared, coordinates.at[k].set(1.0)), of_points)
    return jnp.concatenate([by_shared, by_coordinate]).T
