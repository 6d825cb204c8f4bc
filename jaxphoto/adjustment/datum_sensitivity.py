"""Sensitivity of the observations to the seven datum motions, under any change of the declared unknowns.

Unknowns determined by their own rows, such as priors and differences between knots of a trajectory, cannot compensate a
motion that changes no row. There may be thousands: their rows are sparse, only their normal matrix is full.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxphoto.adjustment.layout.rays import size_class
from jaxphoto.adjustment.model.numbers import Values, zero_increments
from jaxphoto.adjustment.model.row_functions import row_jacobian
from jaxphoto.adjustment.model.structure import Structure
from jaxphoto.adjustment.solver.similarity import DatumRows
from jaxphoto.compiling import jit_quickly

# Singular values of a scaled sensitivity below this are zero.
_OPEN = 1e-9
# Squared singular values below this are zero: limit of double precision.
_OPEN_SQUARED = 1e-13
# Squared singular values above this are nonzero, whatever the rounding errors.
_PLAIN = 1e-10
# Number of rows per column that are triangularised at a time.
_WIDE = 4
# Row counts are padded to a multiple of this for compilation.
_ROWS = 64


@dataclass(frozen=True)
class SeenMotions:
    """d(rows / sigma) / d(motions, declared unknowns): columns of the seven motions, then one per unknown."""

    placed: scipy.sparse.csr_array
    """Rows that involve images or points."""
    alone: scipy.sparse.csr_array
    """Rows that involve only declared unknowns."""

    def null_motions(self) -> Float[np.ndarray, "defect 7"]:
        """Return orthonormal combinations of the seven motions that change no row; unknowns may compensate them.

        Unknowns determined by their own rows may not: these rows would change.
        """
        open_ones = np.setdiff1d(np.arange(7, self.alone.shape[1]), self.determined)
        kept = np.concatenate([np.arange(7), open_ones])
        sensitivity = scipy.sparse.vstack([self.placed, self.alone]).tocsr()[:, kept].toarray()
        # Most rows are zero in these columns.
        sensitivity = sensitivity[sensitivity.any(axis=1)]
        if not len(sensitivity):
            return np.eye(7)
        # Motions have similar size by construction; scale the unknowns accordingly.
        norm = np.sqrt((sensitivity**2).sum(0))
        norm[:7] = norm[:7].max()
        norm = np.where(norm > 0, norm, 1.0)
        # The triangular factor has the same singular values and right singular vectors, and no more rows than columns.
        _, s, vt = np.linalg.svd(np.linalg.qr(sensitivity / norm, mode="r"), full_matrices=True)
        rank = int((s > _OPEN * max(s.max(initial=0.0), 1e-300)).sum())
        if np.abs(vt[rank:, :7]).max(initial=0.0) < _OPEN:
            # Null vectors of unknowns alone, such as rates of a camera, do not move the block: their motion components
            # are rounding errors.
            return np.zeros((0, 7))
        null = (vt[rank:] / norm)[:, :7]
        _, s2, basis = np.linalg.svd(null / max(np.abs(null).max(initial=0.0), 1e-300), full_matrices=False)
        return basis[s2 > 1e-9]

    def weak_motions(self, sigma: float) -> tuple[Float[np.ndarray, "weak 7"], float]:
        """Return the combinations of motions whose rotations and scale have a standard deviation above `sigma` (rad),
        and the largest standard deviation.

        Unknowns compensate a motion only as far as the sigmas of their own rows permit.
        """
        rows = scipy.sparse.vstack([self.placed, self.alone]).tocsr()
        normal = (rows.T @ rows).toarray()
        gone = self.determined
        kept = np.setdiff1d(np.arange(len(normal)), gone)
        normal = _eliminated(normal[np.ix_(kept, kept)], normal[np.ix_(kept, gone)], normal[np.ix_(gone, gone)])
        squares, directions = np.linalg.eigh(_eliminated(normal[:7, :7], normal[:7, 7:], normal[7:, 7:]))
        # Use rotations and scale only: shifts that accompany them are determined.
        found = np.linalg.norm(directions[3:], axis=0) / np.sqrt(np.maximum(squares, 1e-300))
        return directions.T[found > sigma], float(found.max())

    @classmethod
    def of_motions(cls, rows: Float[np.ndarray, "rows 7"]) -> "SeenMotions":
        """Create from rows that depend only on motions."""
        return cls(scipy.sparse.csr_array(rows), scipy.sparse.csr_array((0, 7)))

    def with_motions(self, rows: Float[np.ndarray, "rows 7"]) -> "SeenMotions":
        """Append rows that depend only on motions."""
        more = scipy.sparse.csr_array(np.pad(rows, [(0, 0), (0, self.placed.shape[1] - 7)]))
        return replace(self, placed=scipy.sparse.vstack([self.placed, more]).tocsr())

    @cached_property
    def determined(self) -> Int[np.ndarray, "k"]:
        """Return columns of unknowns determined by their own rows, testing each connected set of unknowns jointly."""
        own = self.alone[:, 7:].tocsc()
        count, part = scipy.sparse.csgraph.connected_components(own.T @ own, directed=False)
        found = [np.zeros(0, int)]
        for columns in (np.flatnonzero(part == k) for k in range(count)):
            rows = own[:, columns].tocsr()
            rows = rows[np.diff(rows.indptr) > 0]
            if rows.shape[0] >= len(columns) and _determines_all(rows):
                found.append(7 + columns)
        return np.sort(np.concatenate(found))


def _determines_all(rows: scipy.sparse.csr_array) -> bool:
    """Return True if rows determine each of their columns. Most of 100,000 rows are never converted to dense form."""
    n = rows.shape[1]
    rows = rows @ scipy.sparse.diags_array(1 / np.sqrt(rows.power(2).sum(axis=0)))
    squares = np.linalg.eigvalsh((rows.T @ rows).toarray())
    if squares[0] > _PLAIN * squares[-1]:
        return True
    # Otherwise the squares are inconclusive. The triangular factor has the same singular values as `rows`.
    triangle: np.ndarray = np.zeros((0, n))
    for first in range(0, rows.shape[0], _WIDE * n):
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, rows[first : first + _WIDE * n].toarray()]), mode="r"))
    s = np.linalg.svd(triangle, compute_uv=False)
    return bool(s[-1] > _OPEN * s[0])


def _eliminated(
    kept: Float[np.ndarray, "n n"], cross: Float[np.ndarray, "n k"], gone: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, "n n"]:
    """Eliminate some unknowns from the normal matrix; unknowns that occur in no row change nothing."""
    size = np.sqrt(np.diag(gone))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(gone / size / size[:, None])
    seen = values > _OPEN_SQUARED * values.max(initial=0.0)
    half = (cross / size) @ vectors[:, seen] / np.sqrt(values[seen])
    return kept - half @ half.T


def row_sensitivity(
    values: Values, s: Structure, motions: DatumRows, chosen: Int[np.ndarray, "unknowns"]
) -> SeenMotions:
    """Return the sensitivity of all rows except image rows, which no motion changes; `chosen` are shared unknowns."""
    width = 7 + len(chosen)
    # Append a column for missing unknowns and unknowns not chosen.
    place = np.full(s.n_shared + 1, width)
    place[chosen] = 7 + np.arange(len(chosen))
    found: dict[bool, list[scipy.sparse.csr_array]] = {
        True: [scipy.sparse.csr_array((0, width))],
        False: [scipy.sparse.csr_array((0, width))],
    }
    for g, slope in zip(s.observed, jax.device_get(_slopes(*_in_few_sizes(values, s), motions)), strict=True):
        by_motion, by_shared = (v[..., : g.n_rows] for v in slope)
        own = np.broadcast_to(place[g.column], by_shared.shape)
        columns = np.concatenate([np.broadcast_to(np.arange(7)[:, None], by_motion.shape), own], axis=1)
        numbers = np.concatenate([by_motion, by_shared], axis=1)
        row = np.broadcast_to(np.arange(g.components * g.n_rows).reshape(g.components, 1, -1), numbers.shape)
        shape = g.components * g.n_rows, width + 1
        rows = scipy.sparse.coo_array((numbers.ravel(), (row.ravel(), columns.ravel())), shape).tocsr()[:, :width]
        rows.eliminate_zeros()
        found[bool(len(g.image) or len(g.point))].append(rows)
    return SeenMotions(scipy.sparse.vstack(found[True]).tocsr(), scipy.sparse.vstack(found[False]).tocsr())


def _in_few_sizes(values: Values, s: Structure) -> tuple[Values, Structure]:
    """Drop image rows and pad the other groups to few sizes.

    A search for blunders removes one or two rows at a time, and each size is compiled separately.
    """
    observed, numbers = [], []
    for g, own in zip(s.observed, values.groups, strict=True):
        # A few rows with many components may fill the memory.
        more = size_class(g.n_rows, max(1, _ROWS // g.components)) - g.n_rows

        def longer(v: Any, more: int = more) -> np.ndarray:
            return np.concatenate([v, np.repeat(v[..., :1], more, axis=-1)], axis=-1)

        names = ("rows", "image", "point", "parameter", "column")
        padded = {name: jax.tree.map(longer, getattr(g, name)) for name in names}
        observed.append(replace(g, **padded, pair=np.zeros((0, g.n_rows + more, 4), np.int32)))
        numbers.append(jax.tree.map(longer, own))
    none: Any = np.zeros((2, 0))
    nowhere = np.zeros(0, np.int32)
    return (
        replace(values, groups=tuple(numbers), xy=none, sigma_xy=none),
        replace(s, observed=tuple(observed), image=nowhere, point=nowhere, labels=()),
    )


@jit_quickly
def _slopes(values: Values, s: Structure, motions: DatumRows):
    """Return derivatives of the rows of each group with respect to the motions and the shared unknowns they involve."""
    zero = zero_increments(s)
    one = jax.tree.map(jnp.ones_like, zero)
    slopes = []
    for g, numbers in zip(s.observed, values.groups, strict=True):
        row = row_jacobian(g, numbers, zero, one, values, s)
        # Rows last, with the components of one image or point each.
        by_motion = jnp.einsum("ckar,makr->cmr", row.eop, jnp.asarray(motions.eop)[..., g.image])
        by_motion += jnp.einsum("cjar,majr->cmr", row.points, jnp.asarray(motions.points)[..., g.point])
        slopes.append((by_motion, row.shared))
    return slopes
