"""Levenberg-Marquardt for a block, as an optimistix solver that exploits the block's structure.

optimistix runs the iteration. Each iteration evaluates the residuals of one candidate. If it is accepted, the normal
equations are summed there, points are eliminated (`reduced`), the rest is factored (`band`), and a new step is
proposed. Once a step is shorter than a hundredth of the previous one, the factor is reused: such a chord step needs
only the gradient.

With weakly determined unknowns the sum of squares is a narrow, curved valley. A straight step leaves it, and the
damping that keeps the iterate inside makes convergence very slow. Therefore a step v that reduces the sum of squares by
less than the linear model predicts is curved (geodesic acceleration, Transtrum and Sethna 2012). With r'' the second
derivative of the residuals along v,

    (N + D) v = -J'r,    (N + D) a = -J'r'',    x(t) = x + t v + t^2 a / 2

and t is halved until the reduction is close to the prediction for x(t). The acceleration costs one evaluation of the
residuals and one more solution with the same factor.

Stop rule (`LevenbergMarquardt.step`, `settled`): a step is the last if the remaining distance to the optimum,
extrapolated from the last two steps, is below `TOLERANCE` standard deviations of the unknowns, and the damping did not
shorten the step. Otherwise the iteration ends at `SolveMode.max_steps` or in a flat valley
(`IterationHistory.is_flat`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree, Scalar

from jaxphoto.adjustment.layout.padded import PaddedStructure, PaddedValues
from jaxphoto.adjustment.model.block_values import with_datum
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.model.structure import total
from jaxphoto.adjustment.solver.band import BandFactor, factor_band
from jaxphoto.adjustment.solver.elimination import gradient, reduce_right, solve_reduced
from jaxphoto.adjustment.solver.normal import Linearised, Reduced, ResidualRows
from jaxphoto.adjustment.solver.reduced import (
    RightSide,
    border_places,
    image_places,
    linearise_rows,
    reduce_normal,
)
from jaxphoto.adjustment.solver.similarity import after, n_open_motions, onto_datum
from jaxphoto.arrays import ArrayLike
from jaxphoto.short_repr import pretty_repr

# Maximum remaining distance of an unknown from its optimum, as a fraction of its standard deviation.
TOLERANCE = 1e-5
Vector = Float[Array, "unknowns"]
"""Scaled increments as one vector: one operation to compile instead of three."""


class FactoredSystem(NamedTuple):
    """Summed and factored normal equations."""

    reduced: Reduced
    factor: BandFactor


def zero_system(y: Increments, values: PaddedValues, s: PaddedStructure) -> FactoredSystem:
    """Return a system of zeros with the shapes of the factored system, as initial value."""
    n, q, k = 6 * s.n_images, s.n_shared, s.n_coupled + len(values.datum_eop)
    colours, three = image_places(s, k).shape[1], 3 if s.rays.free_points else 0
    n_points, c = y.points.shape[1], border_places(s, k).shape[1]
    size, inner = n // s.rays.columns, s.rays.columns - 1
    factor = BandFactor(
        jnp.zeros((inner, 2 * size, size)), jnp.zeros((q, inner * size)), jnp.zeros((size + q, size + q))
    )
    reduced = Reduced(
        diagonal=jnp.zeros(n + q),
        g=jnp.zeros((n + q, k)),
        k=jnp.zeros((k, k)),
        f=jnp.zeros((*s.rays.ray_point.shape, three, 6 + colours)),
        border=jnp.zeros((n_points, three, c)),
        l=jnp.zeros((6, n_points)),
        weight=jax.tree.map(jnp.zeros_like, y),
        damping=jnp.zeros(()),
    )
    return FactoredSystem(reduced, factor)


class SolveMode(NamedTuple):
    """Purpose of an iteration as array values: one program serves all purposes."""

    max_steps: Int[ArrayLike, ""]
    only_factor: Bool[ArrayLike, ""]
    """True for one undamped step, to compute its system."""


def to_optimum(max_steps: int) -> SolveMode:
    """Iterate to the optimum in at most `steps` steps."""
    return SolveMode(np.array(max_steps), np.array(False))


def to_factor() -> SolveMode:
    """Compute the undamped system at the start."""
    return SolveMode(np.array(1), np.array(True))


@pretty_repr
class IterationHistory(NamedTuple):
    """Iteration history, one value per step: the first `MOST_KEPT` steps, NaN beyond."""

    sum_of_squares: Float[ArrayLike, "steps"]
    """Sum of squares before the step."""
    length: Float[ArrayLike, "steps"]
    """Length of the step in the metric of the normal matrix: an upper bound of |change| / sigma of every unknown."""
    damping: Float[ArrayLike, "steps"]
    """Damping, relative to the diagonal of the normal matrix."""
    accepted: Float[ArrayLike, "steps"]
    """1 if the step was accepted, 0 if it was rejected."""
    bent: Float[ArrayLike, "steps"]
    """Fraction of the step at the end of its curve; 0 for a straight step."""

    def is_flat(self, k: int | Int[Array, ""]) -> Bool[Array, ""] | np.bool_:
        """Return True if the sum of squares hardly decreased in the steps before step k (0, 1, ...), although the steps
        did not shorten.

        Their total decrease was less than the effect of moving one unknown by two standard deviations: the observations
        hardly distinguish these iterates.
        """
        first, within = jnp.maximum(k - _WINDOW, 0), (k >= _WINDOW) & (k < MOST_KEPT)
        fall = self.sum_of_squares[first] - self.sum_of_squares[k]
        return within & (fall < _FALL) & (self.length[k] > _SHRUNK * self.length[first])


# Maximum number of steps in the history. Adjustments converge within tens of steps; only the unknowns and this history
# are stored.
MOST_KEPT = 128
# Number of steps over which the sum of squares must be flat, maximum decrease over them, minimum ratio of last to first
# length.
_WINDOW, _FALL, _SHRUNK = 20, 4.0, 0.5


class Proposal(NamedTuple):
    """Step from the iterate, and the reduction that the linear model predicts."""

    step: Vector
    gradient: Vector
    """J'r at the iterate."""
    half: Vector
    """Half of the acceleration; zero before it is computed."""
    seen: Scalar
    """v'N v of the step v."""
    damped: Scalar
    """v'D v."""
    sum_of_squares: Scalar
    """Sum of squares at the iterate."""
    straight_sum: Scalar
    """Sum of squares after the whole step without acceleration; infinite before it is computed."""

    def part(self, t: Scalar, straight: Bool[Array, ""]) -> Vector:
        """Return the increment after the fraction t of the step, along the curve or `straight`."""
        return t * self.step + jnp.where(straight, 0.0, t**2) * self.half

    @property
    def length(self) -> Scalar:
        """Length in the metric of the normal matrix."""
        return jnp.sqrt(jnp.maximum(self.seen, 0.0))

    def gain(self, t: Scalar, sum_of_squares: Scalar) -> Scalar:
        """Return the ratio of actual to predicted reduction of the sum of squares after the fraction t of the step."""
        return (self.sum_of_squares - sum_of_squares) / (2 * t * (self.seen + self.damped) - t**2 * self.seen)


# Kind of the next candidate: the next iterate (initially, after a rejected step, or after a diverged curve), the whole
# step, a point near the iterate for the second derivative of the residuals, or a point along the curve.
_HERE, _STRAIGHT, _NEAR, _CURVE = range(4)


class SolverState(NamedTuple):
    """State of the solver between two iterations."""

    stage: Int[Array, ""]
    candidate: Vector
    t: Scalar
    """Fraction of the step that leads to the candidate."""
    shortest: Scalar
    """Minimum fraction that is tried."""
    proposal: Proposal
    damping: Scalar
    growth: Scalar
    """Factor of the damping after a rejected step."""
    length: Scalar
    """Length of the last accepted step."""
    system: FactoredSystem
    loose: Bool[Array, ""]
    """True if damping replaces the datum constraints."""
    tightened: Bool[Array, ""]
    """True if damping replaced them before: it does so only once."""
    done: Bool[Array, ""]
    """True at the result of the task: the optimum, or the system."""
    flat: Bool[Array, ""]
    """True if further steps are useless: the sum of squares does not determine the optimum."""
    steps: Int[Array, ""]
    history: Float[Array, "steps numbers"]
    """Fields of an `IterationHistory`, one step per row."""


# Initial damping, relative to the diagonal of the normal matrix, and its initial growth factor. The damping starts
# close to zero. A rejected step v raises it to at least v'N v / v' diag(N) v, the stiffness along v, which about halves
# the step, and then by factors of 2, 4, 8, ... (Nielsen 1999).
_FIRST_DAMPING, _GROWTH = 1e-8, 2.0
# Ratio of actual to predicted reduction above which a step is accepted. Minimum factor of the damping after an accepted
# step; it decreases with that ratio (Nielsen's rule).
_ACCEPT, _LEAST_FACTOR = 0.001, 0.2
# Ratio of actual to predicted reduction below which a step is replaced by a curve; ratio above which a curve is not
# shortened further; minimum fraction t.
_GOOD, _ENOUGH, _SHORTEST = 0.75, 0.25, 0.1
# Maximum displacement by the curvature as a fraction of the step, in the metric of diag(N): 2 |a| / |v| < 1.5
# (Transtrum, Sethna).
_BENT = 0.375
# Fraction of a step used for its second derivative: the difference of residuals retains enough digits.
_DIFFERENCE = 0.01
# Minimum ratio of successive steps assumed when the remaining distance is estimated.
_SLOWEST_SHOWN = 0.1
# Ratio to the previous step below which a step is followed by a chord step with the existing factor. N changes by about
# that fraction, and so does the remaining error after a chord; a new factor takes several times as long. At twice this
# value, large blocks need two more steps than with new factors.
_CHORD = 0.01


class Judgement(NamedTuple):
    """Decision on a candidate."""

    judged: Bool[Array, ""]
    """True if the proposal is accepted or rejected now."""
    accept: Bool[Array, ""]
    bend: Bool[Array, ""]
    """True if the acceleration must be computed first."""
    shorten: Bool[Array, ""]
    """True if a smaller fraction of the curve is tried first."""
    diverged_points: Bool[Array, ""]
    """True if the straight step had a smaller sum of squares than the curve; then the straight step is judged."""
    t: Scalar
    """Fraction of the step that is judged."""
    gain: Scalar
    """Ratio of actual to predicted reduction of the sum of squares."""


def _judged(state: SolverState, sum_of_squares: Scalar, has_losses: bool) -> Judgement:
    """Judge the candidate by its sum of squares."""
    p, straight, curve = state.proposal, state.stage == _STRAIGHT, state.stage == _CURVE
    gain = p.gain(state.t, sum_of_squares)
    # With a robust loss the linear model predicts poorly far from the optimum, even without a curved valley.
    bend = straight & ~(gain >= _GOOD) & jnp.isfinite(sum_of_squares) & (not has_losses)
    shorten = curve & (state.t > state.shortest) & ~(gain >= _ENOUGH)
    judged = (straight & ~bend) | (curve & ~shorten)
    diverged = curve & judged & ~(sum_of_squares < p.straight_sum)
    t = jnp.where(diverged, 1.0, state.t)
    gain = jnp.where(diverged, p.gain(t, p.straight_sum), gain)
    return Judgement(judged, judged & (gain >= _ACCEPT), bend, shorten, diverged, t, gain)


def _next_damping(
    state: SolverState, judged: Bool[Array, ""], accept: Bool[Array, ""], t: Scalar, gain: Scalar, stiffness: Scalar
) -> tuple[Scalar, Scalar]:
    """Reduce damping after an accepted step, by the ratio of actual to predicted reduction; raise it after a rejected
    one.
    """
    # A shortened step does not reduce damping.
    gain = jnp.where(t < 1, jnp.minimum(gain, 0.5), gain)
    less = state.damping * jnp.maximum(_LEAST_FACTOR, 1 - (2 * gain - 1) ** 3)
    # Without datum constraints only damping makes the matrix regular.
    less = jnp.maximum(less, jnp.where(state.loose, _FIRST_DAMPING, 0.0))
    more = jnp.maximum(state.growth * state.damping, stiffness)
    damping, growth = jnp.where(accept, less, more), jnp.where(accept, _GROWTH, _GROWTH * state.growth)
    return jnp.where(judged, damping, state.damping), jnp.where(judged, growth, state.growth)


def as_vector(x: Increments) -> Vector:
    """Return the increments as a vector."""
    return jnp.concatenate([jnp.ravel(v) for v in x])


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver[Vector, Scalar, Any, SolverState]):
    """Levenberg-Marquardt, terminated by the remaining distance to the optimum in standard deviations.

    The function to minimise returns the residuals; the solver computes its own derivatives.

    The length of a step d in the metric of the normal matrix, sqrt(d' N d), bounds |d| / sigma of every single unknown.
    After a step of length l that follows one of length k, about l (l / k) remains; at least a tenth of l is assumed,
    because the first ratios are optimistic: they decrease quadratically until the curvature of the residuals dominates.
    Once the remaining distance is below `tolerance`, the (practically undamped) step is taken as the last.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    structure: PaddedStructure
    values: PaddedValues
    scale: Increments
    tolerance: float
    task: SolveMode

    def __init__(
        self, structure: PaddedStructure, values: PaddedValues, scale: Increments, tolerance: float, task: SolveMode
    ):
        # The convergence test of optimistix is not used: `step` decides.
        self.rtol, self.atol, self.norm = 0.0, 0.0, optx.max_norm
        self.structure, self.values, self.scale = structure, values, scale
        self.tolerance, self.task = tolerance, task

    def increments(self, y: Vector) -> Increments:
        """Convert the vector to increments."""
        n = 6 * self.structure.n_images
        eop, shared, points = jnp.split(y, [n, n + self.structure.n_shared])
        return Increments(eop.reshape(6, -1), shared, points.reshape(3, -1))

    def _at(self, y: Vector, loose: Bool[Array, ""]) -> Linearised:
        v = self.values
        if n_open_motions(v, self.structure):
            v = with_datum(v, jnp.where(loose, 0.0, v.datum_eop), jnp.where(loose, 0.0, v.datum_points))
        return Linearised(self.increments(y), self.scale, v, self.structure)

    def _dot(self, a: Vector, b: Vector) -> Scalar:
        s = self.structure
        if s.shards == 1:
            return jnp.vdot(a, b)
        # Points are sharded.
        n = 6 * s.n_images + s.n_shared
        return jnp.vdot(a[:n], b[:n]) + total(jnp.vdot(a[n:], b[n:]), s)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> SolverState:
        """Start close to Gauss-Newton."""
        no, one, zero = jnp.array(False), jnp.ones(()), jnp.zeros(())
        none = jnp.zeros_like(y)
        return SolverState(
            stage=jnp.array(_HERE),
            candidate=y,
            t=one,
            shortest=one,
            proposal=Proposal(none, none, none, zero, zero, zero, zero),
            damping=jnp.where(self.task.only_factor, 0.0, _FIRST_DAMPING),
            growth=jnp.array(_GROWTH),
            length=jnp.array(jnp.inf),
            system=zero_system(self.increments(y), self.values, self.structure),
            loose=no,
            tightened=no,
            done=no,
            flat=no,
            steps=jnp.array(0),
            history=jnp.full((MOST_KEPT, len(IterationHistory._fields)), jnp.nan),
        )

    def _solved(
        self,
        at: Linearised,
        damping: Scalar,
        rows: ResidualRows | None,
        less: Vector,
        chord: Bool[Array, ""],
        old: FactoredSystem,
    ) -> tuple[FactoredSystem, Vector, Vector]:
        """Return the system, x of (N + D) x = J'r - `less`, and J'r - `less`; a `chord` reuses the `old` system."""
        place = at.for_normal_equations
        # New derivatives overwrite the old F; a chord reuses it.
        linearised = linearise_rows(place, rows, old.reduced.f, chord)
        old = old._replace(reduced=old.reduced._replace(f=linearised.w))

        def by_old() -> tuple[FactoredSystem, RightSide]:
            b = gradient(linearised, place)
            return old, RightSide(b, *reduce_right(old.reduced, b, place))

        def by_new() -> tuple[FactoredSystem, RightSide]:
            a, reduced, right = reduce_normal(place, damping, linearised, self.increments(less))
            return FactoredSystem(reduced, factor_band(a)), right

        system, right = jax.lax.cond(chord, by_old, by_new)
        reduced, factor = system
        x = jax.lax.cond(
            self.task.only_factor,
            lambda: jnp.zeros_like(less),
            lambda: as_vector(solve_reduced(reduced, factor, right.reduced, right.d, right.b.points, place)),
        )
        return system, x, as_vector(right.b)

    def step(self, fn, y, args, options, state: SolverState, tags):
        """Judge the candidate; if it is accepted, propose a step from there."""
        s, p, h, none = self.structure, state.proposal, _DIFFERENCE, jnp.zeros_like(y)
        near, curve = state.stage == _NEAR, state.stage == _CURVE
        here = self._at(state.candidate, state.loose)
        rows, _ = fn(state.candidate, here[1:])
        sum_of_squares = rows.sum_of_squares(s)
        judged, accept, bend, shorten, diverged, t, gain = _judged(state, sum_of_squares, s.has_losses)
        fresh = (state.stage == _HERE) | (accept & ~diverged)
        y = jnp.where(fresh, state.candidate, y)
        reduced = state.system.reduced
        weight, held = as_vector(reduced.weight), reduced.damping
        damping, growth = _next_damping(state, judged, accept, t, gain, p.seen / self._dot(p.step, weight * p.step))
        last = jnp.where(accept, p.length, state.length)
        record = IterationHistory(
            p.sum_of_squares, p.length, held, accept.astype(float), jnp.where(curve & ~diverged, t, 0.0)
        )
        # The record of a candidate that is not judged is overwritten.
        history = state.history.at[state.steps].set(jnp.stack(record), mode="drop")
        is_flat, steps, loose = (
            accept & IterationHistory(*history.T).is_flat(state.steps),
            state.steps + judged,
            state.loose,
        )
        if n_open_motions(self.values, s):
            # Datum constraints linearised at poor initial values make the path curved. Iterate without them, then
            # transform the result onto the datum by a similarity.
            loose = loose | (judged & ~accept & ~state.tightened)

        # Near the optimum N hardly changes: reuse its factor.
        near_optimum = (gain >= _GOOD) & (p.length <= _CHORD * state.length) & jnp.isfinite(state.length)
        chord = accept & (state.stage == _STRAIGHT) & ~loose & near_optimum

        # Near the iterate, r(h v) = r + h J v + h^2 r'' / 2, and (N + D) v = -J'r.
        less = jnp.where(near, (1 - h) * p.gradient - h * held * weight * p.step, 0.0)
        system, x, b = jax.lax.cond(
            fresh | near,
            # For rows with losses, the residuals in the normal equations differ from the residuals of the cost.
            lambda: self._solved(
                self._at(y, loose), damping, None if s.has_losses else rows, less, chord, state.system
            ),
            lambda: (state.system, none, none),
        )
        weight, held = as_vector(system.reduced.weight), system.reduced.damping
        # (N + D) d = -b, so d'N d = -d'b - d'D d, and the linear model predicts d'N d / 2 + d'D d.
        damped = held * self._dot(x, weight * x)
        straight_sum = jnp.where(bend, sum_of_squares, p.straight_sum)
        p = Proposal(
            step=jnp.where(fresh, -x, p.step),
            gradient=jnp.where(fresh, b, p.gradient),
            half=jnp.where(fresh, 0.0, jnp.where(near, -x / h**2, p.half)),
            seen=jnp.where(fresh, self._dot(x, b) - damped, p.seen),
            damped=jnp.where(fresh, damped, p.damped),
            sum_of_squares=jnp.where(fresh, sum_of_squares, p.sum_of_squares),
            straight_sum=jnp.where(fresh, jnp.inf, straight_sum),
        )
        # With an old factor, up to twice the distance remains.
        left = jnp.where(chord, 2.0, 1.0) * p.length / last
        missing = p.length * jnp.clip(left, _SLOWEST_SHOWN, 1.0)
        settled = fresh & (missing <= self.tolerance) & (p.damped <= p.seen + self.tolerance**2)
        settled = settled & (steps < self.task.max_steps) & ~self.task.only_factor
        end = jnp.stack([p.sum_of_squares, p.length, held, jnp.ones(()), jnp.zeros(())])
        history = history.at[jnp.where(settled, steps, MOST_KEPT)].set(end, mode="drop")
        # The last step is short and starts from an accepted iterate: do not evaluate it.
        y, tighten = jnp.where(settled, y + p.step, y), settled & loose
        if n_open_motions(self.values, s):
            y = jax.lax.cond(tighten, lambda y: as_vector(onto_datum(self._at(y, jnp.array(False)))), lambda y: y, y)
        bent = jnp.sqrt(self._dot(p.half, weight * p.half) / self._dot(p.step, weight * p.step))
        begin = jnp.minimum(_BENT / bent, 1.0)
        stages = [tighten, fresh, bend, near, shorten]
        # After a rejected step restore the iterate; after a curve that diverged restore the straight step.
        t = jnp.select(stages, [0.0, 1.0, h, begin, state.t / 2], jnp.where(accept, 1.0, 0.0))
        reached = as_vector(after(self._at(y, loose), self.increments(p.part(t, diverged)), system.reduced.weight))
        progress = SolverState(
            stage=jnp.select(stages, [_HERE, _STRAIGHT, _NEAR, _CURVE, _CURVE], _HERE),
            candidate=jnp.where(t > 0, reached, y),
            t=t,
            shortest=jnp.where(near, _SHORTEST * begin, state.shortest),
            proposal=p,
            damping=jnp.where(tighten, _FIRST_DAMPING, damping),
            growth=growth,
            length=jnp.where(tighten, jnp.inf, last),
            system=system,
            loose=loose & ~tighten,
            tightened=state.tightened | tighten,
            done=(settled & ~tighten) | self.task.only_factor,
            flat=is_flat,
            steps=steps + settled,
            history=history,
        )
        return y, progress, None

    def terminate(self, fn, y, args, options, state: SolverState, tags):
        """Stop after the final step, at the step limit of the task, or in a flat valley."""
        ended = ~state.done & ((state.steps >= self.task.max_steps) | state.flat)
        results = optx.RESULTS
        return state.done | ended, results.where(ended, results.nonlinear_max_steps_reached, results.successful)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Return the iterate unchanged."""
        return y, aux, {}
