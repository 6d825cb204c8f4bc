"""Levenberg-Marquardt for a block, as a solver of optimistix that knows the block's structure.

optimistix runs the iteration. A step sums and factors the normal equations with their points eliminated (`reduced`,
`band`), or, once steps shrink fast, keeps the factor and only takes the gradient anew: a chord step, which costs a
third to a half and near the optimum gains nearly as much.

Where unknowns are weakly determined the square sum is a narrow, bent valley, and a straight step leaves it: by the
damping that it takes to stay inside, such a block creeps. So a step v that reduces the square sum by less than the
linear model promised is bent (geodesic acceleration, Transtrum and Sethna 2012): with r'' the second derivative of the
residuals along v,

    (N + D) v = -J'r,    (N + D) a = -J'r'',    x(t) = x + t v + t^2 a / 2

and t is halved until the reduction is near what x(t) promises. The acceleration costs a gradient and one solution with
the factor that there is, as a chord step does.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree, Scalar

from jaxphoto.adjustment.layout.tiled import TiledStructure, TiledValues
from jaxphoto.adjustment.model.block_values import with_datum
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.solver.band import BandFactor, factor_band
from jaxphoto.adjustment.solver.elimination import Trial, gradient, solve_reduced
from jaxphoto.adjustment.solver.normal import Linearised, Reduced, dot, norm2
from jaxphoto.adjustment.solver.reduced import RightSide, reduce_normal
from jaxphoto.adjustment.solver.similarity import after, n_open_motions, onto_datum
from jaxphoto.arrays import Numbers
from jaxphoto.short_repr import shown


class FactoredSystem(NamedTuple):
    """Normal equations summed and factored at some increments."""

    increments: Increments
    reduced: Reduced
    factor: BandFactor


def zero_system(y: Increments, values: TiledValues, s: TiledStructure) -> FactoredSystem:
    """A system of the right shapes, to begin with."""
    n, q, k = 6 * s.n_images, s.n_shared, s.n_coupled + len(values.datum_eop)
    *tiles, m = s.tiles.image.shape
    f = (*tiles, 6 * m + s.n_interior + s.tiles.met.shape[2] + k + 1, s.tiles.eliminated)
    size, inner = n // s.tiles.columns, s.tiles.columns - 1
    factor = BandFactor(
        jnp.zeros((inner, 2 * size, size)), jnp.zeros((q, inner * size)), jnp.zeros((size + q, size + q))
    )
    reduced = Reduced(
        diagonal=jnp.zeros(n + q),
        g=jnp.zeros((n + q, k)),
        k=jnp.zeros((k, k)),
        f=jnp.zeros(f) if s.tiles.few else None,
        l=jnp.zeros((6, y.points.shape[1])),
        weight=jax.tree.map(jnp.zeros_like, y),
        damping=jnp.zeros(()),
    )
    return FactoredSystem(y, reduced, factor)


class Task(NamedTuple):
    """What an iteration is run for: numbers, so that one program serves every task."""

    max_steps: Int[Numbers, ""]
    only_factor: Bool[Numbers, ""]
    """One undamped step, for the sake of its system."""


def to_optimum(max_steps: int) -> Task:
    """The optimum, in so many steps at most."""
    return Task(np.array(max_steps), np.array(False))


def to_factor() -> Task:
    """The undamped system at the start."""
    return Task(np.array(1), np.array(True))


@shown
class Course(NamedTuple):
    """How an iteration went, a number a step: of the first `MOST_KEPT` steps, NaN beyond."""

    square_sum: Float[Numbers, "steps"]
    """Before the step."""
    length: Float[Numbers, "steps"]
    """Of the step in the metric of the normal matrix: no unknown moves by more of its standard deviations."""
    damping: Float[Numbers, "steps"]
    """Added to the normal matrix, relative to its diagonal."""
    accepted: Float[Numbers, "steps"]
    """1 where the step was taken, 0 where more damping was tried instead."""
    bent: Float[Numbers, "steps"]
    """How far it went along its curve, as a fraction of the step; 0 where it was straight."""

    def is_flat(self, k: int | Int[Array, ""]) -> Bool[Array, ""] | np.bool_:
        """True if the square sum hardly fell in the steps before step k (0, 1 ...), which is as long as they were.

        In all of them it fell by less than moving one unknown by two standard deviations changes it, so the
        observations hardly tell these places apart.
        """
        first, within = jnp.maximum(k - _WINDOW, 0), (k >= _WINDOW) & (k < MOST_KEPT)
        fall = self.square_sum[first] - self.square_sum[k]
        return within & (fall < _FALL) & (self.length[k] > _SHRUNK * self.length[first])


# Adjustments end within tens of steps; the numbers of these are all that is kept besides the unknowns.
MOST_KEPT = 128
# Steps that a flat square sum is told by, its fall, and the ratio of the lengths of the last and the first.
_WINDOW, _FALL, _SHRUNK = 20, 4.0, 0.5


class Proposal(NamedTuple):
    """A straight step from the iterate, and what came of it."""

    step: Increments
    gradient: Increments
    """J'r at the iterate."""
    seen: Scalar
    """v'N v of the step v."""
    damped: Scalar
    """v'D v."""
    square_sum: Scalar
    """At the iterate."""
    trial: Increments
    """After the step."""
    trial_sum: Scalar

    def promised(self, t: Scalar | float) -> Scalar:
        """Reduction of the square sum after the fraction t of the step, by the linear model."""
        return 2 * t * (self.seen + self.damped) - t**2 * self.seen


class SolverState(NamedTuple):
    """The solver's state between two iterations."""

    damping: Scalar
    growth: Scalar
    """Of the damping when a step is rejected."""
    length: Scalar
    """Of the last accepted step, in the metric of the normal matrix."""
    chord: Bool[Array, ""]
    """Whether the next step uses the system as it is."""
    bend: Bool[Array, ""]
    """Whether the next iteration bends the proposal, and takes no step of its own."""
    proposal: Proposal
    system: FactoredSystem
    loose: Bool[Array, ""]
    """Whether damping takes the place of the datum's constraints."""
    tightened: Bool[Array, ""]
    """Whether it did before: it does so once."""
    done: Bool[Array, ""]
    """Whether this is what the task asks for: the optimum, or the system."""
    flat: Bool[Array, ""]
    """True if there is no use in going on: the square sum does not tell where the optimum is."""
    steps: Int[Array, ""]
    course: Course


# Damping is what is added to the normal matrix, relative to its diagonal. It begins almost as none. A rejected step v
# takes it to v'N v / v' diag(N) v at least, the stiffness along v, which about halves the step, and to more by factors
# of 2, 4, 8 ... (Nielsen 1999).
_FIRST_DAMPING, _GROWTH = 1e-8, 2.0
# A step is accepted above this ratio of actual to promised reduction. Damping falls with that ratio (Nielsen's rule),
# at most to this fraction.
_ACCEPT, _LEAST_FACTOR = 0.001, 0.2
# A step below this ratio is bent, and shortened until it is above the second, or below this fraction of its length.
_STRAIGHT, _ENOUGH, _SHORTEST = 0.75, 0.25, 0.1
# Bending moves by this fraction of the step at most, in the metric of diag(N): 2 |a| / |v| < 1.5 (Transtrum, Sethna).
_BENT = 0.375
# The fraction of a step from which its second derivative is found: the difference of residuals has digits enough.
_DIFFERENCE = 0.01
# Ratio of successive steps that is assumed at least when the missing part is estimated.
_SLOWEST_SHOWN = 0.1
# Steps that shrink like this go on with the same factor; a chord step that shrinks less than the second ends it.
_CHORD, _CHORD_FAILS = 0.01, 0.3


def _next_damping(
    state: SolverState, accept: Bool[Array, ""], gain: Scalar, stiffness: Scalar
) -> tuple[Scalar, Scalar]:
    """Less after an accepted step, by the ratio of actual to promised reduction; more after a rejected one."""
    less = state.damping * jnp.maximum(_LEAST_FACTOR, 1 - (2 * gain - 1) ** 3)
    # Nothing else keeps a loose network's matrix regular.
    less = jnp.maximum(less, jnp.where(state.loose, _FIRST_DAMPING, 0.0))
    more = jnp.maximum(state.growth * state.damping, stiffness)
    damping, growth = jnp.where(accept, less, more), jnp.where(accept, _GROWTH, _GROWTH * state.growth)
    # A chord that fails says nothing about the damping: the next step has a factor of its own.
    return jnp.where(state.chord, state.damping, damping), jnp.where(state.chord, state.growth, growth)


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver[Increments, Scalar, Any, SolverState]):
    """Levenberg-Marquardt, stopped by what is still missing to the optimum in standard deviations.

    The function it minimises returns the length of the residual vector; derivatives are the solver's own business.

    The length of a step d in the metric of the normal matrix, sqrt(d' N d), bounds |d| / sigma of every single
    unknown. After a step of length l that follows one of length k about l (l / k) is missing; a tenth of l is assumed
    at least, because the first ratios flatter: they shrink quadratically until the residuals' curvature tells. Once the
    missing part is below `tolerance`, the (practically undamped) step is taken, and is the last.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    structure: TiledStructure
    values: TiledValues
    scale: Increments
    tolerance: float
    task: Task

    def __init__(self, structure: TiledStructure, values: TiledValues, scale: Increments, tolerance: float, task: Task):
        # optimistix' own test of convergence is not used: `step` decides.
        self.rtol, self.atol, self.norm = 0.0, 0.0, optx.max_norm
        self.structure, self.values, self.scale = structure, values, scale
        self.tolerance, self.task = tolerance, task

    def _at(self, y: Increments, loose: Bool[Array, ""]) -> Linearised:
        v = self.values
        if n_open_motions(v, self.structure):
            v = with_datum(v, jnp.where(loose, 0.0, v.datum_eop), jnp.where(loose, 0.0, v.datum_points))
        return Linearised(y, self.scale, v, self.structure)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> SolverState:
        """Almost Gauss-Newton to begin with."""
        damping = jnp.where(self.task.only_factor, 0.0, _FIRST_DAMPING)
        empty = zero_system(y, self.values, self.structure)
        no, steps = jnp.array(False), jnp.array(0)
        course = Course(*(jnp.full(MOST_KEPT, jnp.nan) for _ in Course._fields))
        zero, none = jax.tree.map(jnp.zeros_like, y), jnp.zeros(())
        return SolverState(
            damping,
            jnp.array(_GROWTH),
            jnp.array(jnp.inf),
            no,
            bend=no,
            proposal=Proposal(zero, zero, none, none, none, y, none),
            system=empty,
            loose=no,
            tightened=no,
            done=no,
            flat=no,
            steps=steps,
            course=course,
        )

    def _factored(self, at: Linearised, damping) -> tuple[FactoredSystem, RightSide]:
        a, reduced, right = reduce_normal(at.for_normal_equations, damping)
        return FactoredSystem(at.increments, reduced, factor_band(a)), self._with_cost(right, at)

    def _kept(self, at: Linearised, state: SolverState) -> tuple[FactoredSystem, RightSide]:
        """The gradient there, or J'r'' of the proposal, taken down by the system that there is."""
        here, system, p, h = at.for_normal_equations, state.system, state.proposal, _DIFFERENCE
        weight, damping = system.reduced.weight, system.reduced.damping
        # r(h v) = r + h J v + h^2 r'' / 2, and (N + D) v = -J'r.
        linear = jax.tree.map(lambda b, v, w: (1 - h) * b - h * damping * w * v, p.gradient, p.step, weight)
        # What a similarity adds to the step (`after`) goes with the square of it.
        near = jax.tree.map(lambda y, v, end: y + h * v + h**2 * (end - y - v), at.increments, p.step, p.trial)
        trial = Trial(state.bend, near, linear)
        right = RightSide(*gradient(here, system.reduced, here._replace(increments=system.increments), trial))
        return system, self._with_cost(right, at)

    def _with_cost(self, right: RightSide, at: Linearised) -> RightSide:
        """With what is minimised for the square sum: of rows with losses, the normal equations do not tell."""
        return right._replace(square_sum=at.square_sum()) if self.structure.has_losses else right

    def step(self, fn, y, args, options, state: SolverState, tags):
        """Propose a step; take it if it is good, and damp more if not."""
        at, bend = self._at(y, state.loose), state.bend
        system, right = jax.lax.cond(
            state.chord | bend, lambda: self._kept(at, state), lambda: self._factored(at, state.damping)
        )
        place = at.for_normal_equations._replace(increments=system.increments)
        only_factor, weight = self.task.only_factor, system.reduced.weight
        x = jax.lax.cond(
            only_factor,
            lambda: jax.tree.map(jnp.zeros_like, y),
            lambda: solve_reduced(system.reduced, system.factor, right.reduced, right.d, right.b.points, place),
        )
        pick = lambda which, a, b: jax.tree.map(lambda a, b: jnp.where(which, a, b), a, b)  # noqa: E731
        # (N + D) d = -b, so d'N d = -d'b - d'D d, and the linear model promises d'N d / 2 + d'D d.
        damped = system.reduced.damping * norm2(x, weight, self.structure)
        seen = dot(x, right.b, self.structure) - damped
        straight = Proposal(jax.tree.map(jnp.negative, x), right.b, seen, damped, right.square_sum, y, right.square_sum)
        p = pick(bend, state.proposal, straight)
        half = jax.tree.map(lambda x: jnp.where(bend, -x / _DIFFERENCE**2, 0.0), x)
        length = jnp.sqrt(jnp.maximum(p.seen, 0.0))
        ratio = length / state.length
        missing = length * jnp.clip(ratio, _SLOWEST_SHOWN, 1.0)
        settled = (missing <= self.tolerance) & (p.damped <= p.seen + self.tolerance**2) & ~bend
        new_y, square_sum, t = self._along(at, p, half, weight, fn, bend, settled | only_factor)
        no_better = bend & ~(square_sum < p.trial_sum)
        new_y, square_sum, t = pick(no_better, (p.trial, p.trial_sum, 1.0), (new_y, square_sum, t))
        gain = (p.square_sum - square_sum) / p.promised(t)
        bend_next = ~(settled | only_factor | state.chord | bend) & ~(gain >= _STRAIGHT) & jnp.isfinite(square_sum)
        # Of a loss the linear model promises little far from the optimum, where the way is not a bent valley.
        bend_next = bend_next & (not self.structure.has_losses)
        accept = (settled | (gain >= _ACCEPT)) & ~bend_next
        chord_failed = state.chord & ~(accept & (ratio < _CHORD_FAILS))
        # One that had to be shortened is no reason for less damping.
        shown = jnp.where(t < 1, jnp.minimum(gain, 0.5), gain)
        stiffness = p.seen / norm2(p.step, weight, self.structure)
        damping, growth = pick(bend_next, (state.damping, state.growth), _next_damping(state, accept, shown, stiffness))
        next_y, loose, tighten = pick(accept, new_y, y), state.loose, jnp.array(False)
        if n_open_motions(self.values, self.structure):
            # Held about a start that is far off, the constraints bend the path: it goes on without them, and what it
            # ends at is brought to them as a whole.
            tighten = settled & state.loose
            next_y = jax.lax.cond(tighten, lambda y: onto_datum(self._at(y, jnp.array(False))), lambda y: y, next_y)
            loose = (state.loose | (~accept & ~bend_next & ~state.chord & ~state.tightened)) & ~tighten
        told = Course(
            p.square_sum, length, system.reduced.damping, accept.astype(float), jnp.where(bend & ~no_better, t, 0.0)
        )
        kept = (jnp.asarray(v).at[state.steps].set(one, mode="drop") for v, one in zip(state.course, told, strict=True))
        course = Course(*kept)
        progress = SolverState(
            damping=jnp.where(tighten, _FIRST_DAMPING, damping),
            growth=growth,
            length=jnp.where(tighten, jnp.inf, pick(accept, length, state.length)),
            chord=accept & ~chord_failed & ~tighten & (state.chord | ((ratio < _CHORD) & jnp.isfinite(state.length))),
            bend=bend_next,
            proposal=p._replace(trial=new_y, trial_sum=square_sum),
            system=system,
            loose=loose,
            tightened=state.tightened | tighten,
            done=(settled & ~tighten) | only_factor,
            flat=accept & course.is_flat(state.steps),
            steps=state.steps + jnp.where(bend_next, 0, 1),
            course=course,
        )
        return next_y, progress, None

    def _along(self, at: Linearised, p: Proposal, half: Increments, weight: Increments, fn, bend, is_last):
        """Where the step with half its acceleration leads, the square sum there, and the fraction of it.

        A straight step (no acceleration) is tried as it is, one along a curve shorter and shorter.
        """
        norm = lambda v: jnp.sqrt(norm2(v, weight, self.structure))  # noqa: E731
        farthest = _BENT * norm(p.step) / norm(half)
        begin = jnp.where(bend & (farthest < 1), farthest, 1.0)
        end = jnp.where(bend, _SHORTEST, 1.0) * begin
        along = lambda t: after(at, jax.tree.map(lambda v, a: t * v + t**2 * a, p.step, half), weight)  # noqa: E731

        def too_long(tried):
            t, _, square_sum = tried
            return (t > end) & ~(p.square_sum - square_sum >= _ENOUGH * p.promised(t))

        def shorter(tried):
            t = tried[0] / 2
            y = along(t)
            # The last step is short and was computed from an accepted iterate: it needs no proof.
            return t, y, jax.lax.cond(is_last, lambda: p.square_sum, lambda: fn(y, at[1:])[0] ** 2)

        t, y, square_sum = jax.lax.while_loop(too_long, shorter, (2 * begin, p.trial, jnp.array(jnp.inf)))
        return y, square_sum, t

    def terminate(self, fn, y, args, options, state: SolverState, tags):
        """After the step that did it, the last that the task allows, or many in vain."""
        ended = ~state.done & ((state.steps >= self.task.max_steps) | state.flat)
        results = optx.RESULTS
        return state.done | ended, results.where(ended, results.nonlinear_max_steps_reached, results.successful)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Nothing is left to do."""
        return y, aux, {}
