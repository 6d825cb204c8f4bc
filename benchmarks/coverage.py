"""Are intervals, sigma naught, correlations and detectable errors true? Thousands of simulated small blocks answer.

python benchmarks/coverage.py --draws 10000

Ten geometries (two crossing strips over relief, stations, a few control points), each measured anew again and again; in
every adjusted block the 95 % intervals of all unknowns are held against the truth. In each, one observation is then off
by its detectable error, and the test of its normalised residual is tried.
"""

import argparse
import time
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from scipy import stats

from jaxphoto import Adjustment, Block, Unknowns, adjust, covariance
from jaxphoto.camera import get_parameter
from jaxphoto.io.recipe import recipe_from
from jaxphoto.simulation import remeasure, simulate
from jaxphoto.statistics import minimal_detectable_biases, normalised_residuals, observation_groups, redundancy_numbers

RECIPE = {
    "title": "small",
    "cameras": {
        "a": {
            "width_px": 4500, "height_px": 3000, "pixel_mm": 0.008, "distortion": "brown",
            "interior": {"c_mm": 35.0, "xp_mm": 0.05, "yp_mm": -0.08, "k1": -9e-5, "k2": 1e-7},
            "unknowns": dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1", "k2"), "free"),
        }
    },
    "flight": {
        "height_m": 1000.0, "forward_overlap_percent": 60.0, "side_overlap_percent": 40.0,
        "strips": [
            {"name": "E", "heading_deg": 90.0, "images": 5},
            {"name": "N", "heading_deg": 0.0, "images": 5},
        ],
    },
    "jitter": {"position_m": 15.0, "angle_deg": 2.0, "crab_deg": 3.0},
    "terrain": {"kind": "random", "count": 12, "rms_m": 40.0, "length_m": 700.0},
    "points": {"ties": 60},
    "targets": [{"count": 5, "role": "control"}],
    "sigmas": {"image_mm": 0.004, "control_m": 0.05, "station_m": 0.15},
}  # fmt: skip
GEOMETRIES = 10
LEVEL = 0.95
# Of all intervals one by one, and of each of the other tests.
_FAMILY = 0.01
_TEST = 1e-3


class Draw(NamedTuple):
    """One adjusted block: errors over standard deviations by kind, sigma naught, and whether an error was found."""

    ratios: dict[str, np.ndarray]
    sigma0: float
    interior: np.ndarray
    found: bool


def observed(block: Block):
    """The numbers that noise is added to."""
    return block.image_points.xy, block.stations.value, block.control.value


def drawn(block: Block, truth: Unknowns, draw, seed: int) -> Draw:
    """The block measured anew, adjusted; and once more with an error that should be found in 80 of 100."""
    new = eqx.tree_at(observed, block, jax.tree.map(np.asarray, draw(jax.random.key(seed))))
    found = adjust(new, truth)
    q = covariance(found, "camera")
    u = found.unknowns
    camera = next(iter(truth.interior))
    names = [label.rsplit(".", 1)[1] for label in found.structure.labels]
    interior = np.array([float(get_parameter(u.interior[camera], n)) for n in names])
    true = np.array([float(get_parameter(truth.interior[camera], n)) for n in names])
    turn = np.asarray(u.exterior.camera_from_object) @ np.swapaxes(truth.exterior.camera_from_object, 1, 2)
    # A small rotation takes V to V - theta x V.
    angles = np.stack([turn[:, 1, 2], turn[:, 2, 0], turn[:, 0, 1]], axis=1)
    eop = np.hstack([np.asarray(u.exterior.position) - np.asarray(truth.exterior.position), angles])
    ratios = {
        "IOP": (interior - true) / np.asarray(q.shared_sigma),
        "EOP": (eop / np.asarray(q.exterior_sigma)).ravel(),
        "points": ((np.asarray(u.points) - np.asarray(truth.points)) / np.asarray(q.point_sigma)).ravel(),
    }
    return Draw(ratios, float(found.sigma0), interior, _is_found(new, found, q, truth, seed))


def _is_found(block: Block, sound: Adjustment, q, truth: Unknowns, seed: int) -> bool:
    """Whether one observation, off by its detectable error, is beyond the limit of the test of it alone."""
    rng = np.random.default_rng(seed)
    numbers = redundancy_numbers(sound, q)
    detectable = minimal_detectable_biases(sound, numbers)
    groups = {name: rows for name, rows in observation_groups(sound).items() if rows.unit}
    name = list(groups)[rng.integers(len(groups))]
    size = np.atleast_2d(detectable[name])
    axis, row = np.argwhere(np.isfinite(size))[rng.integers(np.isfinite(size).sum())]
    value = np.array(block.named_observations[name].observation, float)
    at = (row, axis) if value.ndim > 1 else (row,)
    value[at] += rng.choice([-1, 1]) * size[axis, row]
    rows = block.named_observations[name].with_observation(value)
    spoilt = adjust(block.with_observations({name: rows}), truth)
    w = np.atleast_2d(normalised_residuals(spoilt, redundancy_numbers(spoilt, covariance(spoilt, "camera")))[name])
    # delta0 is that of the test with the true sigma naught, which is 1.
    return bool(abs(w[axis, row]) * float(spoilt.sigma0) > stats.norm.isf(_TEST / 2))


def main() -> None:
    """Print coverage by kind and of each unknown, the law of sigma naught, correlations, and the power."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first block")
    arguments = parser.parse_args()
    inside: dict[str, list[np.ndarray]] = {"IOP": [], "EOP": [], "points": []}
    each, p_of_s, found, rho = [], [], [], []
    began, many = time.perf_counter(), arguments.draws // GEOMETRIES
    for g in range(GEOMETRIES):
        simulation = simulate(recipe_from(RECIPE), g)
        block, truth = simulation.block, simulation.truth
        draw = jax.jit(lambda key, block=block, truth=truth: observed(remeasure(block, truth, key)))
        draws = [drawn(block, truth, draw, arguments.first + g * many + k) for k in range(many)]
        freedom = adjust(block, truth).redundancy
        limit = stats.t.isf((1 - LEVEL) / 2, freedom)
        for kind, list_of in inside.items():
            hits = np.array([np.abs(d.ratios[kind]) < limit for d in draws])
            list_of.append(hits)
            each += hits.sum(axis=0).tolist()
        p_of_s += stats.chi2.sf([d.sigma0**2 * freedom for d in draws], freedom).tolist()
        found += [d.found for d in draws]
        said = covariance(adjust(block, truth)).matrix[-len(draws[0].interior) :, -len(draws[0].interior) :]
        said = np.asarray(said) / np.sqrt(np.outer(np.diagonal(said), np.diagonal(said)))
        empirical = np.corrcoef(np.array([d.interior for d in draws]).T)
        upper = np.triu_indices(len(said), 1)
        rho += ((np.arctanh(empirical) - np.arctanh(said))[upper] * np.sqrt(many - 3)).tolist()
        print(f"{(g + 1) * many} blocks, {time.perf_counter() - began:.0f} s", flush=True)
    for kind, list_of in inside.items():
        hits = np.concatenate([h.mean(axis=1) for h in list_of])
        print(f"{kind}: {100 * hits.mean():.2f} +- {100 * hits.std() / len(hits) ** 0.5:.2f} %")
    pooled = np.concatenate([np.hstack([inside[k][g] for k in inside]).mean(axis=1) for g in range(GEOMETRIES)])
    print(
        f"pooled: {100 * pooled.mean():.2f} +- {100 * pooled.std() / len(pooled) ** 0.5:.2f} % (asked: {100 * LEVEL:g})"
    )
    p = np.array([stats.binomtest(k, many, LEVEL).pvalue for k in each])
    print(
        f"of {len(p)} unknowns one by one: least p {p.min():.1g}, {(p < _FAMILY / len(p)).sum()} beyond {_FAMILY:.0%}"
    )
    print(f"sigma naught squared: KS against its chi-square p = {stats.kstest(p_of_s, 'uniform').pvalue:.2g}")
    print(f"correlations of the IOP ({len(rho)}): RMS of (Monte Carlo - said) over its error {np.std(rho):.2f}")
    power = np.mean(found)
    error = (power * (1 - power) / len(found)) ** 0.5
    print(f"power at the detectable error: {100 * power:.1f} +- {100 * error:.1f} %")


if __name__ == "__main__":
    main()
