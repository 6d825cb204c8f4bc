"""Variance components as tables, a line each on the screen, and what to be warned of."""

from collections.abc import Sequence

import pandas as pd
from rich.console import Console

from jaxphoto.errors import counted, few
from jaxphoto.procedures.weights import MadeByBlunders
from jaxphoto.report.findings import Finding, Level
from jaxphoto.report.terminal import plain
from jaxphoto.statistics import VarianceComponents


def component_tables(found: VarianceComponents) -> dict[str, pd.DataFrame]:
    """By the name of the file: variance_components, and variance_component_correlation.

    Columns are group, observations, redundancy, factor, sigma_factor, degrees_of_freedom, supported; and group_a,
    group_b, rho. A group that cannot support a component has the factor 1 and no sigma.
    """
    table = pd.DataFrame(
        {
            "group": found.labels,
            "observations": found.observations,
            "redundancy": found.redundancy,
            "factor": found.factor,
            "sigma_factor": found.sigma,
            "degrees_of_freedom": found.degrees,
            "supported": found.supported,
        }
    )
    known = [(k, label) for k, label in enumerate(found.labels) if found.supported[k]]
    rows = [(a, b, found.correlation[j, k]) for j, a in known for k, b in known if j != k]
    return {
        "variance_components": table,
        "variance_component_correlation": pd.DataFrame(rows, columns=["group_a", "group_b", "rho"]),
    }


def component_findings(found: VarianceComponents, blunders: Sequence[MadeByBlunders] = ()) -> list[Finding]:
    """Components that blunders make, that have not settled, then a sentence for each group that cannot support one."""
    alarms = [
        f"the variance component {made.factor:.3g} of {made.label} comes of what contradicts the other observations: "
        f"{few(list(made.words))}; without, it is {made.without:.2g}. Blunders are no weight of the sound ones: adjust "
        "with --snoop as well"
        for made in blunders
    ]
    lost = f"variance components not converged after {found.iterations} iterations: estimate them for fewer groups"
    sentences = [*([] if found.converged else [lost]), *found.warnings.values()]
    return [
        *(Finding(Level.ALARM, text) for text in alarms),
        *(Finding(Level.WARNING, text) for text in sentences),
    ]


def print_components(found: VarianceComponents, console: Console) -> None:
    """A line for each group: by what its standard deviations were multiplied, and the variance factor."""
    console.print(f"variance components, adjusted with them ({counted(found.iterations, 'iteration')}):")
    for k, label in enumerate(found.labels):
        factor, sigma = found.factor[k], found.sigma[k]
        said = f"standard deviations x {factor**0.5:.3g}, variances x {factor:.3g} +- {sigma:.2g}"
        from_ = f"({counted(found.observations[k], 'observation')}, redundancy {found.redundancy[k]:.1f})"
        line = f"  {label}: {said if found.supported[k] else 'as stated'} {from_}"
        console.print(plain(line), soft_wrap=True)
