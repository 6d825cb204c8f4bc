"""Normal equations with the points eliminated: sums, reduction, solution, inverse.

In scaled increments, with e the exterior orientations, s the shared unknowns and p the points,

        [ U    Us   W  ] [e]   [b_e]
    N = [ Us'  Uss  Ws'] [s] = [b_s]        V block-diagonal (3 x 3 a point), W 6 x 3 a (image, point) that met
        [ W'   Ws   V  ] [p]   [b_p]

Few rows couple many points: distances and the constraints of the datum, D. Their part D'D of N is carried by extra
unknowns mu = D x with the block -I, so V stays block-diagonal. With V = L L', Y = W L^-T, Ys = L^-1 Ws, Yd = L^-1 D':

    S   = [U Us; Us' Uss] - [Y; Ys'] [Y; Ys']'        the reduced normal matrix
    g   = D_e' - Y Yd,   K = I + Yd' Yd               the coupling of mu
    A   = S + g K^-1 g'                               positive definite where the datum is fixed

Once a block: the lists of `Structure`. Once an iterate: the sums (`sum_normal`). Once a damping: `reduce_normal`
and `factor_reduced`. Once a right-hand side: `solve_factored`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.colouring import Jacobian
from jaxphoto.adjustment.residuals import Increments, Residuals
from jaxphoto.adjustment.structure import Structure
from jaxphoto.adjustment.sums import (
    image_products,
    met_by_image,
    pair_sums,
    products,
    shared_point_sums,
    shared_sums,
    with_zero_row,
)


class Normal(NamedTuple):
    """The undamped sums; see the module's head. `rows_*` are D; `b` is the whole right-hand side J' r."""

    u: Float[Array, "images 6 6"]
    us: Float[Array, "images 6 shared"]
    uss: Float[Array, "shared shared"]
    v: Float[Array, "3 3 points"]
    w: Float[Array, "6 3 rows"]
    ws: Float[Array, "shared 3 points"]
    b: Increments
    rows_e: Float[Array, "constraints images 6"]
    rows_p: Float[Array, "constraints 3 points"]


class Reduced(NamedTuple):
    """The reduced normal matrix and what takes vectors down to it and back to the points."""

    a: Float[Array, "reduced reduced"]
    """Lower triangle of A (the upper is not filled)."""
    g: Float[Array, "reduced constraints"]
    k: Float[Array, "constraints constraints"]
    l: Float[Array, "6 points"]  # noqa: E741
    """Cholesky factors of V: l11, l21, l22, l31, l32, l33."""


def sum_normal(jacobian: Jacobian, residuals: Residuals, datum: tuple[Array, Array], structure: Structure) -> Normal:
    """The sums of N x = b from Jacobian blocks and residuals (so b = J' r); `datum` is D over images and points."""
    s, j, r = structure, jacobian, residuals
    q = s.n_colours
    pad = jnp.zeros((q - s.n_image_colours, 2, len(s.image)))
    image_rows = jnp.concatenate([j.image_eop, j.image_shared, pad, r.image[None]])
    station_rows = jnp.concatenate([j.station_eop, j.station_shared, r.stations[None]])[:, None]
    attitude_rows = jnp.concatenate([j.attitude_eop, j.attitude_shared, r.attitudes[None]])
    m = (
        image_products(image_rows, s)
        + products(station_rows, s.station_image, s.n_images)
        + products(attitude_rows, s.attitude_image, s.n_images)
    )
    us, uss, b_s = shared_sums(m, s)
    uss = uss.at[s.weighted, s.weighted].add(j.priors**2)
    b_s = b_s.at[s.weighted].add(j.priors * r.priors)

    point_rows = jnp.concatenate([j.image_point, r.image[None]])
    vp = products(point_rows, s.point, s.n_points, is_sorted=True)
    vp = vp + products(jnp.concatenate([j.control, r.control[None]])[:, None], s.control_point, s.n_points)
    vp = vp.transpose(1, 2, 0)
    ws = shared_point_sums(jnp.einsum("qon,bon->nqb", j.image_shared, j.image_point), s)

    each = jnp.arange(len(s.distance_points))
    spans = jnp.zeros((len(s.distance_points), 3, s.n_points))
    for end in range(2):
        spans = spans.at[each, :, s.distance_points[:, end]].add(j.distances[end].T)
    datum_e = datum[0].transpose(0, 2, 1)
    rows_e = jnp.concatenate([jnp.zeros((len(each), *datum_e.shape[1:])), datum_e])
    rows_p = jnp.concatenate([spans, datum[1]])
    d = jnp.concatenate([r.distances, r.datum])
    return Normal(
        u=m[:, :6, :6],
        us=us,
        uss=uss,
        v=vp[:3, :3],
        w=j.image_eop[:, None, 0] * j.image_point[None, :, 0] + j.image_eop[:, None, 1] * j.image_point[None, :, 1],
        ws=ws,
        b=Increments(
            m[:, :6, -1].T + jnp.einsum("cna,c->an", rows_e, d), b_s, vp[:3, 3] + jnp.einsum("ckp,c->kp", rows_p, d)
        ),
        rows_e=rows_e,
        rows_p=rows_p,
    )


def zero_normal(structure: Structure, n_constraints: int) -> Normal:
    """No sums at all, in the right shapes."""
    s, k = structure, len(structure.distance_points) + n_constraints
    n, q, p = s.n_images, s.n_shared, s.n_points
    return Normal(
        u=jnp.zeros((n, 6, 6)),
        us=jnp.zeros((n, 6, q)),
        uss=jnp.zeros((q, q)),
        v=jnp.zeros((3, 3, p)),
        w=jnp.zeros((6, 3, len(s.image))),
        ws=jnp.zeros((q, 3, p)),
        b=Increments(jnp.zeros((6, n)), jnp.zeros(q), jnp.zeros((3, p))),
        rows_e=jnp.zeros((k, n, 6)),
        rows_p=jnp.zeros((k, 3, p)),
    )


def multiply_normal(normal: Normal, x: Increments, structure: Structure) -> Increments:
    """N x, block by block."""
    n, s = normal, structure
    mu = jnp.einsum("cna,an->c", n.rows_e, x.eop) + jnp.einsum("ckp,kp->c", n.rows_p, x.points)
    met = jnp.einsum("akn,kn->na", n.w, x.points[:, s.point])
    seen = jnp.einsum("akn,an->nk", n.w, x.eop[:, s.image])
    eop = jnp.einsum("nab,bn->an", n.u, x.eop) + jnp.einsum("naq,q->an", n.us, x.shared)
    eop += jax.ops.segment_sum(met, s.image, s.n_images).T + jnp.einsum("cna,c->an", n.rows_e, mu)
    shared = jnp.einsum("naq,an->q", n.us, x.eop) + n.uss @ x.shared + jnp.einsum("qkp,kp->q", n.ws, x.points)
    points = jnp.einsum("kjp,jp->kp", n.v, x.points) + jnp.einsum("qkp,q->kp", n.ws, x.shared)
    points += jax.ops.segment_sum(seen, s.point, s.n_points, indices_are_sorted=True).T
    return Increments(eop, shared, points + jnp.einsum("ckp,c->kp", n.rows_p, mu))


def reduce_normal(normal: Normal, damping, structure: Structure) -> Reduced:
    """Eliminate the points of N + damping I. Unknowns held fixed (zero columns) get a unit diagonal."""
    n, s = normal, structure
    v = n.v + (damping + jnp.where(jnp.einsum("iip->ip", n.v) == 0, 1.0, 0.0))[:, None] * jnp.eye(3)[:, :, None]
    u = n.u + (damping + jnp.where(jnp.einsum("nii->ni", n.u) == 0, 1.0, 0.0))[:, :, None] * jnp.eye(6)
    uss = n.uss + damping * jnp.eye(s.n_shared)
    l = _cholesky_3x3(v)  # noqa: E741
    y = _whiten(n.w, l[:, s.point])
    ys, yd = _whiten(n.ws, l), _whiten(n.rows_p, l)

    rows = with_zero_row(y)
    blocks = -pair_sums(rows, s)
    see = jnp.zeros((s.n_images, 6, s.n_images, 6))
    see = see.at[s.block_row, :, s.block_column, :].set(blocks, unique_indices=True)
    each = jnp.arange(s.n_images)
    see = see.at[each, :, each, :].add(u, unique_indices=True)

    # What meets an image through its points: shared unknowns and mu.
    across = jnp.concatenate([ys, yd])
    met = met_by_image(rows, across, s)
    own = jnp.einsum("akp,bkp->ab", across, across)
    q, k, size = s.n_shared, len(yd), 6 * s.n_images
    se = (n.us - met[:, :, :q]).reshape(size, q)
    a = jnp.block([[see.reshape(size, size), jnp.zeros((size, q))], [se.T, uss - own[:q, :q]]])
    ge = n.rows_e.transpose(1, 2, 0) - met[:, :, q:]
    g = jnp.concatenate([ge.reshape(size, k), -own[:q, q:]])
    kk = jnp.eye(k) + own[q:, q:]
    if k:
        a = a + g @ jnp.linalg.solve(kk, g.T)
    return Reduced(a, g, kk, l)


def factor_reduced(reduced: Reduced) -> Float[Array, "reduced reduced"]:
    """Lower Cholesky factor of A; NaN where A is not positive definite."""
    return jax.lax.linalg.cholesky(reduced.a, symmetrize_input=False)


def solve_factored(
    normal: Normal, reduced: Reduced, lower: Float[Array, "reduced reduced"], b: Increments, structure: Structure
) -> Increments:
    """x of (N + damping I) x = b: down to the reduced unknowns, and back to the points."""
    n, r, s = normal, reduced, structure
    z = solve_3x3(r.l, b.points)
    down = jnp.einsum("akn,kn->na", n.w, z[:, s.point])
    b_e = b.eop.T - jax.ops.segment_sum(down, s.image, s.n_images)
    right = jnp.concatenate([b_e.reshape(-1), b.shared - jnp.einsum("qkp,kp->q", n.ws, z)])
    d = jnp.einsum("ckp,kp->c", n.rows_p, z)
    if len(d):
        right = right - r.g @ jnp.linalg.solve(r.k, d)
    x = jax.scipy.linalg.cho_solve((lower, True), right)

    e, sh = x[: 6 * s.n_images].reshape(s.n_images, 6).T, x[6 * s.n_images :]
    seen = jnp.einsum("akn,an->nk", n.w, e[:, s.image])
    b_p = b.points - jax.ops.segment_sum(seen, s.point, s.n_points, indices_are_sorted=True).T
    b_p = b_p - jnp.einsum("qkp,q->kp", n.ws, sh)
    if len(d):
        b_p = b_p - jnp.einsum("ckp,c->kp", n.rows_p, jnp.linalg.solve(r.k, r.g.T @ x + d))
    return Increments(e, sh, solve_3x3(r.l, b_p))


def solve_3x3(l: Float[Array, "6 points"], b: Float[Array, "3 points"]) -> Float[Array, "3 points"]:  # noqa: E741
    """V^-1 b from the Cholesky factors of V."""
    l11, l21, l22, l31, l32, l33 = l
    y1, y2, y3 = _whiten(b[None], l)[0]
    x3 = y3 / l33
    x2 = (y2 - l32 * x3) / l22
    return jnp.stack([(y1 - l21 * x2 - l31 * x3) / l11, x2, x3])


def _cholesky_3x3(v: Float[Array, "3 3 points"]) -> Float[Array, "6 points"]:
    """Closed form: LAPACK on a batch of 3 x 3 matrices is many times slower."""
    l11 = jnp.sqrt(v[0, 0])
    l21, l31 = v[1, 0] / l11, v[2, 0] / l11
    l22 = jnp.sqrt(v[1, 1] - l21**2)
    l32 = (v[2, 1] - l31 * l21) / l22
    return jnp.stack([l11, l21, l22, l31, l32, jnp.sqrt(v[2, 2] - l31**2 - l32**2)])


def _whiten(w: Float[Array, "m 3 n"], l: Float[Array, "6 n"]) -> Float[Array, "m 3 n"]:  # noqa: E741
    """w L^-T for each of n factors."""
    l11, l21, l22, l31, l32, l33 = l
    y1 = w[:, 0] / l11
    y2 = (w[:, 1] - y1 * l21) / l22
    return jnp.stack([y1, y2, (w[:, 2] - y1 * l31 - y2 * l32) / l33], axis=1)
