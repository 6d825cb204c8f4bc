"""Trajectory, scanner and camera of simulated flights adjusted at once, and in two steps: lidar first, then images.

python benchmarks/joint.py [--flights 40] [--first 2000] [--draws 400] [--out DIR]

Each flight is that of tests/procedures/joint.py (three strips of laser returns and photographs on one trajectory that
drifts; boresight, range offset and angle scale of the scanner, c, principal point, radial distortion and boresight of
the camera unknown), with errors, noise and trees of its own. The two steps are those of the commands: `strips`, then
`simultaneous` with the corrected cloud held, stations and attitudes from the corrected trajectory.

Figures: standard deviations and errors of both ways, parts of errors inside their 95 %; tie points that were not
observed to lie on planes beside the surface; correlations of scanner and camera beside those of Monte Carlo draws of
the first flight, and beside the scatter of all.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import numpy as np
from machine import HERE, machine, markdown, sentence, write_results

sys.path.insert(0, str(HERE.parent))

# Standard deviations of a normal error within which 95 % lie.
_WITHIN = 1.959964
# Correlations of scanner and camera that are shown at most.
_PAIRS = 12


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--first", type=int, default=2000, help="seed of the first flight")
    parser.add_argument("--draws", type=int, default=400, help="of the Monte Carlo of the first flight")
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    arguments = parser.parse_args()
    head, records = machine(), []
    for seed in range(arguments.first, arguments.first + arguments.flights):
        began = time.perf_counter()
        draws = arguments.draws if seed == arguments.first else 0
        records.append(flown(seed, draws) | {"seed": seed, "seconds": time.perf_counter() - began})
        shown = {k: v for k, v in records[-1].items() if k not in ("trajectory", "rho", "drawn")}
        print(shown, flush=True)
    write_results(arguments.out, "joint", records, f"{sentence(head)}\n\n{table(records)}")
    return 0


def flown(seed: int, draws: int) -> dict:
    """One flight both ways: errors and standard deviations of its parameters."""
    from jaxphoto.errors import JaxphotoError
    from jaxphoto.procedures.lidar import adjust_strips
    from tests.procedures.joint import adjusted_together, simulated, truth
    from tests.procedures.strips import PRIORS, SETTINGS

    flight = simulated(seed)
    true = truth(flight)
    try:
        together = adjusted_together(flight)
        lidar = adjust_strips(flight.cloud, flight.trajectory, SETTINGS, PRIORS)
        images = second_step(flight, lidar)
    except JaxphotoError as error:
        return {"failed": str(error)}
    joint, scanner = estimates(together.adjusted), estimates(lidar.adjusted)
    knots = np.column_stack([flight.errors.position, flight.errors.attitude]).ravel()
    known = [v for label, v in joint.items() if label.startswith("trajectory_knots")]
    record = {
        "converged": together.converged,
        "sigma0": float(together.adjusted.sigma0),
        "joint": compared(joint, true),
        "two_steps": compared(scanner | estimates(images), true),
        "trajectory": [round((v - t) / s, 3) for (v, s), t in zip(known, knots, strict=True)],
        "on_planes_m": _rms([d.rms_m for d in together.differences if d.one == "photographs"]),
        "check_points": check_points(flight, together),
        "rho": correlations(together),
    }
    return record | ({"drawn": drawn(together, draws)} if draws else {})


def second_step(flight, lidar):
    """The photographs with the corrected cloud held, their stations and attitudes from the corrected trajectory."""
    import jax

    from jaxphoto.georeferencing import Scanner
    from jaxphoto.lidar import HeightSettings
    from jaxphoto.procedures.lidar import simultaneous
    from jaxphoto.rotation import matrix_from_roll_pitch_yaw, roll_pitch_yaw_from_matrix, small_rotation
    from jaxphoto.unknowns import FIXED
    from tests.procedures.joint import photographs
    from tests.procedures.strips import NOISE_M, SETTINGS

    block, exposed = photographs(flight)
    spans = [(s.start, s.start + s.interval * (s.size - 3)) for s in lidar.errors.splines]
    off, turn = np.zeros((len(exposed), 3)), np.zeros((len(exposed), 3))
    for k, (start, end) in enumerate(spans):
        own = (exposed >= start) & (exposed <= end)
        off[own], turn[own] = lidar.errors.at(k, exposed[own])
    stations, attitudes = block.stations, block.attitudes
    value = np.asarray(stations.value) - off[stations.who, stations.axis]
    sigma = np.hypot(SETTINGS.sigma_position_m, np.asarray(stations.sigma))
    angles = jax.vmap(lambda a, t: roll_pitch_yaw_from_matrix(matrix_from_roll_pitch_yaw(a) @ small_rotation(t)))
    # About forward, right and down, in the order of roll, pitch, yaw.
    spread = np.hypot(SETTINGS.sigma_attitude[[1, 0, 2]], np.asarray(attitudes.sigma))
    posed = dataclasses.replace(
        block,
        stations=dataclasses.replace(stations, value=value, sigma=sigma),
        attitudes=dataclasses.replace(
            attitudes, roll_pitch_yaw=np.asarray(angles(attitudes.roll_pitch_yaw, turn)), sigma=spread
        ),
    )
    held = Scanner(FIXED, dict.fromkeys(lidar.cloud.strips, FIXED))
    settings = HeightSettings(sigma_z_m=NOISE_M, sigma_xy_m=NOISE_M)
    return simultaneous(posed, lidar.cloud, priors=held, settings=settings).adjusted


def estimates(adjusted) -> dict[str, tuple[float, float]]:
    """Value and standard deviation by label."""
    from jaxphoto.statistics import covariance

    structure = adjusted.structure
    value = np.asarray(adjusted.values.shared)[structure.free]
    sigma = np.asarray(covariance(adjusted).shared_sigma)
    return {label: (float(v), float(s)) for label, v, s in zip(structure.labels, value, sigma, strict=True)}


def compared(found: dict[str, tuple[float, float]], true: dict[str, float]) -> dict[str, list[float]]:
    """Error and standard deviation of each parameter."""
    return {label: [found[label][0] - t, found[label][1]] for label, t in true.items()}


def check_points(flight, together) -> float:
    """Root mean square height (m) of the tie points that no plane was found for over the true surface."""
    adjusted = together.adjusted
    rows = [of for of in adjusted.block.more if getattr(of, "group", "") == "strip_points"]
    seen = np.unique(np.concatenate([of.point for of in rows]))
    rest = np.setdiff1d(np.arange(len(adjusted.block.points)), seen)
    off = np.asarray(adjusted.unknowns.points)[rest] - np.asarray(flight.truth.points)[rest]
    return float(np.sqrt(np.mean(off[:, 2] ** 2)))


def correlations(together) -> dict[str, float]:
    """Of every parameter of the scanner with every one of the camera and its mount, by both labels."""
    from jaxphoto.statistics import correlation_matrix

    known, labels = together.covariance, together.adjusted.structure.labels
    rho = correlation_matrix(known)[-len(labels) :, -len(labels) :]
    return {f"{labels[a]} x {labels[b]}": float(rho[a, b]) for a, b in _pairs(labels)}


def drawn(together, draws: int) -> dict[str, float]:
    """The same of re-adjustments with drawn noise."""
    from jaxphoto import monte_carlo
    from jaxphoto.sensitivity import noise

    adjusted = together.adjusted
    found = monte_carlo(adjusted, noise(adjusted.block), draws, seed=1)
    labels = adjusted.structure.labels
    at = [found.labels.index(label) for label in labels]
    rho = np.corrcoef(np.asarray(found.shared)[:, at].T)
    return {f"{labels[a]} x {labels[b]}": float(rho[a, b]) for a, b in _pairs(labels)}


def _pairs(labels) -> list[tuple[int, int]]:
    scanner = [k for k, label in enumerate(labels) if label.startswith("scanner")]
    camera = [k for k, label in enumerate(labels) if label.startswith(("interior", "mounts"))]
    return [(a, b) for a in scanner for b in camera]


def _rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def table(records: list[dict]) -> str:
    """Three tables: all flights together, each parameter both ways, correlations."""
    good = [r for r in records if "failed" not in r]
    joint, apart = (np.array([list(r[way].values()) for r in good]) for way in ("joint", "two_steps"))
    w = [np.abs(of[..., 0] / of[..., 1]) for of in (joint, apart)]
    knots = np.abs(np.concatenate([r["trajectory"] for r in good]))
    restless = sum(not r["converged"] for r in good)
    inside = 100 * np.mean(np.concatenate([w[0].ravel(), knots]) < _WITHIN)
    rows = [
        ["flights, failed, not still", f"{len(records)}, {len(records) - len(good)}, {restless}"],
        ["sigma naught, mean", f"{np.mean([r['sigma0'] for r in good]):.3f}"],
        [
            "inside 95 %, parameters at once; in two steps",
            "; ".join(f"{100 * np.mean(of < _WITHIN):.1f} %" for of in w),
        ],
        ["inside 95 %, all unknowns at once", f"{inside:.2f} %"],
        ["tie points over planes (mm)", f"{1000 * _rms([r['on_planes_m'] for r in good]):.1f}"],
        ["heights of the others (mm)", f"{1000 * _rms([r['check_points'] for r in good]):.1f}"],
        ["seconds a flight, median", f"{np.median([r['seconds'] for r in good]):.1f}"],
    ]
    each = []
    for k, name in enumerate(good[0]["joint"]):
        sigma = [np.median(of[:, k, 1]) for of in (joint, apart)]
        error = [_rms(of[:, k, 0]) for of in (joint, apart)]
        part = [f"{100 * np.mean(of[:, k] < _WITHIN):.0f}, {100 * np.mean(of[:, k] < 3):.0f} %" for of in w]
        each.append(
            [name, *(f"{v:.3g}" for v in (*sigma, *error)), f"{sigma[1] / sigma[0]:.2f}", f"{error[1] / error[0]:.2f}",
             *part]
        )  # fmt: skip
    heads = [
        ["", "figure"],
        ["parameter", "sigma at once", "in two steps", "error at once", "in two steps", "gain in sigma", "in error",
         "inside 95 %, 3 sigma at once", "in two steps"],
        ["correlation", "first flight", "its draws", "mean of flights", "scatter of their errors"],
    ]  # fmt: skip
    parts = zip(heads, (rows, each, correlation_rows(good)), strict=True)
    return "\n\n".join("\n".join(markdown(head, body)) for head, body in parts)


def correlation_rows(good: list[dict]) -> list[list[str]]:
    """The largest ones."""
    first = good[0]
    largest = sorted(first["rho"], key=lambda pair: -abs(first["rho"][pair]))[:_PAIRS]
    rows = []
    for pair in largest:
        a, b = pair.split(" x ")
        scatter = np.corrcoef(*[[r["joint"][name][0] for r in good] for name in (a, b)])[0, 1]
        mean = np.mean([r["rho"][pair] for r in good])
        own = f"{first['drawn'][pair]:+.2f}" if "drawn" in first else ""
        rows.append([pair, f"{first['rho'][pair]:+.2f}", own, f"{mean:+.2f}", f"{scatter:+.2f}"])
    return rows


if __name__ == "__main__":
    sys.exit(main())
