"""Heights at X, Y from a cloud, with standard deviations; refused where the cloud does not determine them.

Two interpolations of the heights of surrounding points, H = sum w_i Z_i:

- `plane`: least squares through the nearest points,
- `local`: moving least squares, a quadratic with Gaussian weights; a plane if the points do not determine a quadratic.

Error model: below; files and figures: docs/lidar_heights.md.
"""

import enum
from typing import Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float, Int, Integer

from jaxphoto.arrays import ArrayLike
from jaxphoto.cloud import Cloud
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.lidar.grid import Grid, index_cloud, nearest
from jaxphoto.lidar.sight import empty_about, surrounded

Method = Literal["plane", "local"]


class HeightFlag(enum.IntFlag):
    """Quality flags of a height; several may apply."""

    OK = 0
    HOLE = 1
    """No point is close enough, given the density of the surrounding points."""
    EDGE = 2
    """The nearest points do not surround the position: extrapolation."""
    VEGETATION = 4
    """The nearest points are vegetation or multiple returns, or too rough for a surface."""
    BREAKLINE = 8
    """The nearest points lie on two surfaces: wall, ridge, kerb."""
    PLANE = 16
    """`local` used a plane, because the nearest points do not determine a quadratic; not refused by default."""


REFUSED = HeightFlag.HOLE | HeightFlag.EDGE | HeightFlag.VEGETATION | HeightFlag.BREAKLINE


class HeightSettings(eqx.Module):
    """Settings of height interpolation, and errors of the lidar.

    `points`: number of nearest points for `plane` and pseudo control; `local` uses three times `points`, at least 24.
    `power`: exponent of the weights of pseudo control. `sigma_z_m`, `sigma_xy_m`: standard deviations of a laser point
    in Z and in each of X and Y; `sigma_systematic_m`: common error of all points. A position is flagged if at least the
    fraction `leafy_share` of the points used is vegetation or multiple returns; heights with a flag of `refuse` are
    NaN.
    """

    points: int = 8
    power: float = 2.0
    sigma_z_m: float = 0.15
    sigma_xy_m: float = 0.5
    sigma_systematic_m: float = 0.0
    leafy_share: float = 0.25
    refuse: HeightFlag = REFUSED

    def __check_init__(self) -> None:
        if self.points < 4:
            raise InputError(f"points is {self.points}; heights need 4 or more")
        for name in ("power", "sigma_z_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value}: give a positive number")
        for name in ("sigma_xy_m", "sigma_systematic_m", "leafy_share"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InputError(f"{name} is {getattr(self, name)}: give zero or a positive number")


# Local least-squares surface through the points around a position.
#
# With x, y the offsets of a point from the position (m), and its height Z relative to a reference,
#
#     Z = h + g_x x + g_y y + (h_xx x^2 + 2 h_xy x y + h_yy y^2) / 2
#
# is a quadratic; without its last term, a plane. The fit is linear in the heights: `coefficients = rows @ z`, so every
# standard deviation follows from `rows`.

# Minimum ratio of a pivot to its diagonal element: points collinear to 1e-4 of their distances.
_SINGULAR = 1e-8


class Neighbours(NamedTuple):
    """Points nearest to one position, nearest first; padding is marked False in `there`."""

    xy: Float[ArrayLike, "points 2"]
    """Offsets from the position (m)."""
    z: Float[ArrayLike, "points"]
    """Heights above the nearest point (m)."""
    distance: Float[ArrayLike, "points"]
    there: Bool[ArrayLike, "points"]


class LocalFit(NamedTuple):
    """Locally fitted surface."""

    coefficients: Float[Array, "6"]
    """h (m), g_x, g_y, h_xx, h_xy, h_yy (1/m)."""
    rows: Float[Array, "6 points"]
    variance: Float[Array, ""]
    """Residual sum of squares over the degrees of freedom (m^2)."""
    freedom: Float[Array, ""]
    """Number of points minus number of coefficients."""
    determined: Bool[Array, ""]
    """True if there are more points than coefficients, and they are not on a line or conic."""

    @property
    def interpolates(self) -> Bool[Array, ""]:
        """Return True if the height is more accurate than a single point; otherwise it is extrapolated."""
        return self.determined & (jnp.sum(self.rows[0] ** 2) <= 1)


def terms(xy: Float[ArrayLike, "points 2"]) -> Float[Array, "points 6"]:
    """Return the monomials of the coefficients, one row per point."""
    x, y = xy[:, 0], xy[:, 1]
    return jnp.stack([jnp.ones_like(x), x, y, x**2 / 2, x * y, y**2 / 2], axis=1)


def fit_surface(near: Neighbours, weight: Float[ArrayLike, "points"], quadratic: bool) -> LocalFit:
    """Fit the surface by weighted least squares; weights of missing points are zero.

    The residual variance counts each point of positive weight once.
    """
    weight = jnp.where(near.there, weight, 0.0)
    used = weight > 0
    n_used = jnp.sum(used)
    # Centre, and scale by the distance of the farthest point, for the condition of the normal matrix.
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
    """Transform coefficients about the centre (scaled) to coefficients about the position `at` (per m)."""
    x, y = at
    zero, one = jnp.zeros(()), jnp.ones(())
    by_x, by_y = jnp.stack([zero, one, zero, x, y, zero]), jnp.stack([zero, zero, one, zero, x, y])
    moved = jnp.concatenate([terms(at[None]), by_x[None], by_y[None], jnp.eye(6)[3:]])
    return moved * unit ** -jnp.array([0.0, 1, 1, 2, 2, 2])[:, None]


def _solve(
    normal: Float[Array, "n n"], right: Float[Array, "n points"]
) -> tuple[Float[Array, "n points"], Bool[Array, ""]]:
    """Solve by Cholesky factorisation; return False if a pivot is near zero.

    Written out: vectorised over many positions, while LAPACK would be called for each.
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
    """Return normalised weights d^-p of the points `used` from squared distances d^2 in any unit; zero for all others.

    If points coincide with the position (d = 0), only they have weight; differentiable there, too. All weights are zero
    if no point is used.
    """
    least = jnp.min(jnp.where(used, jax.lax.stop_gradient(squared), jnp.inf))
    least = jnp.where(jnp.any(used), least, 1.0)
    exact = squared == 0
    # Use `where` twice: neither a distance nor a ratio of zero may give a NaN derivative.
    ratio = jnp.where(exact, 1.0, least / jnp.where(exact, 1.0, squared))
    some = used & (ratio > 0)
    weight = jnp.where(some, jnp.where(some, ratio, 1.0) ** (power / 2), 0.0)
    return weight / jnp.maximum(jnp.sum(weight), 1e-300)


_DIRECTIONS = np.pi * np.arange(12) / 12
# Offsets of the dividing line, in units of the distance of the farthest point.
_OFFSETS = np.array([-0.45, -0.3, -0.15, 0.0, 0.15, 0.3, 0.45])
# Minimum number of points per side: two more than the coefficients of a plane.
_FEWEST = 5
# Minimum determinant of the scatter matrix per n^2, in units of the distance of the farthest point to the power of 4:
# below it, points are collinear.
_LINE = 1e-4
# Maximum ratio of the residual variance of two planes to that of one surface, for points divided by a line and by
# height (random points reach 0.25).
_BY_LINE, _BY_HEIGHT = 0.4, 0.1


@eqx.filter_jit
def lie_on_two_planes(near: Neighbours, variance: Float[Array, "places"]) -> Bool[Array, "places"]:
    """Return True where two planes have a much smaller residual variance than one surface, `variance` (m^2).

    The ratio is less than 0.4 if a line divides the points (12 directions and 7 offsets from the position), or less
    than 0.1 if the largest gap between heights divides them, as at a wall.
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
    """Return residual sums of squares of planes; infinite for too few or collinear points."""
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
# A height is a weighted sum of the heights of the points, H = sum w_i Z_i. With the local surface Z(x) (`LocalFit`),
# the noise variance v of a height and A = `rows`,
#
#     v = sigma_Z^2 + |g|^2 sigma_XY^2    (plus the excess in the residuals)
#     b = sum w_i Z(x_i) - Z(0) + sigma_XY^2 (h_xx + h_yy) / 2
#
# where b is the bias of weights that do not reproduce slope or curvature, and of horizontal errors, which smooth a
# curved surface. The bias has a variance t^2 and is applied only as far as it exceeds it. The error is assumed normal,
#
#     N(k b, s^2),    k = max(0, 1 - 2 t^2 / b^2),    s^2 = |w - k c A|^2 v + k (1 - k) t^2 + roughness
#
# where c b is the bias per coefficient. The returned standard deviation belongs to the zero-mean normal distribution
# with the same probability of 95 % within 1.96 sigma.


class LidarNoise(NamedTuple):
    """Standard deviations of a laser point (m): in height and in each horizontal coordinate."""

    sigma_z: Float[ArrayLike, ""] | float
    sigma_xy: Float[ArrayLike, ""] | float


def noise_variance(fit: LocalFit, noise: LidarNoise) -> Float[ArrayLike, ""]:
    """Return the variance of a point's height over the surface (m^2): on a slope, horizontal errors contribute."""
    slope = jnp.sum(fit.coefficients[1:3] ** 2)
    on_slope = noise.sigma_z**2 + slope * noise.sigma_xy**2
    # Ignore slopes that are not significant.
    by_chance = on_slope * jnp.sum(fit.rows[1:3] ** 2)
    return noise.sigma_z**2 + jnp.maximum(slope - by_chance, 0.0) * noise.sigma_xy**2


def excess(fit: LocalFit, variance: Float[ArrayLike, ""], quantile: float) -> Float[Array, ""]:
    """Return the ratio of residual to expected variance, relative to its limit at the normal `quantile`.

    The chi-square limit is the approximation of Wilson and Hilferty (1931).
    """
    part = 2 / (9 * jnp.maximum(fit.freedom, 1.0))
    return fit.variance / (variance * (1 - part + quantile * jnp.sqrt(part)) ** 3)


def height_sigma(
    near: Neighbours, weight: Float[ArrayLike, "points"], fit: LocalFit, noise: LidarNoise
) -> Float[Array, ""]:
    """Return the standard deviation (m) of a height with these weights (see the model above)."""
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
# Minimum ratio of a squared bias to its variance.
_DOUBT = 2.0


def normal_equivalent(mean: Float[Array, ""], sigma: Float[Array, ""]) -> Float[Array, ""]:
    """Return s for which |e| <= 1.96 s in 95 % of errors e of N(mean, sigma^2)."""
    # Without noise only the bias contributes.
    sigma = jnp.maximum(sigma, 1e-9 * jnp.abs(mean) + 1e-300)
    t = jnp.abs(mean) / sigma
    q = jnp.maximum(_BOUND, t + _ONE_IN_TWENTY)
    for _ in range(4):
        # Newton's method converges from below, because the probability is concave in q.
        within = norm.cdf(q - t) - norm.cdf(-q - t)
        q = q + (0.95 - within) / (norm.pdf(q - t) + norm.pdf(q + t))
    return sigma * q / _BOUND


_BOUND = 1.959963984540054


# Number of points for slope, curvature and roughness: minimum, and multiple of the number of points used.
WIDE, TIMES = 24, 3
# Number of horizontal standard deviations within which all available points are also used.
APART = 4.75
# Quantiles of the normal distribution: probabilities 1/20 and 1/1000.
_SELDOM, _HARDLY = 1.645, 3.09
# Ratio of residuals to the lidar's noise above which the points do not define a surface.
_ROUGH = 3.0
# Standard deviation of the moving least-squares weights, in units of the distance of the farthest point.
_WIDTH = 0.5


class HeightEstimate(NamedTuple):
    """Estimate at one position."""

    height: Float[ArrayLike, ""]
    """Height above the nearest point (m); NaN if undetermined."""
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
    """True if the scatter exceeds the noise by a factor of 3 (`_ROUGH`)."""
    wide: Int[ArrayLike, ""]
    """Number of points used for the surface."""
    one_surface: Float[ArrayLike, ""]
    """Residual variance (m^2) of one smooth surface."""


@eqx.filter_jit
def estimate_heights(
    near: Neighbours, leafy: Bool[Array, "places points"], points: Int[ArrayLike, ""], noise: LidarNoise, method: str
) -> HeightEstimate:
    """Estimate the height at every position by `method`; arrays of `near` have a leading axis over the positions."""
    return jax.vmap(lambda n, of: _estimate(n, of, points, noise, method))(near, leafy)


def _estimate(
    near: Neighbours, leafy: Bool[Array, "points"], points: Int[ArrayLike, ""], noise: LidarNoise, method: str
) -> HeightEstimate:
    n_around = jnp.maximum(WIDE, TIMES * points)
    # Points closer than their horizontal errors do not determine curvature.
    n_wide = jnp.maximum(n_around, jnp.sum(near.there & (near.distance <= APART * noise.sigma_xy)))
    rank = jnp.arange(len(near.z))
    used, around = near.there & (rank < points), near.there & (rank < n_around)
    wide, narrow = near.there & (rank < n_wide), near.there & (rank < n_wide // 2)
    curved, flat = (
        fit_surface(near, wide.astype(float), quadratic=True),
        fit_surface(near, narrow.astype(float), quadratic=False),
    )

    def misfit(fit: LocalFit, quantile: float) -> Bool[Array, ""]:
        return excess(fit, noise_variance(fit, noise), quantile) > 1

    # Prefer a local plane near a breakline: points beyond it are irrelevant.
    take_flat = ~curved.interpolates | (misfit(curved, _HARDLY) & flat.interpolates & ~misfit(flat, _SELDOM))
    fit = jax.tree.map(lambda a, b: jnp.where(take_flat, a, b), flat, curved)
    interpolates = jnp.array(True)
    if method == "plane":
        plane = fit_surface(near, used.astype(float), quadratic=False)
        weight, interpolates = jnp.where(plane.determined, plane.rows[0], jnp.nan), plane.interpolates
    else:
        used = around & (~take_flat | (rank < n_around // 2))
        reach = jnp.max(jnp.where(used, near.distance, 0.0))
        bell = jnp.where(used, jnp.exp(-0.5 * (near.distance / (_WIDTH * reach)) ** 2), 0.0)
        curved, flat = fit_surface(near, bell, quadratic=True), fit_surface(near, bell, quadratic=False)
        weight = jnp.where(take_flat, flat.rows[0], curved.rows[0])
    reach, n_there = jnp.max(jnp.where(around, near.distance, 0.0)), jnp.sum(around)
    expected = noise_variance(fit, noise)
    return HeightEstimate(
        height=jnp.sum(weight * jnp.where(near.there, near.z, 0.0)),
        sigma=height_sigma(near, weight, fit, noise), used=jnp.sum(used),
        density=(n_there - 1) / (jnp.pi * reach**2), roughness=jnp.sqrt(fit.variance), gradient=fit.coefficients[1:3],
        leafy=jnp.sum(leafy & used) / jnp.maximum(jnp.sum(used), 1), hole=empty_about(near.distance, around),
        surrounded=surrounded(near.xy, around) & fit.interpolates & interpolates, plane=take_flat & (method == "local"),
        misfit=misfit(fit, _HARDLY), rough=fit.variance > _ROUGH**2 * expected, wide=jnp.sum(wide),
        one_surface=curved.variance,
    )  # fmt: skip


# Batch sizes of positions; calls are padded to these, for few compiled programs.
_PLACES = (64, 512, 4096)
# Maximum number of points for the surface, for clouds much denser than their horizontal errors.
_MOST_WIDE = 4 * WIDE


class Heights(eqx.Module):
    """Heights (m) and their properties; NaN where refused or undetermined."""

    z: Float[ArrayLike, "places"]
    sigma: Float[ArrayLike, "places"]
    flag: Integer[ArrayLike, "places"]
    """Bitwise sum of `HeightFlag`."""
    count: Int[ArrayLike, "places"]
    """Number of points used."""
    density: Float[ArrayLike, "places"]
    """Points per m^2 around the position."""
    roughness: Float[ArrayLike, "places"]
    """Standard deviation (m) of the points about the local surface."""
    gradient: Float[ArrayLike, "places 2"]
    """Gradient of the local surface (dZ/dX, dZ/dY)."""

    def __len__(self) -> int:
        return len(self.z)

    @property
    def slope(self) -> Float[ArrayLike, "places"]:
        """Return the slope as rise over run: 1 is 45 degrees."""
        return np.hypot(*np.asarray(self.gradient).T)

    def flagged(self, flag: HeightFlag) -> Bool[np.ndarray, "places"]:
        """Return True for positions with any flag of `flag`."""
        return (np.asarray(self.flag) & int(flag)) != 0


def heights_at(
    cloud: Cloud | Grid,
    xy: Float[np.ndarray, "places 2"],
    method: Method = "plane",
    settings: HeightSettings | None = None,
) -> Heights:
    """Interpolate heights of the cloud at X, Y (m) by one of two methods, with standard deviations and flags.

    Pass a `Grid` to avoid re-indexing the cloud. Positions with a flag of `settings.refuse` are NaN; `Heights.flag`
    gives the reason. 95 % of the errors are within 1.96 standard deviations.
    """
    settings = HeightSettings() if settings is None else settings
    if method not in get_args(Method):
        raise InputError(f"unknown method {method!r}; choose one of {', '.join(get_args(Method))}")
    xy = np.asarray(xy, float)
    if xy.ndim != 2 or xy.shape[1] != 2 or not np.isfinite(xy).all():
        raise InputError("invalid positions; give an array of two columns, X_m and Y_m, without NaN")
    grid = cloud if isinstance(cloud, Grid) else index_cloud(cloud)
    # Mean number of points within the range of horizontal errors; a multiple of `WIDE`.
    covered = np.count_nonzero(np.diff(grid.start)) * float(grid.cell_m) ** 2
    many = np.pi * (APART * settings.sigma_xy_m) ** 2 * len(grid) / covered
    wide = max(WIDE, TIMES * settings.points, min(WIDE * int(np.ceil(many / WIDE)), _MOST_WIDE))
    estimate = _estimates(grid, xy, method, settings, wide)
    return _judged(estimate, _broken(grid, xy, estimate, wide), settings)


def _estimates(grid: Grid, xy: np.ndarray, method: Method, settings: HeightSettings, k: int) -> HeightEstimate:
    """Estimate positions from their `k` nearest points, in batches of few sizes."""
    most = max(1, _PLACES[-1] * WIDE // k)
    noise = LidarNoise(np.array(settings.sigma_z_m), np.array(settings.sigma_xy_m))
    # Process one portion even without positions.
    parts, sizes = [], [*(size for size in _PLACES if size < most), most]
    for first in range(0, max(len(xy), 1), most):
        some = xy[first : first + most]
        room = next(size for size in sizes if len(some) <= size)
        padded = np.concatenate([some, np.broadcast_to(grid.xyz[0, :2], (room - len(some), 2))])
        near, base, leafy = _neighbours(grid, padded, k)
        part = call_compiled(estimate_heights, near, leafy, np.array(settings.points), noise, method)
        part = HeightEstimate(*(np.array(v)[: len(some)] for v in part))
        parts.append(part._replace(height=part.height + base[: len(some)]))
    return HeightEstimate(*(np.concatenate(v) for v in zip(*parts, strict=True)))


def _neighbours(grid: Grid, xy: np.ndarray, k: int) -> tuple[Neighbours, ArrayLike, ArrayLike]:
    """Return the neighbours of the positions, the height of the nearest neighbour, and a mask of vegetation."""
    neighbours = nearest(grid, xy, k)
    points = grid.xyz[neighbours.index]
    there = np.isfinite(neighbours.distance)
    base = points[:, 0, 2]
    near = Neighbours(points[:, :, :2] - xy[:, None], points[:, :, 2] - base[:, None], neighbours.distance, there)
    return near, base, grid.leafy[neighbours.index] & there


def _judged(estimate: HeightEstimate, broken: np.ndarray, settings: HeightSettings) -> Heights:
    """Combine flags, and set refused heights to NaN."""
    rough = estimate.misfit & estimate.rough & ~broken
    of_leaves = (estimate.leafy > 0) & (estimate.leafy >= settings.leafy_share)
    flag = estimate.hole * HeightFlag.HOLE | ~(estimate.surrounded & np.isfinite(estimate.height)) * HeightFlag.EDGE
    flag = flag | (rough | of_leaves) * HeightFlag.VEGETATION | broken * HeightFlag.BREAKLINE
    flag = flag | estimate.plane * HeightFlag.PLANE
    refused = flag & settings.refuse != 0
    return Heights(
        z=np.where(refused, np.nan, estimate.height),
        sigma=np.where(refused, np.nan, np.hypot(estimate.sigma, settings.sigma_systematic_m)),
        flag=flag.astype(np.uint8),
        count=estimate.used,
        density=estimate.density,
        roughness=estimate.roughness,
        gradient=estimate.gradient,
    )


def _broken(grid: Grid, xy: np.ndarray, estimate: HeightEstimate, k: int) -> np.ndarray:
    """Return True for positions at a breakline, where one smooth surface does not fit."""
    broken = np.zeros(len(xy), bool)
    doubtful = np.flatnonzero(estimate.misfit)
    for first in range(0, len(doubtful), _PLACES[1]):
        some = doubtful[first : first + _PLACES[1]]
        padded = np.concatenate([some, np.full(_PLACES[1] - len(some), some[0])])
        near, _, _ = _neighbours(grid, xy[padded], k)
        there = near.there & (np.arange(k) < estimate.wide[padded, None])
        near = near._replace(xy=np.where(there[..., None], near.xy, 0.0), there=there)
        broken[some] = np.asarray(call_compiled(lie_on_two_planes, near, estimate.one_surface[padded]))[: len(some)]
    return broken
