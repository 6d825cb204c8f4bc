"""Result of an adjustment: unknowns, residuals, sigma0, redundancy, normal equations, outcome."""

import enum
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment.layout.padded import PaddedValues
from jaxphoto.adjustment.layout.padding import PaddedBlock
from jaxphoto.adjustment.layout.rays import MINIMAL_SIZES, PaddedSizes
from jaxphoto.adjustment.model.numbers import Residuals, Values
from jaxphoto.adjustment.model.structure import Structure, observed_in
from jaxphoto.adjustment.normal_equations import NormalEquations, factor_normal
from jaxphoto.adjustment.solver.elimination import FactoredNormal
from jaxphoto.adjustment.solver.levenberg_marquardt import IterationHistory
from jaxphoto.arrays import ArrayLike, to_numpy
from jaxphoto.block import Block
from jaxphoto.compiling import call_compiled
from jaxphoto.observations import PRIORS
from jaxphoto.short_repr import adjustment_html, adjustment_repr, from_upstairs
from jaxphoto.tracing import refuse_traced
from jaxphoto.unknowns import Unknowns

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxphoto.report.findings import Verdict


class Outcome(enum.Enum):
    """Outcome of the adjustment; the member's value is the message for the user."""

    CONVERGED = "converged: every unknown is within a hundred-thousandth of its standard deviation of the optimum"
    STEPS = (
        "not converged: the step limit was reached; check the approximate values, look for blunders among the largest "
        "residuals, or fix weakly determined unknowns"
    )
    FLAT = (
        "not converged: long steps hardly reduce the residuals, so the observations do not determine some unknowns; "
        "fix them, weight them, or add observations that determine them"
    )
    DIVERGED_POINTS = (
        "not converged: object points diverged (near-parallel rays); check their measurements for blunders, "
        "remove the points, or give better approximate values"
    )
    DIVERGED = (
        "not converged: values became infinite; check units, approximate values, and whether points lie behind "
        "their cameras"
    )


# Ratio of a point's distance to the median distance, above which it has diverged: float64 resolves directions over a
# base of a few nanoradians.
_FARTHEST = 1e7
# Number of axes of the image coordinates of one adjustment: batches, x and y, chunks, rays.
_DIMENSIONS = 4
_factored = eqx.filter_jit(factor_normal)


class Seconds(dict):
    """Seconds by activity. All instances compare equal: no JAX program depends on them."""

    def __hash__(self) -> int:  # type: ignore[override]
        return 0

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Seconds)


class Adjustment(eqx.Module):
    """Result of `jaxphoto.adjust`; `jaxphoto.statistics` computes its statistics.

    `residuals` are observed minus computed over the a priori sigma, by group. `sigma0` is the square root of the a
    posteriori variance factor v'Pv / redundancy.
    """

    block: Block
    priors: Unknowns
    unknowns: Unknowns
    residuals: Residuals
    values: Values
    padded: PaddedBlock = eqx.field(static=True)
    padded_values: PaddedValues
    factored: FactoredNormal | None
    """None if the adjustment is differentiated or mapped; see `equations`."""
    steps: Int[ArrayLike, ""]
    converged: Bool[ArrayLike, ""]
    seconds: dict[str, float] = eqx.field(static=True, converter=lambda v: v if isinstance(v, Seconds) else Seconds(v))
    left_out: tuple[str, ...] = eqx.field(static=True, default=())
    """Omitted tie points of the given block: their rays do not intersect."""
    sizes: PaddedSizes = eqx.field(static=True, default=MINIMAL_SIZES)
    """Minimum sizes it was compiled for; with them the block is re-adjusted by the same program."""

    history: IterationHistory | None = None
    """Iteration history; None inside a JAX transformation and if nothing was iterated."""

    __repr__ = adjustment_repr

    def _repr_html_(self) -> str:
        return adjustment_html(self, self.unknowns.words)

    def verdict(self) -> "Verdict":
        """Verdict (green, amber or red) and its findings (docs/trust.md)."""
        return from_upstairs("verdict_of")(from_upstairs("Tables")(self))

    def plot(self, ax: "Axes | None" = None, *, in_3d: bool = False) -> "Axes":
        """Plot the adjusted block, in plan or in space; returns the matplotlib axes, new ones unless given."""
        return from_upstairs("plot_block")(self, ax, in_3d=in_3d)

    @property
    def structure(self) -> Structure:
        """Index arrays and sizes in block order."""
        return self.padded.own

    @property
    def parameters(self) -> tuple[str, ...]:
        """Paths of all shared parameters, free or fixed, in the order of `values.shared`."""
        return tuple(e.label for e in observed_in(self.block, self.priors).entries)

    @property
    def equations(self) -> NormalEquations:
        """Normal equations for statistics; refactored at each use inside a JAX transformation."""
        s, v = self.padded.structure, self.padded_values
        if self.factored is not None:
            return NormalEquations(v, s, self.factored)
        if v.xy.ndim != _DIMENSIONS:
            raise ValueError(
                "statistics of a batch of adjustments: compute them inside the function that jax.vmap maps"
            )
        return NormalEquations(v, s, call_compiled(_factored, v, s))

    @property
    def sum_of_squares(self) -> Float[ArrayLike, ""] | float:
        """v'Pv: the weighted sum of squared residuals of all observations."""
        return sum(((v**2).sum() for v in self.residuals.named.values()), np.zeros(()))

    @property
    def outcome(self) -> Outcome:
        """Outcome of the adjustment: converged or not, and why."""
        refuse_traced("Adjustment.outcome", self.residuals)
        if bool(self.converged):
            return Outcome.CONVERGED
        if not np.isfinite(float(self.sum_of_squares)):
            return Outcome.DIVERGED
        if self.diverged_points.any():
            return Outcome.DIVERGED_POINTS
        kept = 0 if self.history is None else len(self.history.length)
        flat = self.history is not None and 0 < kept == int(self.steps) and bool(self.history.is_flat(kept - 1))
        return Outcome.FLAT if flat else Outcome.STEPS

    @property
    def diverged_points(self) -> Bool[np.ndarray, "points"]:
        """True for points so distant, compared with the others, that their rays are parallel.

        Their standard deviations are even larger: the optimum is not better than any other such position.
        """
        s, u = self.structure, self.unknowns
        x, y, z = (to_numpy(u.points)[s.point] - to_numpy(u.exterior.position)[s.image]).T
        # Do not square: squares overflow from 1e154 m on.
        distance = np.hypot(np.hypot(x, y), z)
        far = np.zeros(len(self.block.points), bool)
        if len(distance):
            far[s.point[~(distance < _FARTHEST * np.median(distance))]] = True
        return far

    @property
    def n_observations(self) -> dict[str, int]:
        """Number of observations by group: image_points, the groups of `Block.observations`, priors; 0 if none."""
        groups = (self.block.image_points, *self.block.observations)
        none = {rows.group: 0 for rows in groups} | {PRIORS: 0}
        return none | {name: int(np.size(v)) for name, v in self.residuals.named.items()}

    @property
    def n_unknowns(self) -> dict[str, int]:
        """Number of unknowns by kind: interior, scanner, mounts, strips and further declared ones, exterior, points."""
        s = self.structure
        declared = {"scanner": 0} | dict.fromkeys(self.unknowns.tables, 0)
        for t in s.tables:
            stop = t.offset + t.size * len(t.owners)
            declared[t.kind] = int(((s.free >= t.offset) & (s.free < stop)).sum())
        return {
            "interior": int((s.free < s.n_cameras).sum()),
            **declared,
            "exterior": int(s.eop_free.sum()),
            "points": int(s.point_free.sum()),
        }

    @property
    def n_constraints(self) -> int:
        """Number of constraints that fix the datum."""
        return self.residuals.datum.shape[0]

    @property
    def redundancy(self) -> int:
        """Observations plus datum constraints minus unknowns."""
        return sum(self.n_observations.values()) + self.n_constraints - sum(self.n_unknowns.values())

    @property
    def sigma0(self) -> Float[ArrayLike, ""] | float:
        """Square root of the a posteriori variance factor; 1 without redundancy."""
        redundancy = self.redundancy
        return (self.sum_of_squares / redundancy) ** 0.5 if redundancy > 0 else self.sum_of_squares * 0 + 1.0
