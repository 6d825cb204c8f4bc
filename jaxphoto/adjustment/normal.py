"""Normal equations with the points eliminated: symbols, residuals and their square sum, factors of the points.

In scaled increments, with e the exterior orientations, s the shared unknowns and p the points,

        [ U    Us   W  ] [e]   [b_e]
    N = [ Us'  Uss  Ws'] [s] = [b_s]        V block-diagonal (3 x 3 a point), W 6 x 3 a (image, point) that met
        [ W'   Ws   V  ] [p]   [b_p]

Few rows couple points, D: distances, all that touches two points or a point and an image (`groups`), and the
constraints of the datum. Their part D'D of N is carried by extra unknowns mu = D x with the block -I, so V stays
block-diagonal. With V = L L', Y = W L^-T, Ys = L^-1 Ws, Yd = L^-1 D_p', and D_r the part of D for images and shared
unknowns:

    S   = [U Us; Us' Uss] - [Y; Ys'] [Y; Ys']'        the reduced normal matrix
    g   = D_r' - [Y; Ys'] Yd,   K = I + Yd' Yd        the coupling of mu
    A   = S + g K^-1 g'                               positive definite where the datum is fixed

Tile by tile, `reduced.reduce_normal` makes F = [Y; Ys'; Yd'] and sums S from it; `elimination` takes vectors down to
the reduced unknowns, and back to the points, by products with F.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Scalar

from jaxphoto.adjustment.groups import AtPoints
from jaxphoto.adjustment.residuals import Increments, Residuals, Values, state_at
from jaxphoto.adjustment.rows import other_residuals
from jaxphoto.adjustment.structure import Structure, total
from jaxphoto.adjustment.tiles import Pair, by_tile, each_tile, of_images, rows, scene_of, seen_in


class At(NamedTuple):
    """Where equations are linearised: `start + scale * increments`."""

    increments: Increments
    scale: Increments
    values: Values
    structure: Structure

    @property
    def state(self):
        """The unknowns there."""
        return state_at(self.increments, self.scale, self.values, self.structure)


class Reduced(NamedTuple):
    """The reduced normal matrix and what takes vectors down to it and back to the points."""

    diagonal: Float[Array, "reduced"]
    """Of A."""
    g: Float[Array, "reduced constraints"]
    k: Float[Array, "constraints constraints"]
    f: Float[Array, "chunks tiles f 3p"] | None
    """F of each tile: 6 rows an image, unknowns that points meet, constraints (coupled rows, then the datum); the
    last row, a right-hand side of its time, serves nothing. None where tiles are many: then it is made anew."""
    l: Float[Array, "6 points"]  # noqa: E741
    """Cholesky factors of V: l11, l21, l22, l31, l32, l33."""
    weight: Increments
    """The diagonal of N, without damping and D'D: what a unit of damping adds."""
    damping: Scalar


def norm2(x: Increments, weight: Increments, s: Structure) -> Float[Array, ""]:
    """x' diag(weight) x over all unknowns."""
    return dot(x, jax.tree.map(jnp.multiply, weight, x), s)


def dot(a: Increments, b: Increments, s: Structure) -> Float[Array, ""]:
    """a'b over all unknowns."""
    return jnp.vdot(a.eop, b.eop) + jnp.vdot(a.shared, b.shared) + total(jnp.vdot(a.points, b.points), s)


def residuals_at(at: At) -> Residuals:
    """All residuals over their sigmas."""
    increments, scale, values, s = at
    state, tiles = at.state, s.in_tiles
    scene = scene_of(state, values, s)

    def tile(image, points, xy, sigma):
        return jnp.stack(rows(of_images(scene, image, s), points, seen_in(xy, sigma, image, s), s))

    numbers = (tiles.image, by_tile(state.points, tiles), values.xy, values.sigma_xy)
    image = jax.vmap(jax.vmap(tile))(*numbers)
    return dataclasses.replace(other_residuals(increments, scale, values, s), image=image)


def square_sum(at: At) -> Float[Array, ""]:
    """The sum of all squared residuals, tile by tile."""
    increments, scale, values, s = at
    state = at.state
    scene = scene_of(state, values, s)

    def tile(numbers):
        image, points, xy, sigma = numbers
        return squares(rows(of_images(scene, image, s), points, seen_in(xy, sigma, image, s), s))

    image = each_tile_of(tile, (by_tile(state.points, s.in_tiles), values.xy, values.sigma_xy), s)
    return total(jnp.sum(image), s) + other_squares(other_residuals(increments, scale, values, s), s)


def squares(r: Pair) -> Float[Array, ""]:
    """The square sum of a tile's rows."""
    return sum((jnp.sum(v * v) for v in r), jnp.zeros(()))


def other_squares(others: Residuals, s: Structure) -> Float[Array, ""]:
    """The square sum of all but the image rows."""
    dealt_out, everywhere = jnp.zeros(()), jnp.sum(others.datum**2)
    for group, v in zip(s.observed, others.others, strict=True):
        if isinstance(group.rows, AtPoints):
            dealt_out += jnp.sum(v**2)
        else:
            everywhere += jnp.sum(v**2)
    return total(dealt_out, s) + everywhere


def each_tile_of(function, numbers, s: Structure):
    """`function` of (image, *numbers) of every tile, chunks and tiles first."""
    tiles = s.in_tiles
    given = ((tiles.image, *numbers), tiles.groups)
    return jax.lax.map(lambda chunk: each_tile(function, chunk[0], chunk[1], tiles), given)


def cholesky_3x3(v: Float[Array, "3 3 n"]) -> Float[Array, "6 n"]:
    """Closed form: LAPACK on a batch of 3 x 3 matrices is many times slower."""
    l11 = jnp.sqrt(v[0, 0])
    l21, l31 = v[1, 0] / l11, v[2, 0] / l11
    l22 = jnp.sqrt(v[1, 1] - l21**2)
    l32 = (v[2, 1] - l31 * l21) / l22
    return jnp.stack([l11, l21, l22, l31, l32, jnp.sqrt(v[2, 2] - l31**2 - l32**2)])


def whiten(w, l) -> tuple[Array, Array, Array]:  # noqa: E741
    """L^-1 w, component by component."""
    l11, l21, l22, l31, l32, l33 = l
    y1 = w[0] / l11
    y2 = (w[1] - y1 * l21) / l22
    return y1, y2, (w[2] - y1 * l31 - y2 * l32) / l33


def unwhiten(w, l) -> tuple[Array, Array, Array]:  # noqa: E741
    """L^-T w, component by component."""
    l11, l21, l22, l31, l32, l33 = l
    x3 = w[2] / l33
    x2 = (w[1] - l32 * x3) / l22
    return (w[0] - l21 * x2 - l31 * x3) / l11, x2, x3
