"""A sweep: many designs of a block, all adjusted and judged by one compiled program.

A design is a block that is not flown yet: simulated, so that its observations and the truth of its points are known.
Strips, overlap, heights, control and standard deviations may differ from design to design, and with them the numbers
of images and points; blocks are padded to common sizes.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import MAX_STEPS, common_sizes
from jaxphoto.adjustment.rank import DEFECT
from jaxphoto.block import Block
from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.sensitivity.designs import Findings, Prepared, alike, find, prepare_design
from jaxphoto.statistics import EOP_NAMES, Rotations
from jaxphoto.unknowns import Unknowns


class Design(NamedTuple):
    """What tells a design from the others of its sweep, by name (`{"station_m": 0.1, "cross": True}`), and its block.

    `truth` gives the check points' true coordinates (`simulation.Simulation.truth`); None where nobody knows them.
    """

    parameters: Mapping[str, Any]
    block: Block
    truth: Unknowns | None = None


class Sweep(eqx.Module):
    """Standard deviations, correlations and check points of every design, with a leading axis over the designs.

    Standard deviations are a priori (sigma naught 1), because a design is judged before it is measured; in metres,
    radians, mm and the coefficients' own units. What a design does not have (an unknown that is fixed in it, check
    points) is NaN, and so is everything of a design that did not converge or that cannot tell its unknowns apart.
    """

    parameters: tuple[Mapping[str, Any], ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    """Parameter path of each shared unknown of any design, such as `interior[kodak].c_mm`."""
    eop_names: tuple[str, ...] = eqx.field(static=True)
    """X, Y, Z and three rotations."""
    converged: Bool[np.ndarray, "designs"]
    determined: Bool[np.ndarray, "designs"]
    """Whether the observations can tell all unknowns apart."""
    steps: Int[np.ndarray, "designs"]
    redundancy: Int[np.ndarray, "designs"]
    sigma0: Float[np.ndarray, "designs"]
    """Square root of the a posteriori variance factor of the simulated observations."""
    sigma: Float[np.ndarray, "designs shared"]
    correlation: Float[np.ndarray, "designs shared shared"]
    exterior_sigma: Float[np.ndarray, "designs 6"]
    """Root mean square over the images."""
    mean_abs: Float[np.ndarray, "designs 6 shared"]
    """|rho| of exterior orientation and shared unknown: mean over the images of its camera, mount or strip."""
    max_abs: Float[np.ndarray, "designs 6 shared"]
    check_sigma: Float[np.ndarray, "designs 3"]
    """Predicted standard deviation of X, Y, Z (m): root mean square over the check points."""
    check_rmse: Float[np.ndarray, "designs 3"]
    """Root mean square of true minus computed X, Y, Z (m) of the check points, of the simulated observations."""
    programs: int = eqx.field(static=True)
    """How many programs served all designs."""
    seconds: dict[str, float] = eqx.field(static=True)
    """What took how long: prepare (approximate values, padding), compile (or loading what was), designs (computing)."""

    def __len__(self) -> int:
        return len(self.parameters)


def sweep(designs: Sequence[Design], rotations: Rotations = "omega_phi_kappa", *, max_steps: int = MAX_STEPS) -> Sweep:
    """Adjust every design and judge it: what `adjust`, `covariance` and `correlations` say of each by itself.

    `rotations` says which rotations correlations mean (see `jaxphoto.covariance`). One program serves all designs that
    have the same unknowns shared by images (cameras, mounts, strips with shifts) and the same kinds of observations;
    more are compiled where they differ. A design that does not converge is no error: see `Sweep.converged`.

    Raises InputError where there is no design, where parameters' names or the unknowns of the cameras differ from
    design to design, or where a truth is not of its block; and what `jaxphoto.adjust` raises, naming the design, where
    one has no datum, has nothing to see a free unknown by, or has no approximate values.
    """
    _check(designs, rotations)
    seconds: dict[str, float] = {}
    prepared = _prepared(designs, seconds)
    _check_cameras(designs, prepared)
    groups = alike(prepared)
    labels = tuple(dict.fromkeys(label for design in prepared for label in design.labels))
    parts = [
        _in_common(find(alike_ones, rotations, max_steps, seconds), alike_ones, labels)
        for alike_ones in ([prepared[k] for k in group] for group in groups)
    ]
    order = np.argsort(np.concatenate(groups))
    found = jax.tree.map(lambda *v: np.concatenate(v)[order], *parts)
    redundancy = np.array([design.redundancy for design in prepared])
    return _swept(designs, found, redundancy, labels, rotations, len(groups), seconds)


def _check(designs: Sequence[Design], rotations: Rotations) -> None:
    if rotations not in EOP_NAMES:
        raise ValueError(f"rotations is one of {', '.join(EOP_NAMES)}, got {rotations!r}")
    if not len(designs):
        raise InputError("a sweep needs one design at least, but got none: give a list of Design(parameters, block)")
    for k, design in enumerate(designs):
        if list(design.parameters) != list(designs[0].parameters):
            raise InputError(
                f"{_name(k, design)} is told by the parameters {_listed(design.parameters)}, but the first design by "
                f"{_listed(designs[0].parameters)}: give all designs of a sweep the same, in the same order"
            )
        n = len(design.block.points)
        if design.truth is not None and len(design.truth.points) != n:
            raise InputError(
                f"{_name(k, design)} has a truth of {len(design.truth.points)} points, but its block has {n}: give the "
                "truth of the same points, in the order of the block"
            )


def _prepared(designs: Sequence[Design], seconds: dict[str, float]) -> list[Prepared]:
    began = time.perf_counter()
    sizes = common_sizes(design.block for design in designs)
    n_check = max(len(np.unique(design.block.check.who)) for design in designs)
    prepared = []
    for k, design in enumerate(designs):
        try:
            prepared.append(prepare_design(design.block, design.truth, sizes, n_check))
        except JaxphotoError as error:
            raise type(error)(f"{_name(k, design)}: {error}") from error
    seconds["prepare"] = time.perf_counter() - began
    return prepared


def _check_cameras(designs: Sequence[Design], prepared: Sequence[Prepared]) -> None:
    """Raise InputError where the cameras' unknowns are not those of the first design."""
    of_cameras = [[label for label in design.labels if label.startswith("interior[")] for design in prepared]
    for k, labels in enumerate(of_cameras):
        if labels != of_cameras[0]:
            raise InputError(
                f"{_name(k, designs[k])} estimates {_listed(labels)}, but the first design "
                f"{_listed(of_cameras[0])}: give all designs of a sweep the same cameras with the same unknowns"
            )


def _in_common(found: Findings, designs: Sequence[Prepared], labels: tuple[str, ...]) -> Findings:
    """The findings of `designs` with axes over all `labels`, NaN where a design lacks one."""
    n, q = len(designs), len(labels)
    covariance, mean_abs, max_abs = (np.full((n, rows, q), np.nan) for rows in (q, 6, 6))
    for k, design in enumerate(designs):
        # Designs of one program share shapes, not names: their strips may be called otherwise.
        place = np.array([labels.index(label) for label in design.labels], int)
        covariance[k][np.ix_(place, place)] = found.covariance[k]
        mean_abs[k][:, place], max_abs[k][:, place] = found.mean_abs[k], found.max_abs[k]
    return found._replace(covariance=covariance, mean_abs=mean_abs, max_abs=max_abs)


def _swept(
    designs: Sequence[Design],
    found: Findings,
    redundancy: np.ndarray,
    labels: tuple[str, ...],
    rotations: Rotations,
    programs: int,
    seconds: dict[str, float],
) -> Sweep:
    converged = np.asarray(found.converged)
    determined = np.asarray(found.least_pivot) > DEFECT
    useful = converged & determined

    def kept(values):
        """NaN of designs that say nothing."""
        return np.where(useful.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)

    variance = np.maximum(np.diagonal(found.covariance, axis1=1, axis2=2), 0.0)
    sigma = kept(np.sqrt(variance))
    return Sweep(
        parameters=tuple(design.parameters for design in designs),
        labels=labels,
        eop_names=EOP_NAMES[rotations],
        converged=converged,
        determined=determined,
        steps=np.asarray(found.steps),
        redundancy=redundancy,
        sigma0=kept(np.where(redundancy > 0, np.sqrt(found.square_sum / np.maximum(redundancy, 1)), 1.0)),
        sigma=sigma,
        correlation=found.covariance / (sigma[:, :, None] * sigma[:, None, :]),
        exterior_sigma=kept(np.sqrt(found.exterior_variance)),
        mean_abs=kept(found.mean_abs),
        max_abs=kept(found.max_abs),
        check_sigma=kept(np.sqrt(found.check_variance)),
        check_rmse=kept(np.sqrt(found.check_square)),
        programs=programs,
        seconds=seconds,
    )


def _name(k: int, design: Design) -> str:
    told = ", ".join(f"{name} {value}" for name, value in design.parameters.items())
    return f"design {k + 1} ({told})" if told else f"design {k + 1}"


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "nothing"
