"""Normal equations with the points eliminated: solution and products.

In scaled increments, with e the exterior orientations, s the shared unknowns and p the points,

        [ U    Us   W  ] [e]   [b_e]
    N = [ Us'  Uss  Ws'] [s] = [b_s]        V block-diagonal (3 x 3 a point), W 6 x 3 a (image, point) that met
        [ W'   Ws   V  ] [p]   [b_p]

Few rows couple many points: distances and the constraints of the datum, D. Their part D'D of N is carried by extra
unknowns mu = D x with the block -I, so V stays block-diagonal. With V = L L', Y = W L^-T, Ys = L^-1 Ws, Yd = L^-1 D':

    S   = [U Us; Us' Uss] - [Y; Ys'] [Y; Ys']'        the reduced normal matrix
    g   = D_e' - Y Yd,   K = I + Yd' Yd               the coupling of mu
    A   = S + g K^-1 g'                               positive definite where the datum is fixed

W is never kept: `reduced.reduce_normal` sums S tile by tile, and what else needs W is a product with the Jacobian,
forwards and backwards, by automatic differentiation (`image_products`).
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.band import BandFactor, solve_band
from jaxphoto.adjustment.residuals import Increments, Residuals, Values, other_residuals, state_at
from jaxphoto.adjustment.structure import Structure
from jaxphoto.adjustment.tiles import Pair, Scene, by_point, by_tile, each_tile, of_images, rows, scene_of, seen_in

AXIS = "tiles"
"""Mesh axis along which tiles and their points are dealt out to devices."""


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
    l: Float[Array, "6 points"]  # noqa: E741
    """Cholesky factors of V: l11, l21, l22, l31, l32, l33."""
    rows_e: Float[Array, "constraints images 6"]
    rows_p: Float[Array, "constraints 3 points"]
    """D: distances, then the constraints of the datum."""
    weight: Increments
    """The diagonal of N, without damping and D'D: what a unit of damping adds."""


def total(x, s: Structure):
    """The sum over all devices."""
    return jax.lax.psum(x, AXIS) if s.tiles is not None and s.tiles.shards > 1 else x


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
    scene = scene_of(state, s)

    def tile(image, points, xy, sigma):
        return jnp.stack(rows(of_images(scene, image, s), points, seen_in(xy, sigma, image, s), s))

    numbers = (tiles.image, by_tile(state.points, tiles), values.xy, values.sigma_xy)
    image = jax.vmap(jax.vmap(tile))(*numbers)
    return other_residuals(increments, scale, values, s)._replace(image=image)


def square_sum(at: At) -> Float[Array, ""]:
    """The sum of all squared residuals, tile by tile."""
    increments, scale, values, s = at
    state = at.state
    scene = scene_of(state, s)

    def tile(numbers):
        image, points, xy, sigma = numbers
        return squares(rows(of_images(scene, image, s), points, seen_in(xy, sigma, image, s), s))

    image = _each_tile(tile, (by_tile(state.points, s.in_tiles), values.xy, values.sigma_xy), s)
    return _square_sum(jnp.sum(image), other_residuals(increments, scale, values, s), s)


def squares(r: Pair) -> Float[Array, ""]:
    """The square sum of a tile's rows."""
    return sum((jnp.sum(v * v) for v in r), jnp.zeros(()))


def _square_sum(image: Float[Array, ""], others: Residuals, s: Structure) -> Float[Array, ""]:
    rest = sum(jnp.sum(v**2) for v in others._replace(image=jnp.zeros(0), control=jnp.zeros(0)))
    return total(image + jnp.sum(others.control**2), s) + rest


def _each_tile(function, numbers, s: Structure):
    """`function` of (image, *numbers) of every tile of every chunk."""
    joined = jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), (s.in_tiles.image, *numbers))
    return each_tile(function, joined, s.in_tiles)


def image_products(at: At, direction: Increments, want: Literal["images", "points", "all"]) -> Increments:
    """J'J x over the image rows.

    `want` says which part: "images" (with the shared unknowns), "points" or "all"; what is not wanted is zero.
    """
    increments, scale, values, s = at
    tiles = s.in_tiles
    scene, pull_scene = _scene_and_pull(at)
    turned = jax.jvp(lambda e, h: scene_of(state_at(increments._replace(eop=e, shared=h), scale, values, s), s),
                     (increments.eop, increments.shared), (direction.eop, direction.shared))[1]  # fmt: skip
    points = values.points + increments.points * scale.points

    def tile(numbers):
        image, point, moved, xy, sigma = numbers
        seen, place = seen_in(xy, sigma, image, s), of_images(scene, image, s)
        f = jax.jit(lambda scene, point: rows(scene, point, seen, s))
        change = jax.jvp(f, (place, point), (of_images(turned, image, s), moved))[1]
        to_scene, to_point = jax.vjp(f, place, point)[1](change)
        return (to_scene if want != "points" else None), (to_point if want != "images" else None)

    numbers = (by_tile(v, tiles) for v in (points, direction.points * scale.points))
    to_scene, to_point = _each_tile(tile, (*numbers, values.xy, values.sigma_xy), s)
    eop, shared, to_points = jax.tree.map(jnp.zeros_like, increments)
    if want != "points":
        eop, shared = pull_scene(total(_by_image(to_scene, scene, s), s))
    if want != "images":
        to_points = by_point(to_point.reshape(*tiles.image.shape[:2], *to_point.shape[1:])) * scale.points
    return Increments(eop, shared, to_points)


def gradient(at: At, l: Float[Array, "6 points"], rows_p: Float[Array, "k 3 points"]):  # noqa: E741
    """b = J'r over all rows, taken down with the points' factors `l`, and the square sum of the residuals.

    Returns b, its reduced part, the part for mu, and r'r. Down goes -J_e' J_p V^-1 b_p with the Jacobian at hand, so
    one pass over the tiles does it.
    """
    increments, scale, values, s = at
    tiles = s.in_tiles
    others, pull_others = jax.vjp(lambda y: other_residuals(y, scale, values, s), increments)
    b_others = pull_others(others)[0]
    scene, pull_scene = _scene_and_pull(at)
    points = values.points + increments.points * scale.points

    def tile(numbers):
        image, point, step, other, factors, xy, sigma = numbers
        seen, place = seen_in(xy, sigma, image, s), of_images(scene, image, s)
        f = jax.jit(lambda scene, point: rows(scene, point, seen, s))
        r, pull = jax.vjp(f, place, point)
        to_scene, to_point = pull(r)
        b = to_point * step + other
        across = jax.jvp(lambda x: f(place, x), (point,), (solve_3x3(factors, b) * step,))[1]
        return to_scene, pull(across)[0], b, squares(r)

    numbers = (by_tile(v, tiles) for v in (points, scale.points, b_others.points, l))
    to_scene, down, b, square = _each_tile(tile, (*numbers, values.xy, values.sigma_xy), s)
    (e, h), (e_down, h_down) = (pull_scene(total(_by_image(v, scene, s), s)) for v in (to_scene, down))
    b_p = by_point(b.reshape(*tiles.image.shape[:2], *b.shape[1:]))
    b = Increments(e + b_others.eop, h + b_others.shared, b_p)
    right = jnp.concatenate([(b.eop - e_down).T.reshape(-1), b.shared - h_down])
    return b, right, jnp.einsum("ckp,kp->c", rows_p, solve_3x3(l, b_p)), _square_sum(jnp.sum(square), others, s)


def _scene_and_pull(at: At):
    """The scene, and what takes its cotangents to increments of images and shared unknowns."""
    increments, scale, values, s = at

    def scene_at(eop, shared):
        return scene_of(state_at(increments._replace(eop=eop, shared=shared), scale, values, s), s)

    return jax.vjp(scene_at, increments.eop, increments.shared)


def _by_image(parts: Scene, scene: Scene, s: Structure) -> Scene:
    """Cotangents of tiles, added by image (and over all tiles, for the only camera of a group)."""
    image, n = s.in_tiles.image.reshape(-1), scene.centre.shape[0]

    def of_image(v):
        return jax.ops.segment_sum(v.reshape(-1, *v.shape[2:]), image, n)

    cameras = tuple(
        jnp.sum(v, axis=0) if len(g.names) == 1 else of_image(v) for g, v in zip(s.groups, parts.cameras, strict=True)
    )
    return Scene(of_image(parts.centre), of_image(parts.rotation), cameras)


def solve_factored(at: At, reduced: Reduced, factor: BandFactor, b: Increments) -> Increments:
    """x of (N + damping diag(N)) x = b: down to the reduced unknowns, and back to the points."""
    z = solve_3x3(reduced.l, b.points)
    zero = jax.tree.map(jnp.zeros_like, b)
    down = image_products(at, zero._replace(points=z), "images")
    right = jnp.concatenate([(b.eop - down.eop).T.reshape(-1), b.shared - down.shared])
    return solve_reduced(at, reduced, factor, right, jnp.einsum("ckp,kp->c", reduced.rows_p, z), b.points)


def solve_reduced(at: At, reduced: Reduced, factor: BandFactor, right, d, b_points) -> Increments:
    """The same with the right-hand side taken down already: `right` to the reduced unknowns, `d` to mu."""
    r, n = reduced, at.structure.n_images
    if len(d):
        right = right - r.g @ jnp.linalg.solve(r.k, d)
    x = solve_band(factor, right)
    e, sh = x[: 6 * n].reshape(n, 6).T, x[6 * n :]
    across = image_products(at, Increments(e, sh, jnp.zeros_like(b_points)), "points").points
    if len(d):
        across = across + jnp.einsum("ckp,c->kp", r.rows_p, jnp.linalg.solve(r.k, r.g.T @ x + d))
    return Increments(e, sh, solve_3x3(r.l, b_points - across))


def solve_3x3(l: Float[Array, "6 *n"], b: Float[Array, "3 *n"]) -> Float[Array, "3 *n"]:  # noqa: E741
    """V^-1 b from the Cholesky factors of V."""
    l11, l21, l22, l31, l32, l33 = l
    y1, y2, y3 = whiten(b, l)
    x3 = y3 / l33
    x2 = (y2 - l32 * x3) / l22
    return jnp.stack([(y1 - l21 * x2 - l31 * x3) / l11, x2, x3])


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
