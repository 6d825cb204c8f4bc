"""Are variance components and their standard deviations true? Hundreds of simulated flights of P31 answer.

python benchmarks/variance_components.py --draws 500

The example block (31 images) is measured anew with true standard deviations that are other than those it states, in
four parts; every flight's components are set beside the true ones.
"""

import argparse
import time
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

from jaxphoto import Block, Selection, Unknowns, adjust, read_block, variance_components
from jaxphoto.simulation import remeasure

EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "cross_block"
PARTS = {
    "image points": Selection("image_points"),
    "control": Selection("control_points"),
    "stations X-Y": Selection("stations", axes=("X", "Y")),
    "stations Z": Selection("stations", axes="Z"),
}
TRUE = {"image points": 1.5, "control": 6.0, "stations X-Y": 6.0, "stations Z": 4.0}
"""True standard deviations over those that are stated."""


def flight(folder: Path = EXAMPLE) -> tuple[Block, Unknowns]:
    """The example block, and its estimates for truth."""
    block = read_block(folder)
    return block, adjust(block).unknowns


def estimates(block: Block, truth: Unknowns, draws: int, first: int = 0) -> dict[str, np.ndarray]:
    """Factor, sigma and whether it is supported of each part, a flight a row."""
    image, control, plan, height = TRUE.values()
    times = {"control_points": control, "stations": np.where(block.stations.axis == 2, height, plan)}
    named = block.named_observations.items()
    true = block.with_observations(
        {name: rows.with_sigmas_times(np.asarray(times.get(name, image))) for name, rows in named}
    )
    observed = lambda b: (b.image_points.xy, b.stations.value, b.control.value)  # noqa: E731
    drawn = jax.jit(lambda key: observed(remeasure(true, truth, key)))
    rows = []
    for seed in range(first, first + draws):
        new = jax.tree.map(np.asarray, drawn(jax.random.key(seed)))
        rows.append(variance_components(adjust(eqx.tree_at(observed, block, new), truth), PARTS))
    return {name: np.array([getattr(r, name) for r in rows]) for name in ("factor", "sigma", "supported", "converged")}


def main() -> None:
    """Print of each part: true factor, mean, scatter, root mean square of the sigmas, share inside three of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--first", type=int, default=0, help="seed of the first flight")
    arguments = parser.parse_args()
    began = time.perf_counter()
    found = estimates(*flight(), arguments.draws, arguments.first)
    print(f"{arguments.draws} flights in {time.perf_counter() - began:.0f} s, {found['converged'].sum()} converged")
    print("part            true   mean  scatter  rms sigma  inside 3 sigma  supported")
    for k, (label, of) in enumerate(TRUE.items()):
        kept = found["supported"][:, k]
        factor, sigma = found["factor"][kept, k], found["sigma"][kept, k]
        inside, rms = np.mean(np.abs(factor - of**2) < 3 * sigma), np.sqrt(np.mean(sigma**2))
        print(
            f"{label:14s} {of**2:6.2f} {factor.mean():6.3f} {factor.std(ddof=1):8.3f} {rms:10.3f} {inside:15.1%} "
            f"{kept.mean():10.1%}"
        )


if __name__ == "__main__":
    main()
