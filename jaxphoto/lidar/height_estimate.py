"""Height of one place from its nearest points: weights, standard deviation, flags."""

import enum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.errors import InputError
from jaxphoto.lidar.sight import empty_about, surrounded


class HeightFlag(enum.IntFlag):
    """Problems of a height; several may apply."""

    OK = 0
    HOLE = 1
    """No point is close enough, given the density of the surrounding points."""
    EDGE = 2
    """The nearest points do not surround the place: it would be extrapolated."""
    VEGETATION = 4
    """The nearest points are vegetation or of several returns, or too rough for a surface."""
    BREAKLINE = 8
    """The nearest points lie on two surfaces: wall, ridge, kerb."""
    PLANE = 16
    """`local` fitted a plane to the nearest points, which do not determine a quadratic; not refused."""


REFUSED = HeightFlag.HOLE | HeightFlag.EDGE | HeightFlag.VEGETATION | HeightFlag.BREAKLINE


class HeightSettings(eqx.Module):
    """Settings of height interpolation, and errors of the lidar.

    `points` is the number of nearest points of `idw` and `plane`; if `radius_m` is given they use all points within it
    instead. `local` uses three times `points`, at least 24. `power` is that of `idw`. Standard deviations are those of
    a laser point in Z and in each of X and Y, and of the common error of all points. A place is flagged if the fraction
    `leafy_share` of the points used is vegetation or of several returns; heights with a flag of `refuse` are NaN.
    """

    points: int = 8
    power: float = 2.0
    radius_m: float | None = None
    sigma_z_m: float = 0.15
    sigma_xy_m: float = 0.5
    sigma_systematic_m: float = 0.0
    leafy_share: float = 0.25
    refuse: HeightFlag = REFUSED

    def __check_init__(self) -> None:
        if self.points < 4:
            raise InputError(f"points is {self.points}, and heights need 4 points at least: give 4 or more")
        for name in ("power", "sigma_z_m", "radius_m"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value}: give a positive number")
        for name in ("sigma_xy_m", "sigma_systematic_m", "leafy_share"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InputError(f"{name} is {getattr(self, name)}: give a number that is not negative")


# Local least-squares surface through the points around a place.
#
# With x, y the offsets of a point from the place (m), and its height Z over some reference,
#
#     Z = h + g_x x + g_y y + (h_xx x^2 + 2 h_xy x y + h_yy y^2) / 2
#
# is a quadratic; without its last term, a plane. The fit is linear in the heights: `coefficients = rows @ z`, so every
# standard deviation follows from `rows`.

# Ratio of a pivot to its diagonal element: points collinear to 1e-4 of their distances.
_SINGULAR = 1e-8


class Neighbours(NamedTuple):
    """Points nearest to one place, nearest first; padded with points that are not `there`."""

    xy: Float[ArrayLike, "points 2"]
    """Offsets from the place (m)."""
    z: Float[ArrayLike, "points"]
    """Heights over that of the nearest point (m)."""
    distance: Float[ArrayLike, "points"]
    there: Bool[ArrayLike, "points"]


class LocalFit(NamedTuple):
    """Fitted surface."""

    coefficients: Float[Array, "6"]
    """h (m), g_x, g_y, h_xx, h_xy, h_yy (1/m)."""
    rows: Float[Array, "6 points"]
    variance: Float[Array, ""]
    """Residual sum of squares over the degrees of freedom (m^2)."""
    freedom: Float[Array, ""]
    """Number of points minus number of coefficients."""
    determined: Bool[Array, ""]
    """True if there are more points than coefficients, and they do not lie on a line or conic."""

    @property
    def interpolates(self) -> Bool[Array, ""]:
        """Return True if the height at the place is better than a single point: otherwise it is extrapolated."""
        return self.determined & (jnp.sum(self.rows[0] ** 2) <= 1)


def terms(xy: Float[ArrayLike, "points 2"]) -> Float[Array, "points 6"]:
    """Return the monomials of the coefficients."""
    x, y = xy[:, 0], xy[:, 1]
    return jnp.stack([jnp.ones_like(x), x, y, x**2 / 2, x * y, y**2 / 2], axis=1)


def fit_surface(near: Neighbours, weight: Float[ArrayLike, "points"], quadratic: bool) -> LocalFit:
    """Fit by weighted least squares; the weights of missing points are zero.

    The residual variance is that of the points of positive weight, each counted once.
    """
    weight = jnp.where(near.there, weight, 0.0)
    used = weight > 0
    n_used = jnp.sum(used)
    # Centred and in units of the farthest point, for the best condition of the normal matrix.
    middle = jnp.sum(jnp.where(used[:, None], near.xy, 0.0), axis=0) / jnp.maximum(n_used, 1)
    offset = jnp.where(used[:, None], near.xy - middle, 0.0)
    unit = jnp.sqrt(jnp.max(jnp.sum(offset**2, axis=1)))
    unit = jnp.where(unit > 0, unit, 1.0)
    n = 6 if quadratic else 3
    basis = jnp.where(used[:, None], terms(offset / unit)[:, :n], 0.0)
    rows, regular = _solve(basis.T @ (weight[:, None] * basis), (weight[:, None] * basis).T)
    determined = regular & (n_used > n)
    rows = jnp.where(determined, rows, 0.0)
    z = jnp.where(used, near.z, 0.0)
    residual = z - basis @ (rows @ z)
    rows = _seen_from_place(-middle / unit, unit)[:, :n] @ rows
    freedom = n_used - n
    return LocalFit(rows @ z, rows, jnp.sum(residual**2) / jnp.maximum(freedom, 1), freedom.astype(float), determined)


def _seen_from_place(at: Float[Array, "2"], unit: Float[Array, ""]) -> Float[Array, "6 6"]:
    """Transform coefficients about the centre (per unit) to those about the place (per m), which is at `at`."""
    x, y = at
    zero, one = jnp.zeros(()), jnp.ones(())
    by_x, by_y = jnp.stack([zero, one, zero, x, y, zero]), jnp.stack([zero, zero, one, zero, x, y])
    moved = jnp.concatenate([terms(at[None]), by_x[None], by_y[None], jnp.eye(6)[3:]])
    return moved * unit ** -jnp.array([0.0, 1, 1, 2, 2, 2])[:, None]


def _solve(
    normal: Float[Array, "n n"], right: Float[Array, "n points"]
) -> tuple[Float[Array, "n points"], Bool[Array, ""]]:
    """Solve by Cholesky factorisation; False if a pivot is close to zero.

    Written out: for many places each step is one operation on long vectors, while LAPACK is called once per place.
    """
    n = len(normal)
    factor: list[list[Array]] = [[] for _ in range(n)]
    solved: list[Array] = []
    regular = jnp.array(True)
    for i in range(n):
        for j in range(i):
            inner = sum((factor[i][k] * factor[j][k] for k in range(j)), jnp.zeros(()))
            factor[i].append((normal[i, j] - inner) / factor[j][j])
        pivot = normal[i, i] - sum((v**2 for v in factor[i]), jnp.zeros(()))
        positive = pivot > _SINGULAR * normal[i, i]
        regular &= positive
        factor[i].append(jnp.sqrt(jnp.where(positive, pivot, 1.0)))
        solved.append((right[i] - sum((factor[i][k] * solved[k] for k in range(i)), jnp.zeros(()))) / factor[i][i])
    for i in reversed(range(n)):
        above = sum((factor[k][i] * solved[k] for k in range(i + 1, n)), jnp.zeros(()))
        solved[i] = (solved[i] - above) / factor[i][i]
    return jnp.stack(solved), regular


def inverse_distance_weights(
    squared: Float[ArrayLike, "m"], used: Bool[ArrayLike, "m"], power: Float[ArrayLike, ""]
) -> Float[Array, "m"]:
    """Return w = d^-p over their sum, from squared distances d^2 in any unit; of the points `used`, zero for all
    others.

    If points coincide with the place (d = 0), only these count; differentiable there, too. All are zero if no point is
    used.
    """
    least = jnp.min(jnp.where(used, jax.lax.stop_gradient(squared), jnp.inf))
    least = jnp.where(jnp.any(used), least, 1.0)
    exact = squared == 0
    # Two `where`: neither a distance nor a ratio of zero has a NaN derivative.
    ratio = jnp.where(exact, 1.0, least / jnp.where(exact, 1.0, squared))
    some = used & (ratio > 0)
    weight = jnp.where(some, jnp.where(some, ratio, 1.0) ** (power / 2), 0.0)
    return weight / jnp.maximum(jnp.sum(weight), 1e-300)


# Delaunay triangle over one place, from the surrounding points only.
#
# Lift every point q to |q|^2: the triangulation is the lower hull of the lifted points (Edelsbrunner and Seidel 1986),
# and the triangle over the place, taken as origin, is the facet that a vertical line pierces. It is the solution of
#
#     maximise b    subject to    a . q_i + b <= |q_i|^2    for all i
#
# in a (2) and b, found as in the dual simplex method: start with a triangle around the place; while a point lies in its
# circumcircle, replace the corner that leaves a triangle around the place by the point deepest under the facet. Three
# artificial distant points form the first triangle; if one of them remains, the place is outside all others. The
# triangle is that of the whole cloud if its circumcircle lies in the circle within which all points are known.

_MOST_STEPS = 100
# Corners of the first triangle, in units of the farthest point, and their lift: their facets are vertical.
_FAR = 4 * np.stack([np.cos([0.5, 2.6, 4.7]), np.sin([0.5, 2.6, 4.7])], axis=1)
_LIFT = 1e7
# Relative to the largest lift of a corner: smaller differences are rounding.
_ROUNDING = 1e-14


class Triangle(NamedTuple):
    """Influence of each point on the height of the place: barycentric coordinates of three, zero of the others."""

    weight: Float[Array, "points"]
    inside: Bool[Array, ""]
    """True if there is a triangle over the place."""
    safe: Bool[Array, ""]
    """True if no point farther away than the last one given can lie in its circumcircle."""


def delaunay_triangle(near: Neighbours) -> Triangle:
    """Find the triangle over the place among the neighbours."""
    unit = jnp.max(jnp.where(near.there, near.distance, 0.0))
    unit = jnp.where(unit > 0, unit, 1.0)
    points = jnp.concatenate([jnp.where(near.there[:, None], near.xy / unit, 0.0), _FAR])
    n = len(near.z)
    lifted = jnp.concatenate([jnp.where(near.there, jnp.sum(points[:n] ** 2, axis=1), 2 * _LIFT), jnp.full(3, _LIFT)])

    def deepest(corners):
        """Return the point deepest under the facet, and True if the depth exceeds rounding."""
        at, height = points[corners], lifted[corners]
        slope = _slope(at, height)
        above = lifted - height[0] - (points - at[0]) @ slope
        above = above.at[corners].set(0.0)
        k = jnp.argmin(above)
        return k, above[k] < -_ROUNDING * jnp.max(height)

    def step(state):
        corners, k, _, steps = state
        share, of_new = _barycentric(points[corners], jnp.zeros(2)), _barycentric(points[corners], points[k])
        ratio = jnp.where(of_new > 0, jnp.maximum(share, 0.0) / jnp.where(of_new > 0, of_new, 1.0), jnp.inf)
        corners = corners.at[jnp.argmin(ratio)].set(k)
        return corners, *deepest(corners), steps + 1

    first = jnp.arange(n, n + 3)
    state = (first, *deepest(first), 0)
    corners, _, wrong, _ = jax.lax.while_loop(lambda s: s[2] & (s[3] < _MOST_STEPS), step, state)
    inside = jnp.all(corners < n) & ~wrong
    weight = jnp.zeros(n + 3).at[corners].add(_barycentric(points[corners], jnp.zeros(2)))[:n]
    at = points[corners] - points[corners[0]]
    # The gradient of the lifted facet is twice the circumcentre: grad |c|^2 = 2 c.
    centre = _slope(at, jnp.sum(at**2, axis=1)) / 2
    farthest = jnp.linalg.norm(centre + points[corners[0]]) + jnp.linalg.norm(centre)
    return Triangle(jnp.where(inside, weight, 0.0), inside, inside & (farthest < 1 - 1e-9))


def _slope(at: Float[Array, "3 2"], height: Float[Array, "3"]) -> Float[Array, "2"]:
    """Return the gradient of the plane over three points."""
    (ax, ay), (bx, by) = at[1] - at[0], at[2] - at[0]
    a, b = height[1] - height[0], height[2] - height[0]
    return jnp.stack([a * by - b * ay, b * ax - a * bx]) / (ax * by - bx * ay)


def _barycentric(at: Float[Array, "3 2"], place: Float[Array, "2"]) -> Float[Array, "3"]:
    """Return barycentric coordinates of a place; their sum is 1."""
    (ax, ay), (bx, by), (px, py) = at[1] - at[0], at[2] - at[0], place - at[0]
    double = ax * by - bx * ay
    second, third = (px * by - bx * py) / double, (ax * py - px * ay) / double
    return jnp.stack([1 - second - third, second, third])


_DIRECTIONS = np.pi * np.arange(12) / 12
# Positions of the dividing line, in units of the farthest point.
_OFFSETS = np.array([-0.45, -0.3, -0.15, 0.0, 0.15, 0.3, 0.45])
# Minimum number of points on each side: two more than a plane has coefficients.
_FEWEST = 5
# Determinant of a side's normal matrix relative to that of surrounding points: less is a line.
_LINE = 1e-4
# Two planes must leave less than this fraction of the variance of one surface: divided by a line; and by height, which
# leaves a quarter for any points.
_BY_LINE, _BY_HEIGHT = 0.4, 0.1


@eqx.filter_jit
def lie_on_two_planes(near: Neighbours, variance: Float[Array, "places"]) -> Bool[Array, "places"]:
    """Return True where two planes leave far less than the `variance` (m^2) of one surface.

    For a dividing line, of 12 directions and 7 distances from the place, less than 0.4 of it; for the points above and
    below the largest gap between heights, as at a wall, less than 0.1.
    """
    return jax.vmap(_two_planes)(near, variance)


def _two_planes(near: Neighbours, variance: Float[Array, ""]) -> Bool[Array, ""]:
    xy = near.xy / jnp.max(jnp.where(near.there, near.distance, 0.0))
    along = xy @ jnp.stack([jnp.cos(_DIRECTIONS), jnp.sin(_DIRECTIONS)])
    lower = (along[:, :, None] < _OFFSETS).reshape(len(xy), -1)
    first = jnp.concatenate([lower, (near.z < _gap(near))[:, None]], axis=1) & near.there[:, None]
    sides = jnp.stack([first, near.there[:, None] & ~first])
    rows = jnp.concatenate([jnp.ones_like(xy[:, :1]), xy, near.z[:, None]], axis=1)
    # Sums over each side of all products of 1, x, y, z.
    sums = jnp.einsum("spl,pi,pj->slij", 1.0 * sides, rows, rows)
    left = jnp.sum(_left_by_plane(sums), axis=0) / (jnp.sum(near.there) - 7)
    return (jnp.min(left[:-1]) < _BY_LINE * variance) | (left[-1] < _BY_HEIGHT * variance)


def _gap(near: Neighbours) -> Float[Array, ""]:
    """Return the middle of the largest gap between heights."""
    z = jnp.sort(jnp.where(near.there, near.z, jnp.inf))
    gap = jnp.where(jnp.isfinite(z[1:]), z[1:] - z[:-1], 0.0)
    k = jnp.argmax(gap)
    return z[k] + gap[k] / 2


def _left_by_plane(sums: Float[Array, "2 lines 4 4"]) -> Float[Array, "2 lines"]:
    """Return residual sums of squares of planes; infinite for too few points, or collinear points.

    About the mean, z'z - r' C^-1 r with C the sums of products of x and y, and r those with z.
    """
    n = jnp.maximum(sums[..., 0, 0], 1.0)
    mean = sums[..., 0, 1:] / n[..., None]
    about = sums[..., 1:, 1:] - n[..., None, None] * mean[..., :, None] * mean[..., None, :]
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (jnp.moveaxis(about[..., k, :], -1, 0) for k in range(3))
    determinant = xx * yy - xy**2
    fit = (n >= _FEWEST) & (determinant > _LINE * n**2)
    explained = (yy * xz**2 - 2 * xy * xz * yz + xx * yz**2) / jnp.where(fit, determinant, 1.0)
    return jnp.where(fit, jnp.maximum(zz - explained, 0.0), jnp.inf)


# Error of an interpolated height: noise and interpolation bias.
#
# A height is a weighted sum of those of the points, H = sum w_i Z_i. With the local surface Z(x) of `local_surface`,
# the noise v of a height and A = `rows`,
#
#     v = sigma_Z^2 + |g|^2 sigma_XY^2    (+ the excess that the residuals show)
#     b = sum w_i Z(x_i) - Z(0) + sigma_XY^2 (h_xx + h_yy) / 2
#
# where b is the bias: of weights that do not reproduce a slope or curvature, and of horizontal errors, over which the
# cloud averages a curved surface. It has a variance itself, t^2, and counts as far as it exceeds that: the error is
# assumed normal,
#
#     N(k b, s^2),    k = max(0, 1 - 2 t^2 / b^2),    s^2 = |w - k c A|^2 v + k (1 - k) t^2 + roughness
#
# where c b is the bias per coefficient. The returned standard deviation is that of the zero-mean normal distribution
# with the same probability of 95 % within 1.96 sigma.


class LidarNoise(NamedTuple):
    """Standard deviations of a laser point (m): in height and in each horizontal coordinate."""

    sigma_z: Float[ArrayLike, ""] | float
    sigma_xy: Float[ArrayLike, ""] | float


def noise_variance(fit: LocalFit, noise: LidarNoise) -> Float[ArrayLike, ""]:
    """Return the variance of a point's height over the surface (m^2): on a slope, horizontal errors contribute."""
    slope = jnp.sum(fit.coefficients[1:3] ** 2)
    on_slope = noise.sigma_z**2 + slope * noise.sigma_xy**2
    # A slope that is not significant is none.
    by_chance = on_slope * jnp.sum(fit.rows[1:3] ** 2)
    return noise.sigma_z**2 + jnp.maximum(slope - by_chance, 0.0) * noise.sigma_xy**2


def excess(fit: LocalFit, variance: Float[ArrayLike, ""], quantile: float) -> Float[Array, ""]:
    """Return the residual variance over the expected one, relative to the normal `quantile` of chance.

    The quantile of chi-square over its degrees of freedom is that of Wilson and Hilferty (1931).
    """
    part = 2 / (9 * jnp.maximum(fit.freedom, 1.0))
    return fit.variance / (variance * (1 - part + quantile * jnp.sqrt(part)) ** 3)


def height_sigma(
    near: Neighbours, weight: Float[ArrayLike, "points"], fit: LocalFit, noise: LidarNoise
) -> Float[Array, ""]:
    """Return the standard deviation (m) of the height with these weights, as above."""
    expected = noise_variance(fit, noise)
    rough = excess(fit, expected, _ONE_IN_TWENTY) > 1
    variance = jnp.where(rough, fit.variance, expected)
    influence = weight @ terms(near.xy) - jnp.eye(6)[0]
    influence = influence + noise.sigma_xy**2 / 2 * jnp.array([0.0, 0, 0, 1, 0, 1])
    bias = influence @ fit.coefficients
    of_bias = influence @ fit.rows
    uncertain = jnp.sum(of_bias**2) * variance
    known = jnp.maximum(0.0, 1 - _DOUBT * uncertain / jnp.where(bias == 0, 1.0, bias**2)) * (bias != 0)
    spread = jnp.sum((weight - known * of_bias) ** 2) * variance
    spread += known * (1 - known) * uncertain + jnp.where(rough, variance - expected, 0.0)
    return normal_equivalent(known * bias, jnp.sqrt(spread))


_ONE_IN_TWENTY = 1.645
# Multiple of its variance that a squared bias must exceed.
_DOUBT = 2.0


def normal_equivalent(mean: Float[Array, ""], sigma: Float[Array, ""]) -> Float[Array, ""]:
    """Return s for which |e| <= 1.96 s in 95 % of errors e of N(mean, sigma^2)."""
    # Without noise only the bias counts.
    sigma = jnp.maximum(sigma, 1e-9 * jnp.abs(mean) + 1e-300)
    t = jnp.abs(mean) / sigma
    q = jnp.maximum(_BOUND, t + _ONE_IN_TWENTY)
    for _ in range(4):
        # Newton's method; the probability is concave in q, so it converges from below.
        within = norm.cdf(q - t) - norm.cdf(-q - t)
        q = q + (0.95 - within) / (norm.pdf(q - t) + norm.pdf(q + t))
    return sigma * q / _BOUND


_BOUND = 1.959963984540054


# Number of points that determine slope, curvature and roughness: a minimum, and a multiple of those used.
WIDE, TIMES = 24, 3
# Also all available points within this number of horizontal standard deviations.
APART = 4.75
# Quantiles of the normal distribution: 1 in 20, and 1 in 1000.
_SELDOM, _HARDLY = 1.645, 3.09
# Residuals in units of the lidar's noise beyond which there is no surface.
_ROUGH = 3.0
# Standard deviation of the weights of moving least squares, in units of the farthest point.
_WIDTH = 0.5


class HeightNumbers(NamedTuple):
    """Numerical settings, for which programs are not recompiled."""

    points: Int[ArrayLike, ""]
    power: Float[ArrayLike, ""]
    radius: Float[ArrayLike, ""]
    """Zero: the nearest points (m)."""
    noise: LidarNoise


class HeightEstimate(NamedTuple):
    """Estimate for one place."""

    height: Float[ArrayLike, ""]
    """Over the nearest point (m); NaN if undetermined."""
    sigma: Float[ArrayLike, ""]
    used: Int[ArrayLike, ""]
    density: Float[ArrayLike, ""]
    roughness: Float[ArrayLike, ""]
    gradient: Float[ArrayLike, "2"]
    leafy: Float[ArrayLike, ""]
    """Fraction of vegetation among the points used."""
    hole: Bool[ArrayLike, ""]
    surrounded: Bool[ArrayLike, ""]
    plane: Bool[ArrayLike, ""]
    """True if `local` used a plane."""
    misfit: Bool[ArrayLike, ""]
    """True if the points scatter about the surface more than the lidar's noise explains."""
    rough: Bool[ArrayLike, ""]
    """True if they do so by far."""
    wide: Int[ArrayLike, ""]
    """Number of points that determined the surface."""
    one_surface: Float[ArrayLike, ""]
    """Residual variance (m^2) of one smooth surface."""
    final: Bool[ArrayLike, ""]
    """True if more points would not change the result."""


@eqx.filter_jit
def estimate_heights(
    near: Neighbours, leafy: Bool[Array, "places points"], numbers: HeightNumbers, method: str
) -> HeightEstimate:
    """Estimate every place by `method`; arrays of `near` have a leading axis over the places."""
    return jax.vmap(lambda n, of: _estimate(n, of, numbers, method))(near, leafy)


def _estimate(near: Neighbours, leafy: Bool[Array, "points"], numbers: HeightNumbers, method: str) -> HeightEstimate:
    in_radius = near.there & (near.distance <= numbers.radius)
    n_used = jnp.where(numbers.radius > 0, jnp.sum(in_radius), numbers.points)
    n_around = jnp.maximum(WIDE, TIMES * n_used)
    # Points whose horizontal errors equal their distances determine no curvature.
    n_wide = jnp.maximum(n_around, jnp.sum(near.there & (near.distance <= APART * numbers.noise.sigma_xy)))
    rank = jnp.arange(len(near.z))
    used, around = near.there & (rank < n_used), near.there & (rank < n_around)
    wide, narrow = near.there & (rank < n_wide), near.there & (rank < n_wide // 2)
    curved, flat = (
        fit_surface(near, wide.astype(float), quadratic=True),
        fit_surface(near, narrow.astype(float), quadratic=False),
    )

    def misfit(fit: LocalFit, quantile: float) -> Bool[Array, ""]:
        return excess(fit, noise_variance(fit, numbers.noise), quantile) > 1

    # A local plane close to a break: points beyond it are irrelevant.
    take_flat = ~curved.interpolates | (misfit(curved, _HARDLY) & flat.interpolates & ~misfit(flat, _SELDOM))
    fit = jax.tree.map(lambda a, b: jnp.where(take_flat, a, b), flat, curved)
    final = interpolates = jnp.array(True)
    if method == "idw":
        weight = inverse_distance_weights(near.distance**2, used, numbers.power)
        weight = jnp.where(jnp.any(used), weight, jnp.nan)
    elif method == "plane":
        plane = fit_surface(near, used.astype(float), quadratic=False)
        weight, interpolates = jnp.where(plane.determined, plane.rows[0], jnp.nan), plane.interpolates
    elif method == "tin":
        triangle = delaunay_triangle(near)
        weight, final = jnp.where(triangle.inside, triangle.weight, jnp.nan), triangle.safe
        used = triangle.weight != 0
    else:
        used = around & (~take_flat | (rank < n_around // 2))
        reach = jnp.max(jnp.where(used, near.distance, 0.0))
        bell = jnp.where(used, jnp.exp(-0.5 * (near.distance / (_WIDTH * reach)) ** 2), 0.0)
        curved, flat = fit_surface(near, bell, quadratic=True), fit_surface(near, bell, quadratic=False)
        weight = jnp.where(take_flat, flat.rows[0], curved.rows[0])
    reach, n_there = jnp.max(jnp.where(around, near.distance, 0.0)), jnp.sum(around)
    expected = noise_variance(fit, numbers.noise)
    return HeightEstimate(
        height=jnp.sum(weight * jnp.where(near.there, near.z, 0.0)),
        sigma=height_sigma(near, weight, fit, numbers.noise), used=jnp.sum(used),
        density=(n_there - 1) / (jnp.pi * reach**2), roughness=jnp.sqrt(fit.variance), gradient=fit.coefficients[1:3],
        leafy=jnp.sum(leafy & used) / jnp.maximum(jnp.sum(used), 1), hole=empty_about(near.distance, around),
        surrounded=surrounded(near.xy, around) & fit.interpolates & interpolates, plane=take_flat & (method == "local"),
        misfit=misfit(fit, _HARDLY), rough=fit.variance > _ROUGH**2 * expected, wide=jnp.sum(wide),
        one_surface=curved.variance, final=final,
    )  # fmt: skip
