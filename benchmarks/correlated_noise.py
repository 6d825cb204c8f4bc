"""Do the camera's standard deviations hold if errors of neighbouring image points are correlated? Flights answer.

python benchmarks/correlated_noise.py --flights 500 image

Each flight is flat and has 18 photographs, positions of 0.5 m (1 m in height) and no control. Independent errors are
joined by random fields with the covariance exp(-d^2 / 2 L^2) over the format: new for each image (blur, refraction),
common to all images (distortion), or both, with other lengths L than those of `correlated_noise`. The table gives, for
independent and for correlated errors, the fraction of intervals of 95 % that cover the true value.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import stats

from jaxphoto import Block, adjust, covariance
from jaxphoto.camera import get_parameter
from jaxphoto.io.recipe import recipe_from
from jaxphoto.simulation import simulate
from jaxphoto.statistics import correlated_noise

NAMES = ("c_mm", "xp_mm", "yp_mm", "k1", "k2", "p1", "p2")
RECIPE: dict[str, Any] = {
    "title": "flat flight of 18 photographs",
    "cameras": {
        "camera": {
            "width_px": 4000, "height_px": 2250, "pixel_mm": 0.0017, "distortion": "brown",
            "interior": {"c_mm": 5.0}, "truth": {"c_mm": 5.05, "xp_mm": 0.03, "yp_mm": -0.03, "k1": 8e-4, "p1": -1e-4},
            "unknowns": dict.fromkeys(NAMES, "free"),
        }
    },
    "flight": {
        "height_m": 60.0, "forward_overlap_percent": 65.0, "side_overlap_percent": 40.0, "speed_m_per_s": 5.0,
        "strips": [{"name": "S", "heading_deg": 20.0, "images": 9, "count": 2}],
    },
    "jitter": {"position_m": 1.0, "angle_deg": 4.0, "crab_deg": 5.0},
    "terrain": {"kind": "random", "count": 12, "rms_m": 0.7, "length_m": 30.0},
    "points": {"ties": 3000, "min_images": 2, "mean_rays": 3.0},
    "sigmas": {"image_mm": 0.001, "station_m": [0.5, 0.5, 1.0]},
    "noise": {"image_mm": 0.00085, "station_m": [0.5, 0.5, 1.0]},
    "start": {"position_m": 2.0, "angle_deg": 1.0},
}  # fmt: skip
Field = tuple[float, float, bool]
"""Standard deviation in stated ones, length L as a fraction of the longer side, True if common to all images."""
NOISES: dict[str, Sequence[Field]] = {
    "independent": [],
    "image": [(0.6, 1 / 12, False)],
    "image_smooth": [(0.5, 1 / 5, False)],
    "camera": [(0.2, 1 / 10, True)],
    "both": [(0.3, 1 / 30, False), (0.3, 1 / 10, False), (0.15, 1 / 12, True)],
}
# Number of cosines of a field.
_COSINES = 300


def with_fields(block: Block, fields: Sequence[Field], rng: np.random.Generator) -> Block:
    """Add random fields to the image points of a block of one camera."""
    rows, (sensor,) = block.image_points, block.sensors.values()
    image, xy = np.asarray(rows.image), np.asarray(rows.xy).copy()
    at = np.asarray(rows.xy) / max(sensor.width_mm, sensor.height_mm)
    for size, length, common in fields:
        for group in [np.arange(len(image))] if common else [np.flatnonzero(image == i) for i in np.unique(image)]:
            xy[group] += size * np.asarray(rows.sigma)[group] * _field(at[group] / length, rng)
    return eqx.tree_at(lambda b: b.image_points.xy, block, xy)


def _field(at: Float[np.ndarray, "n 2"], rng: np.random.Generator) -> Float[np.ndarray, "n 2"]:
    phase = at @ rng.normal(size=(2, _COSINES)) + rng.uniform(0, 2 * np.pi, _COSINES)
    return np.sqrt(2 / _COSINES) * np.cos(phase) @ rng.normal(size=(_COSINES, 2))


def flights(noise: str, seeds: range) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield errors of the camera over standard deviations of independent and of correlated errors, by flight."""
    recipe = recipe_from(RECIPE, "flat flight")
    for seed in seeds:
        simulated = simulate(recipe, seed)
        adjusted = adjust(with_fields(simulated.block, NOISES[noise], np.random.default_rng((seed, 1))))
        if not bool(adjusted.converged):
            continue
        pair = adjusted.unknowns.interior["camera"], simulated.truth.interior["camera"]
        estimate, truth = (np.array([float(get_parameter(one, name)) for name in NAMES]) for one in pair)
        found, names = correlated_noise(adjusted), list(NAMES)
        correlated = np.sqrt(np.diagonal(found.widened(covariance(adjusted)).of_interior("camera", names)))
        independent = np.sqrt(np.diagonal(covariance(adjusted).of_interior("camera", names)))
        yield (estimate - truth) / independent, (estimate - truth) / correlated


def main() -> None:
    """Print the coverage of each parameter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("noises", nargs="*", default=list(NOISES))
    parser.add_argument("--flights", type=int, default=500)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    arguments = parser.parse_args()
    limit = stats.norm.isf(0.025)
    for name in arguments.noises:
        began = time.perf_counter()
        errors = np.array(list(flights(name, range(arguments.first, arguments.first + arguments.flights))))
        print(f"{name}: {len(errors)} of {arguments.flights} converged, {time.perf_counter() - began:.0f} s")
        for k, kind in enumerate(("independent", "correlated")):
            inside = np.mean(np.abs(errors[:, k]) < limit, axis=0)
            print(f"  {kind:12s}" + "  ".join(f"{p} {100 * v:.0f} %" for p, v in zip(NAMES, inside, strict=True)))


if __name__ == "__main__":
    main()
