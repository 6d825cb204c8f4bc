"""Interpolation of a GNSS/IMU trajectory, with its motion and the uncertainty of the interpolation.

Positions and unit quaternions of the attitudes are interpolated by cubic splines with continuous second derivatives;
quaternions are normalised. The attitude curve thus does not depend on the axes in which it is written, and both errors
decrease with the fourth power of the spacing h.

The spline over every second record misses the omitted records by e(2h), that over every fourth by e(4h). If the error
is a power of the spacing, as for smooth motion (16 = 2^4) and for turbulence (about 2^1.5), then e(h) = e(2h) / [e(4h)
/ e(2h)]. The ratio is taken over the whole trajectory, e(2h) at the exposure.
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
"""Minimum number of records for the uncertainty of the interpolation."""
# e(2h) is averaged over this number of records on either side.
_HALF_WINDOW = 8


@pretty_repr
class Trajectory(eqx.Module):
    """Records of a GNSS/IMU in the object frame; at least `SHORTEST`, in order of time."""

    time: Float[Array, "records"]
    """Seconds."""
    position: Float[Array, "records 3"]
    """Metres."""
    quaternion: Float[Array, "records 4"]
    """(w, x, y, z) of `object_from_body`; body axes right, forward, up."""
    sigma_position: Float[Array, "records 3"]
    """Metres."""
    sigma_attitude: Float[Array, "records 3"]
    """Of roll, pitch and yaw, radians."""

    def __check_init__(self) -> None:
        if len(self.time) < SHORTEST:
            raise ValueError(f"a trajectory needs at least {SHORTEST} records, got {len(self.time)}")


class Poses(NamedTuple):
    """Poses and motion of exposures on a trajectory; `rate` and the signs are those of `georeferencing.Exposure`."""

    position: Float[Array, "times 3"]
    velocity: Float[Array, "times 3"]
    object_from_body: Float[Array, "times 3 3"]
    rate: Float[Array, "times 3"]
    sigma_position: Float[Array, "times 3"]
    """Of trajectory and interpolation together (m)."""
    sigma_attitude: Float[Array, "times 3"]
    """Of trajectory and interpolation together: roll, pitch, yaw (rad)."""


def interpolate(trajectory: Trajectory, times: Float[Array, "times"], max_gap: Float[Array, ""] | float) -> Poses:
    """Interpolate position, attitude and motion at `times` (s), differentiable with respect to them.

    No spline crosses an interval longer than `max_gap` (s): results within one, before the first and after the last
    record are meaningless (`covered`).
    """
    trajectory = jax.tree.map(jnp.asarray, trajectory)
    spline = spline_through(trajectory, max_gap)
    nodes, joined, times = spline.nodes, spline.joined, times - spline.origin
    at, dot = spline.at(times)
    matrix, rate = _turning(at[:, 3:], dot[:, 3:])

    error = _interpolation_error(nodes, spline.values, joined)
    interval = _interval(nodes, joined, times)
    part = ((times - nodes[interval]) / (nodes[interval + 1] - nodes[interval]))[:, None]
    # Zero at the records, the full error half way between them.
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
    """Seconds from the origin."""
    joined: Bool[Array, "intervals"]
    """True for intervals that are not a gap."""
    values: Float[Array, "records 7"]
    """Position (m) and quaternion."""
    second: Float[Array, "records 7"]
    """Second derivatives."""

    def at(self, times: Float[Array, "m"]) -> tuple[Float[Array, "m 7"], Float[Array, "m 7"]]:
        """Evaluate values and derivatives at times from the first record on (s)."""
        return _on_pieces(self.nodes, self.values, self.second, self.joined, times)

    def poses(self, times: Float[Array, "m"]) -> tuple[Float[Array, "m 3"], Float[Array, "m 3 3"], Bool[Array, "m"]]:
        """Return position (m) and `object_from_body` at times of the trajectory's clock (s), and which of these are
        covered.
        """
        times = times - self.origin
        at, _ = self.at(times)
        return at[:, :3], jax.vmap(matrix_from_quaternion)(at[:, 3:]), _covered(self.nodes, self.joined, times)

    def motions(self, times: Float[Array, "m"]) -> tuple[Float[Array, "m 3"], Float[Array, "m 3"]]:
        """Return velocity (m/s) and rotation rate (rad/s), as in `Poses`, at times of the trajectory's clock (s)."""
        at, dot = self.at(times - self.origin)
        return dot[:, :3], _turning(at[:, 3:], dot[:, 3:])[1]


def spline_through(trajectory: Trajectory, max_gap: Float[Array, ""] | float) -> TrajectorySpline:
    """Fit the spline of `interpolate`, which crosses no interval longer than `max_gap` (s)."""
    joined, nodes = _joined(trajectory, max_gap), trajectory.time - trajectory.time[0]
    values = jnp.concatenate([trajectory.position, _continuous(trajectory.quaternion)], axis=1)
    return TrajectorySpline(trajectory.time[0], nodes, joined, values, _second(nodes, values, joined))


def _turning(
    quaternion: Float[Array, "m 4"], derivative: Float[Array, "m 4"]
) -> tuple[Float[Array, "m 3 3"], Float[Array, "m 3"]]:
    """Return `object_from_body`, and its rotation rate about the body's axes (rad/s)."""
    matrix, matrix_dot = jax.jvp(jax.vmap(matrix_from_quaternion), (quaternion,), (derivative,))
    # R' dR/dt is the cross product with the rotation rate about the body's axes.
    turn = jnp.einsum("nji,njk->nik", matrix, matrix_dot)
    return matrix, jnp.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)


def _covered(nodes: Float[Array, "n"], joined: Bool[Array, "intervals"], times: Float[Array, "m"]) -> Bool[Array, "m"]:
    return (times >= nodes[0]) & (times <= nodes[-1]) & joined[_interval(nodes, joined, times)]


def _joined(trajectory: Trajectory, max_gap: Float[Array, ""] | float) -> Bool[Array, "intervals"]:
    """Return True for intervals between records that are not a gap."""
    return jnp.diff(trajectory.time) <= max_gap


def _continuous(quaternion: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    """Choose the sign of each quaternion closer to the one before."""
    turned = jnp.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
    sign = jnp.cumprod(jnp.where(turned, -1.0, 1.0))
    return quaternion * jnp.concatenate([jnp.ones(1), sign])[:, None]


def _interval(nodes: Float[Array, "n"], joined: Bool[Array, "intervals"], times: Float[Array, "m"]) -> Int[Array, "m"]:
    """Return the interval of each time; the one before a record at the start of a gap."""
    i = jnp.clip(jnp.searchsorted(nodes, times, side="right") - 1, 0, len(nodes) - 2)
    return jnp.where((times == nodes[i]) & ~joined[i], jnp.maximum(i - 1, 0), i)


def _second(nodes, values, joined) -> Float[Array, "n k"]:
    """Return second derivatives at the nodes of the cubic spline through `values` (n, k).

    Those of the pieces, s, are continuous, h0 s0 + 2 (h0 + h1) s1 + h1 s2 = 6 (d1 - d0) with d the divided differences;
    a piece next to an end, or to a gap (`joined` false), is a parabola.
    """
    h, zero, no = jnp.diff(nodes), jnp.zeros(1), jnp.zeros(1, bool)
    slope = jnp.diff(values, axis=0) / h[:, None]
    left, right = jnp.concatenate([no, joined]), jnp.concatenate([joined, no])
    inner, first, last = left & right, ~left & right, left & ~right
    h0, h1 = jnp.concatenate([zero, h]), jnp.concatenate([h, zero])
    # For two isolated records both equations agree; the second then makes the piece straight.
    alone = last & jnp.concatenate([no, first[:-1]])
    lower = jnp.where(inner, h0, jnp.where(last & ~alone, -1.0, 0.0))
    upper = jnp.where(inner, h1, jnp.where(first, -1.0, 0.0))
    diagonal = jnp.where(inner, 2 * (h0 + h1), 1.0)
    pad = jnp.zeros((1, values.shape[1]))
    bend = 6 * (jnp.concatenate([slope, pad]) - jnp.concatenate([pad, slope]))
    return solve_tridiagonal(lower, diagonal, upper, jnp.where(inner[:, None], bend, 0.0))


def _on_pieces(nodes, values, second, joined, times) -> tuple[Float[Array, "m k"], Float[Array, "m k"]]:
    """Evaluate values and derivatives at `times` of the spline with these second derivatives at its nodes."""
    i = _interval(nodes, joined, times)
    step, t = (nodes[i + 1] - nodes[i])[:, None], (times - nodes[i])[:, None]
    s0, s1 = second[i], second[i + 1]
    b = (values[i + 1] - values[i]) / step - step * (2 * s0 + s1) / 6
    d = (s1 - s0) / (6 * step)
    return values[i] + t * (b + t * (s0 / 2 + t * d)), b + t * (s0 + 3 * t * d)


def _interpolation_error(nodes, values, joined) -> Float[Array, "n 6"]:
    """Return the error half way to the next record, near each record: X, Y, Z (m), roll, pitch, yaw (rad)."""
    half, quarter = (
        [sum(part) for part in zip(*(_misfit(nodes, values, joined, every, start) for start in (0, 1)), strict=True)]
        for every in (2, 4)
    )
    # Median: next to ends and gaps a spline has larger errors, of another power.
    fine, coarse = (
        jnp.nanmedian(jnp.where(known[:, None] > 0, squares, jnp.nan), axis=0) for squares, known in (half, quarter)
    )
    # 16 is the maximum gain for a smooth curve, 1 that for noise of the records.
    gain = jnp.sqrt(jnp.clip(jnp.where(fine > 0, coarse / jnp.where(fine > 0, fine, 1.0), 1.0), 1.0, 16.0**2))
    near = jax.vmap(lambda v: jnp.convolve(v, jnp.ones(2 * _HALF_WINDOW + 1), "same"), 1, 1)
    squares, known = near(half[0]), near(half[1][:, None])
    return jnp.sqrt(squares / jnp.maximum(known, 1.0)) / gain


def _misfit(nodes, values, joined, every: int, start: int) -> tuple[Float[Array, "n 6"], Float[Array, "n"]]:
    """Return squared errors of the spline over every `every`-th record at the records half way between, and which these
    are.

    Both are zero at other records, and close to a gap.
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
