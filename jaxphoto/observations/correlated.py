"""Correlated observations: small sets of rows with a full covariance matrix.

A set of m rows of any kind has the covariance matrix C = L L'. Examples: the three axes of a station from GNSS
processing, a point from another adjustment, stations of a strip with exponential correlation in time. The residuals are
multiplied by L^-1, which is computed once; the solver processes only rows of unit weight.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.arrays import ArrayLike, to_numpy
from jaxphoto.observations.base import AbstractObservations
from jaxphoto.static_values import map_arrays


class Correlated(AbstractObservations):
    """Sets of correlated rows, created by `correlated`; fields of `rows` have the leading axes (sets, m).

    `covariance` (sets, m k, m k): covariance of the m rows of a set with k components each.
    """

    rows: AbstractObservations
    covariance: Float[ArrayLike, "sets n n"]
    whitener: Float[ArrayLike, "sets n n"]
    """Inverse Cholesky factor L^-1 of each covariance."""
    group: str = eqx.field(static=True)  # type: ignore[misc]
    unit: str = eqx.field(static=True)  # type: ignore[misc]
    axes: tuple[str, ...] = eqx.field(static=True)  # type: ignore[misc]
    block_parameters: tuple[str, ...] = eqx.field(static=True)  # type: ignore[misc]
    rigid_invariant: bool = eqx.field(static=True)  # type: ignore[misc]
    uses_interior: bool = eqx.field(static=True)  # type: ignore[misc]

    def residual(self, *touched: Any) -> Float[ArrayLike, "n"]:
        """Return the residuals of the rows of one set, concatenated."""
        n = len(self.rows.indices())
        each = jax.vmap(lambda row, *own: row.residual(*own, *touched[n:]))(self.rows, *touched[:n])
        return each.reshape(-1)

    def whitened(self, residual: Float[ArrayLike, "n"]) -> Float[ArrayLike, "n"]:
        """Multiply the residuals by L^-1."""
        return self.whitener @ residual

    def with_sigmas_times(self, factor: Float[ArrayLike, "sets n"]) -> "Correlated":
        """Replace the covariance C by D C D with the diagonal matrix D of `factor`; correlations are unchanged."""
        where = lambda sets: (sets.covariance, sets.whitener)  # noqa: E731
        new = self.covariance * factor[:, :, None] * factor[:, None], self.whitener / factor[:, None]
        return eqx.tree_at(where, self, new)

    def without_weight(self) -> "Correlated":
        """Return the sets with zero weight."""
        return eqx.tree_at(lambda sets: sets.whitener, self, np.zeros(np.shape(self.whitener)))

    def indices(self) -> list[tuple[str, Int[ArrayLike, "..."]]]:
        """Return kinds and indices of the objects of the rows; the rows of a set are along the second axis."""
        return self.rows.indices()

    @property
    def observation(self) -> ArrayLike:
        """Return the observed values as an array (sets, n)."""
        return self.rows.observation.reshape(len(self), -1)

    def with_observation(self, value: ArrayLike) -> "Correlated":
        """Replace the observed values."""
        inner = self.rows.with_observation(value.reshape(self.rows.observation.shape))
        return eqx.tree_at(lambda sets: sets.rows, self, inner)

    @property
    def sigmas(self) -> ArrayLike:
        """Return the standard deviations as an array (sets, n)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def physical(self, whitened: Float[ArrayLike, "n sets"]) -> Float[np.ndarray, "n sets"]:
        """Multiply the whitened residuals by L."""
        return np.linalg.solve(np.asarray(self.whitener), np.asarray(whitened).T[..., None])[..., 0].T

    def __len__(self) -> int:
        return len(self.covariance)

    def axis_names(self) -> np.ndarray:
        """Return the axis names as an array (n, sets)."""
        return self._by_set(self.flat.axis_names())

    def names_of(self, what: str, names: Sequence[str] | np.ndarray) -> np.ndarray:
        """Return the object names as an array (n, sets)."""
        return self._by_set(self.flat.names_of(what, names))

    def words(self, images: Sequence[str], points: Sequence[str]) -> np.ndarray:
        """Return the labels as an array (n, sets)."""
        return self._by_set(self.flat.words(images, points))

    @property
    def flat(self) -> AbstractObservations:
        """Return the rows of all sets, concatenated."""
        return map_arrays(lambda v: np.asarray(v).reshape(-1, *np.shape(v)[2:]), self.rows)

    def _by_set(self, names: np.ndarray) -> np.ndarray:
        n = int(np.prod(np.shape(self.covariance)[:2]))
        k = len(self.rows.axes)
        return np.broadcast_to(names, (k, n // k)).T.reshape(len(self), -1).T


def correlated(
    rows: AbstractObservations, sets: Sequence[Sequence[int]] | np.ndarray, covariance: Float[np.ndarray, "sets n n"]
) -> Correlated:
    """Combine `rows` into sets of equal size (lists of row indices), each with a covariance matrix (m2, rad2 ...).

    The order within a covariance matrix is row by row, then component by component. Standard deviations of `rows` are
    ignored. Raises ValueError for invalid matrices.
    """
    index, covariance = np.asarray(sets, int), np.asarray(covariance, float)
    n = index.shape[1] * len(rows.axes) if index.ndim == 2 else 0
    if index.ndim != 2 or covariance.shape != (len(index), n, n):
        raise ValueError(
            f"covariances of {len(index)} sets, each with as many rows, must have the shape {(len(index), n, n)}, "
            f"got {covariance.shape}"
        )
    try:
        whitener = np.linalg.inv(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        raise ValueError("a covariance matrix is not positive definite") from None
    return Correlated(
        rows=map_arrays(lambda v: to_numpy(v)[index], rows),
        covariance=covariance,
        whitener=whitener,
        group=f"correlated_{rows.group}",
        unit=rows.unit,
        axes=rows.axes * index.shape[1],
        block_parameters=rows.block_parameters,
        rigid_invariant=rows.rigid_invariant,
        uses_interior=rows.uses_interior,
    )


def exponential_covariance(
    time: Float[np.ndarray, "n"], sigma: Float[np.ndarray, "n"] | float, correlation_time: float
) -> Float[np.ndarray, "n n"]:
    """Return the covariance sigma_i sigma_j exp(-|t_i - t_j| / T) of a first-order Gauss-Markov process; t, T in s."""
    time, sigma = np.asarray(time, float), np.broadcast_to(np.asarray(sigma, float), np.shape(time))
    return sigma[:, None] * sigma * np.exp(-np.abs(time[:, None] - time) / correlation_time)


def is_covariance(matrix: Float[np.ndarray, "n n"]) -> bool:
    """Return True if a symmetric matrix is positive definite; tests its correlation matrix, so units do not matter."""
    variance = matrix.diagonal()
    if not (variance > 0).all():
        return False
    sigma = np.sqrt(variance)
    return bool(np.linalg.eigvalsh(matrix / sigma[:, None] / sigma).min(initial=1.0) > 0)
