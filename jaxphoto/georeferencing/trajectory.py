"""Interpolation of a GNSS/IMU trajectory, with its motion and the uncertainty of the interpolation.

Positions and unit quaternions of the attitudes are interpolated by cubic splines with continuous second derivatives;
quaternions are normalised. The attitude curve is therefore independent of the choice of axes, and both errors decrease
with the fourth power of the spacing h.

The spline through every second record has the error e(2h) at the omitted records, the spline through every fourth
record e(4h). If the error is a power of the spacing, as for smooth motion (16 = 2^4) and for turbulence (about 2^1.5),
then e(h) = e(2h) / [e(4h) / e(2h)]. The ratio is computed from the whole trajectory, e(2h) near the exposure.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.linear_algebra import solve_tridiagonal
from jaxphoto.rotation import matrix_from_quaternion, small_angles
from jaxphoto.short_repr import pretty_repr

SHORTEST = 9
"""Minimum number of records to estimate the uncertainty of the interpolation."""
# Number of records on either side over which e(2h) is averaged.
_HALF_WINDOW = 8


@pretty_repr
class Trajectory(eqx.Module):
    """Records of a GNSS/IMU in the object frame; at least `SHORTEST`, in order of time."""

    time: Float[Array, "records"]
    """Time (s)."""
    position: Float[Array, "records 3"]
    """Position (m)."""
    quaternion: Float[Array, "records 4"]
    """Quaternion (w, x, y, z) of `object_from_body`; body axes right, forward, up."""
    sigma_position: Float[Array, "records 3"]
    """Standard deviations of the position (m)."""
    sigma_attitude: Float[Array, "records 3"]
    """Standard deviations of roll, pitch and yaw (rad)."""

    def __check_init__(self) -> None:
        if len(self.time) < SHORTEST:
            raise ValueError(f"a trajectory needs at least {SHORTEST} records, got {len(self.time)}")


class Poses(NamedTuple):
    """Poses and motion of exposures on a trajectory; `rate` and signs as in `georeferencing.Exposure`."""

    position: Float[Array, "times 3"]
    velocity: Float[Array, "times 3"]
    object_from_body: Float[Array, "times 3 3"]
    rate: Float[Array, "times 3"]
    sigma_position: Float[Array, "times 3"]
    """Standard deviation of trajectory and interpolation together (m)."""
    sigma_attitude: Float[Array, "times 3"]
    """Standard deviation of trajectory and interpolation together: roll, pitch, yaw (rad)."""


def interpolate(trajectory: Trajectory, times: Float[Array, "times"], max_gap: Float[Array, ""] | float) -> Poses:
    """Interpolate position, attitude and motion at `times` (s), differentiable with respect to them.

    The spline is interrupted at intervals longer than `max_gap` (s). Results within such gaps, before the first and
    after the last record are meaningless (see `covered`).
    """
    trajectory = jax.tree.map(jnp.asarray, trajectory)
    spline = spline_through(trajectory, max_gap)
    nodes, joined, times = spline.nodes, spline.joined, times - spline.origin
    at, dot = spline.at(times)
    matrix, rate = _turning(at[:, 3:], dot[:, 3:])

    error = _interpolation_error(nodes, spline.values, joined)
    interval = _interval(nodes, joined, times)
    part = ((times - nodes[interval]) / (nodes[interval + 1] - nodes[interval]))[:, None]
    # Weight of the interpolation error: 0 at the records, 1 midway between them.
    sigma = 4 * part * (1 - part) * ((1 - part) * error[interval] + part * error[interval + 1])
    given = jnp.concatenate([trajectory.sigma_position, trajectory.sigma_attitude], axis=1)
    given = (1 - part) * given[interval] + part * given[interval + 1]
    sigma = jnp.sqrt(given**2 + sigma**2)
    return Poses(at[:, :3], dot[:, :3], matrix, rate, sigma[:, :3], sigma[:, 3:])


def covered(
    trajectory: Trajectory, times: Float[Array, "times"], max_gap: Float[Array, ""] | float
) -> Bool[Array, "times"]:
    """Return True for each time within the trajectory and outside its gaps."""
    return _covered(jnp.asarray(trajectory.time), _joined(trajectory, max_gap), times)


class TrajectorySpline(eqx.Module):
    """Spline through a trajectory, solved once for any number of times."""

    origin: Float[Array, ""]
    """Time of the first record (s)."""
    nodes: Float[Array, "records"]
    """Times of the nodes from the origin (s)."""
    joined: Bool[Array, "intervals"]
    """True for intervals that are not gaps."""
    values: Float[Array, "records 7"]
    """Position (m) and quaternion at the nodes."""
    second: Float[Array, "records 7"]
    """Second derivatives at the nodes."""

    def at(self, times: Float[Array, "m"]) -> tuple[Float[Array, "m 7"], Float[Array, "m 7"]]:
        """Evaluate values and derivatives at times from the first record on (s)."""
        return _on_pieces(self.nodes, self.values, self.second, self.joined, times)

    def poses(self, times: Float[Array, "m"]) -> tuple[Float[Array, "m 3"], Float[Array, "m 3 3"], Bool[Array, "m"]]:
        """Return position (m) and `object_from_body` at times of the trajectory's clock (s), and `covered` per time."""
        times = times - self.origin
        at, _ = self.at(times)
        return at[:, :3], jax.vmap(matrix_from_quaternion)(at[:, 3:]), _covered(self.nodes, self.joined, times)

    def motions(self, times: Float[Array, "m"]) -> tuple[Float[Array, "m 3"], Float[Array, "m 3"]]:
        """Return velocity (m/s) and rotation rate (rad/s), as in `Poses`, at times of the trajectory's clock (s)."""
        at, dot = self.at(times - self.origin)
        return dot[:, :3], _turning(at[:, 3:], dot[:, 3:])[1]


def spline_through(trajectory: Trajectory, max_gap: Float[Array, ""] | float) -> TrajectorySpline:
    """Fit the spline of `interpolate`, interrupted at intervals longer than `max_gap` (s)."""
    joined, nodes = _joined(trajectory, max_gap), trajectory.time - trajectory.time[0]
    values = jnp.concatenate([trajectory.position, _continuous(trajectory.quaternion)], axis=1)
    return TrajectorySpline(trajectory.time[0], nodes, joined, values, _second(nodes, values, joined))


def _turning(
    quaternion: Float[Array, "m 4"], derivative: Float[Array, "m 4"]
) -> tuple[Float[Array, "m 3 3"], Float[Array, "m 3"]]:
    """Return `object_from_body` and the rotation rate about the body axes (rad/s)."""
    matrix, matrix_dot = jax.jvp(jax.vmap(matrix_from_quaternion), (quaternion,), (derivative,))
    # R' dR/dt is the cross-product matrix of the rotation rate about the body axes.
    turn = jnp.einsum("nji,njk->nik", matrix, matrix_dot)
    return matrix, jnp.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)


def _covered(nodes: Float[Array, "n"], joined: Bool[Array, "intervals"], times: Float[Array, "m"]) -> Bool[Array, "m"]:
    return (times >= nodes[0]) & (times <= nodes[-1]) & joined[_interval(nodes, joined, times)]


def _joined(trajectory: Trajectory, max_gap: Float[Array, ""] | float) -> Bool[Array, "intervals"]:
    """Return True for intervals between records that are not gaps."""
    return jnp.diff(trajectory.time) <= max_gap


def _continuous(quaternion: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    """Choose the sign of each quaternion that is closer to the preceding quaternion."""
    turned = jnp.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
    sign = jnp.cumprod(jnp.where(turned, -1.0, 1.0))
    return quaternion * jnp.concatenate([jnp.ones(1), sign])[:, None]


def _interval(nodes: Float[Array, "n"], joined: Bool[Array, "intervals"], times: Float[Array, "m"]) -> Int[Array, "m"]:
    """Return the interval index of each time; at the start of a gap, the preceding interval."""
    i = jnp.clip(jnp.searchsorted(nodes, times, side="right") - 1, 0, len(nodes) - 2)
    return jnp.where((times == nodes[i]) & ~joined[i], jnp.maximum(i - 1, 0), i)


def _second(nodes, values, joined) -> Float[Array, "n k"]:
    """Compute the second derivatives at the nodes of the cubic spline through `values` (n, k).

    The second derivatives s are continuous: h0 s0 + 2 (h0 + h1) s1 + h1 s2 = 6 (d1 - d0) with the divided differences
    d. A segment adjacent to an end or a gap (`joined` False) is a parabola.
    """
    h, zero, no = jnp.diff(nodes), jnp.zeros(1), jnp.zeros(1, bool)
    slope = jnp.diff(values, axis=0) / h[:, None]
    left, right = jnp.concatenate([no, joined]), jnp.concatenate([joined, no])
    inner, first, last = left & right, ~left & right, left & ~right
    h0, h1 = jnp.concatenate([zero, h]), jnp.concatenate([h, zero])
    # For two isolated records both equations agree; use the second equation to make the segment straight.
    alone = last & jnp.concatenate([no, first[:-1]])
    lower = jnp.where(inner, h0, jnp.where(last & ~alone, -1.0, 0.0))
    upper = jnp.where(inner, h1, jnp.where(first, -1.0, 0.0))
    diagonal = jnp.where(inner, 2 * (h0 + h1), 1.0)
    pad = jnp.zeros((1, values.shape[1]))
    bend = 6 * (jnp.concatenate([slope, pad]) - jnp.concatenate([pad, slope]))
    return solve_tridiagonal(lower, diagonal, upper, jnp.where(inner[:, None], bend, 0.0))


def _on_pieces(nodes, values, second, joined, times) -> tuple[Float[Array, "m k"], Float[Array, "m k"]]:
    """Evaluate the spline and its derivative at `times`, given its second derivatives at the nodes."""
    i = _interval(nodes, joined, times)
    step, t = (nodes[i + 1] - nodes[i])[:, None], (times - nodes[i])[:, None]
    s0, s1 = second[i], second[i + 1]
    b = (values[i + 1] - values[i]) / step - step * (2 * s0 + s1) / 6
    d = (s1 - s0) / (6 * step)
    return values[i] + t * (b + t * (s0 / 2 + t * d)), b + t * (s0 + 3 * t * d)


def _interpolation_error(nodes, values, joined) -> Float[Array, "n 6"]:
    """Estimate the interpolation error midway between records near each record: X, Y, Z (m), roll, pitch, yaw (rad)."""
    half, quarter = (
        [sum(part) for part in zip(*(_misfit(nodes, values, joined, every, start) for start in (0, 1)), strict=True)]
        for every in (2, 4)
    )
    # Use the median: near ends and gaps the error is larger and follows a different power of the spacing.
    fine, coarse = (
        jnp.nanmedian(jnp.where(known[:, None] > 0, squares, jnp.nan), axis=0) for squares, known in (half, quarter)
    )
    # Limit the gain: at most 16 (smooth curve), at least 1 (noise of the records).
    gain = jnp.sqrt(jnp.clip(jnp.where(fine > 0, coarse / jnp.where(fine > 0, fine, 1.0), 1.0), 1.0, 16.0**2))
    near = jax.vmap(lambda v: jnp.convolve(v, jnp.ones(2 * _HALF_WINDOW + 1), "same"), 1, 1)
    squares, known = near(half[0]), near(half[1][:, None])
    return jnp.sqrt(squares / jnp.maximum(known, 1.0)) / gain


def _misfit(nodes, values, joined, every: int, start: int) -> tuple[Float[Array, "n 6"], Float[Array, "n"]]:
    """Return squared errors and weights, by record, of a spline through every `every`-th record.

    The errors are those at the records midway between, which have the weight 1. Both are zero at other records and
    close to a gap.
    """
    kept = jnp.arange(start, len(nodes), every)
    middle = kept[:-1] + every // 2
    whole = jnp.all(joined[kept[:-1, None] + jnp.arange(every)], axis=1)
    coarse, some = nodes[kept], values[kept]
    at, _ = _on_pieces(coarse, some, _second(coarse, some, whole), whole, nodes[middle])
    turned = jnp.einsum("nji,njk->nik", *(jax.vmap(matrix_from_quaternion)(v[:, 3:]) for v in (at, values[middle])))
    right, forward, up = jax.vmap(small_angles, out_axes=1)(turned)
    miss = jnp.concatenate([at[:, :3] - values[middle, :3], jnp.stack([forward, right, up], axis=1)], axis=1)
    squares = jnp.zeros((len(nodes), 6)).at[middle].set(jnp.where(whole[:, None], miss**2, 0.0))
    return squares, jnp.zeros(len(nodes)).at[middle].set(jnp.where(whole, 1.0, 0.0))
