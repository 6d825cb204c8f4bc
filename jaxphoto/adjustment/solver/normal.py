"""Normal equations with eliminated points: symbols, residuals, sum of squares, factors of the points.

In scaled increments, with e the exterior orientations, s the shared unknowns and p the points,

        [ U    Us   W  ] [e]   [b_e]
    N = [ Us'  Uss  Ws'] [s] = [b_s]        V block-diagonal (3 x 3 per point), W 6 x 3 per ray
        [ W'   Ws   V  ] [p]   [b_p]

Few rows couple points, D: distances, all rows that involve two points or a point and an image
(`model.observed_groups`), and the datum constraints. Their part D'D of N is represented by extra unknowns mu = D x with
the block -I, so V stays block-diagonal. With V = L L', Y = W L^-T, Ys = L^-1 Ws, Yd = L^-1 D_p', and D_r the part of D
for images and shared unknowns:

    S   = [U Us; Us' Uss] - [Y; Ys'] [Y; Ys']'        the reduced normal matrix
    g   = D_r' - [Y; Ys'] Yd,   K = I + Yd' Yd        the coupling of mu
    A   = S + g K^-1 g'                               positive definite if the datum is fixed

`reduced.reduce_normal` computes F = [Y; Ys'; Yd'], the rows of Y by ray and the others by point, and sums S from it;
`elimination` uses products with F for elimination and back-substitution of vectors.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Scalar

from jaxphoto.adjustment.layout.padded import PaddedResiduals, PaddedStructure, PaddedValues
from jaxphoto.adjustment.model.image_orientations import of_images, orientations_of
from jaxphoto.adjustment.model.numbers import Increments, NonImageResiduals, UnknownArrays, state_at
from jaxphoto.adjustment.model.observed_groups import RowsAtPoints
from jaxphoto.adjustment.model.row_functions import non_image_residuals
from jaxphoto.adjustment.model.structure import total
from jaxphoto.adjustment.solver.ray_rows import Pair, points_at, ray_residuals, seen_in
from jaxphoto.arrays import sum_terms


class Linearised(NamedTuple):
    """Linearisation point: `start + scale * increments`."""

    increments: Increments
    scale: Increments
    values: PaddedValues
    structure: PaddedStructure

    @property
    def state(self) -> UnknownArrays:
        """Unknowns at the linearisation point."""
        return state_at(self.increments, self.scale, self.values, self.structure)

    @property
    def for_normal_equations(self) -> "Linearised":
        """Replace losses by their linearisation for normal equations."""
        return self._replace(structure=self.structure.with_linearised_losses)

    def constraints(self) -> Increments:
        """Return derivatives of the datum constraints, along a leading axis."""
        _, scale, values, s = self
        none = jnp.zeros((len(values.datum_eop), s.n_shared))
        return Increments(values.datum_eop * scale.eop, none, values.datum_points * scale.points)

    def residual_rows(self) -> "ResidualRows":
        """Evaluate all residuals over their sigmas, image rows by batch."""
        increments, scale, values, s = self
        image = s.each_ray(self._of_rays(), (values.xy, values.sigma_xy))
        return ResidualRows(image, non_image_residuals(increments, scale, values, s))

    def residuals(self) -> PaddedResiduals:
        """Evaluate all residuals over their sigmas at once, which allows reverse-mode differentiation."""
        increments, scale, values, s = self
        numbers = jnp.asarray(s.rays.chunk_image), s.ray_points, values.xy, values.sigma_xy
        image = jnp.stack(jax.vmap(self._of_rays())(numbers), axis=1)
        others = non_image_residuals(increments, scale, values, s)
        return PaddedResiduals(others.others, others.datum, others.names, image)

    def _of_rays(self) -> Callable[[tuple[Array, ...]], Pair]:
        state, s = self.state, self.structure
        scene = orientations_of(state, self.values, s)

        def of_batch(numbers: tuple[Array, ...]) -> Pair:
            image, point, xy, sigma = numbers
            seen = seen_in(xy, sigma, image, s)
            return ray_residuals(of_images(scene, image, s), points_at(state.points, point), seen, s)

        return of_batch

    def sum_of_squares(self) -> Float[Array, ""]:
        """Sum of all squared residuals."""
        return self.residual_rows().sum_of_squares(self.structure)


class ResidualRows(NamedTuple):
    """Residuals over their sigmas."""

    image: Pair
    """Image rows, batches first."""
    others: NonImageResiduals

    def sum_of_squares(self, s: PaddedStructure) -> Float[Array, ""]:
        """Sum of all squares."""
        return total(squares(self.image), s) + other_squares(self.others, s)


class Reduced(NamedTuple):
    """Reduced normal matrix, and the arrays for elimination and back-substitution of vectors."""

    diagonal: Float[Array, "reduced"]
    """Diagonal of A."""
    g: Float[Array, "reduced constraints"]
    k: Float[Array, "constraints constraints"]
    f: Float[Array, "batches chunks p d e"]
    """F of each ray: L^-1 times the coupling of its point and its image, e unknowns of the image (`RayLists.by_image`).
    """
    border: Float[Array, "points d c"]
    """F of each point: L^-1 times its coupling with the unknowns in `border_places`."""
    l: Float[Array, "6 points"]  # noqa: E741
    """Cholesky factors of V: l11, l21, l22, l31, l32, l33."""
    weight: Increments
    """Diagonal of N without damping and D'D: the matrix that damping multiplies."""
    damping: Scalar


def dot(a: Increments, b: Increments, s: PaddedStructure) -> Float[Array, ""]:
    """Return a'b over all unknowns."""
    return jnp.vdot(a.eop, b.eop) + jnp.vdot(a.shared, b.shared) + total(jnp.vdot(a.points, b.points), s)


def squares(r: Pair) -> Float[Array, ""]:
    """Return the sum of squares of image rows."""
    return sum_terms(jnp.sum(v * v) for v in r)


def other_squares(others: NonImageResiduals, s: PaddedStructure) -> Float[Array, ""]:
    """Return the sum of squares of all other rows."""
    dealt_out, everywhere = jnp.zeros(()), jnp.sum(others.datum**2)
    for group, v in zip(s.observed, others.others, strict=True):
        if isinstance(group.rows, RowsAtPoints):
            dealt_out += jnp.sum(v**2)
        else:
            everywhere += jnp.sum(v**2)
    return total(dealt_out, s) + everywhere
