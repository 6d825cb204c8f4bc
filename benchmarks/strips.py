"""Simulated laser strips fitted to each other: how well they fit, and whether what was wrong lies inside its intervals.

python benchmarks/strips.py [--flights 200] [--first 1000] [--pattern circle] [--out DIR]

Each flight is that of the tests (three strips over hills with roofs and trees; boresight, range offset and angle scale
are wrong, the trajectory drifts) with errors of the trajectory, noise and trees of its own. Figures: gaps of the planes
that two strips have in common before and after, the parts of parameters and of errors of the trajectory that lie inside
their 95 %, mean and rms of the parameters' errors over their standard deviations.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from machine import HERE, machine, markdown, sentence, write_results

sys.path.insert(0, str(HERE.parent))

# Standard deviations of a normal error within which 95 % lie.
_WITHIN = 1.959964


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--first", type=int, default=1000, help="seed of the first flight")
    parser.add_argument("--pattern", choices=("line", "circle"), default="line", help="of the scanner")
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    arguments = parser.parse_args()
    head, records = machine(), []
    for seed in range(arguments.first, arguments.first + arguments.flights):
        began = time.perf_counter()
        records.append(adjusted(seed, arguments.pattern) | {"seed": seed, "seconds": time.perf_counter() - began})
        print({k: v for k, v in records[-1].items() if k != "trajectory"}, flush=True)
    write_results(arguments.out, "strips", records, f"{sentence(head)}\n\n{table(records)}")
    return 0


def adjusted(seed: int, pattern: str) -> dict:
    """One flight: its parameters' errors over their standard deviations, and its gaps."""
    from jaxphoto.errors import JaxphotoError
    from jaxphoto.procedures.lidar import adjust_strips
    from tests.procedures.strips import AROUND, PRIORS, PRIORS_AROUND, SETTINGS, STRIPS
    from tests.simulation.small import made

    recipe, priors = (AROUND, PRIORS_AROUND) if pattern == "circle" else (STRIPS, PRIORS)
    flight = made(recipe, seed)
    try:
        found = adjust_strips(flight.cloud, flight.trajectory, SETTINGS, priors)
    except JaxphotoError as error:
        return {"failed": str(error)}
    errors, structure = flight.errors, found.adjusted.structure
    value = np.asarray(found.adjusted.values.shared)[structure.free]
    labels = np.array([structure.labels[k] for k in range(len(structure.labels))])
    own = np.array([label.startswith("scanner") for label in labels])
    truth = [*errors.boresight, float(errors.calibration.range_offset), float(errors.calibration.angle_scale)]
    matrix = np.asarray(found.covariance.matrix)
    sigma, off = np.sqrt(np.diagonal(matrix)), value[own] - truth
    # Knots come one after the other, three numbers of position and three of attitude each.
    knots = np.column_stack([errors.position, errors.attitude]).ravel()
    return {
        "converged": found.converged,
        "sigma0": float(found.adjusted.sigma0),
        "before_m": _rms([d.rms_before_m for d in found.differences]),
        "after_m": _rms([d.rms_m for d in found.differences]),
        "noise_m": _rms([d.noise_m for d in found.differences]),
        "chi2": float(off @ np.linalg.solve(matrix[np.ix_(own, own)], off)),
        "parameters": dict(zip(labels[own].tolist(), (off / sigma[own]).round(3).tolist(), strict=True)),
        "trajectory": ((value[~own] - knots) / sigma[~own]).round(3).tolist(),
    }


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def table(records: list[dict]) -> str:
    """Two tables: all flights together, and each parameter."""
    good = [r for r in records if "failed" not in r]
    w = np.array([list(r["parameters"].values()) for r in good])
    all_w = np.concatenate([np.ravel(w), *(r["trajectory"] for r in good)])
    chi2, restless = np.array([r["chi2"] for r in good]), sum(not r["converged"] for r in good)
    rows = [
        ["flights, failed, not still", f"{len(records)}, {len(records) - len(good)}, {restless}"],
        ["gaps before, after, of noise alone (mm)", ", ".join(f"{1000 * _rms([r[k] for r in good]):.1f}" for k in
                                                            ("before_m", "after_m", "noise_m"))],
        ["sigma naught, mean", f"{np.mean([r['sigma0'] for r in good]):.3f}"],
        ["inside 95 %, all unknowns", f"{100 * np.mean(np.abs(all_w) < _WITHIN):.2f} %"],
        ["chi squared of the scanner, mean (expected)", f"{chi2.mean():.2f} ({w.shape[1]})"],
        ["seconds a flight, median", f"{np.median([r['seconds'] for r in good]):.1f}"],
    ]  # fmt: skip
    each = [
        [name, f"{w[:, k].mean():+.2f}", f"{np.sqrt(np.mean(w[:, k] ** 2)):.2f}",
         f"{100 * np.mean(np.abs(w[:, k]) < _WITHIN):.1f} %", f"{100 * np.mean(np.abs(w[:, k]) < 3):.1f} %"]
        for k, name in enumerate(good[0]["parameters"])
    ]  # fmt: skip
    head = ["error over sigma", "mean", "rms", "inside 95 %", "inside 3 sigma"]
    return "\n".join([*markdown(["", "figure"], rows), "", *markdown(head, each)])


if __name__ == "__main__":
    sys.exit(main())
