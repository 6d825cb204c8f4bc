"""Ten million laser points indexed, and heights at 100,000 places, beside SciPy's tree. See README.md.

python benchmarks/lidar.py [--points 10000000] [--places 100000]
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from machine import forget_peak, machine, markdown, memory, run_here, sentence, write_results

_DENSITY = 2.0  # points per square metre
_METHODS = ("plane", "local")
_NEIGHBOURS = 8
_FEATURES = 10_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--places", type=int, default=100_000)
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    parser.add_argument("--worker", choices=list(_WORK), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        print(json.dumps(_WORK[arguments.worker](arguments.worker, arguments.points, arguments.places)), flush=True)
        return
    head = machine()
    records: list[dict] = [{"kind": "head", **head}]
    rows = []
    given = ["--points", arguments.points, "--places", arguments.places]
    for name in _WORK:
        print(name, file=sys.stderr)
        (own,) = run_here("lidar.py", "--worker", name, *given)
        records.append({"kind": "work", "work": name, **own})
        rows.append([name, *(f"{own[key]:.2f}" if key in own else "-" for key in _TIMES), f"{own['peak_mb']:.0f}"])
    names = ["what", "index s", "first call s", "again s", "memory added at the peak MB"]
    text = [f"### {arguments.points:,} laser points, heights at {arguments.places:,} places", "", sentence(head), ""]
    text += [f"`python benchmarks/lidar.py {' '.join(map(str, given))}`; first calls compile or load, one run", ""]
    write_results(arguments.out, "lidar", records, "\n".join([*text, *markdown(names, rows)]))


_TIMES = ("index", "first", "again")


def cloud_and_places(n_points: int, n_places: int) -> tuple[np.ndarray, np.ndarray]:
    """Rolling ground, and places in it."""
    rng = np.random.default_rng(10)
    side = np.sqrt(n_points / _DENSITY)
    xyz = rng.uniform(0, side, (n_points, 3))
    xyz[:, 2] = 10 * np.sin(xyz[:, 0] / 40) * np.cos(xyz[:, 1] / 50) + rng.normal(0, 0.15, n_points)
    return xyz, rng.uniform(5, side - 5, (n_places, 2))


def _heights(method: str, n_points: int, n_places: int) -> dict:
    from jaxphoto.lidar import heights_at, index_cloud

    xyz, places = cloud_and_places(n_points, n_places)
    return _measured(lambda: index_cloud(xyz), lambda grid: heights_at(grid, places, method))  # type: ignore[arg-type]


def _pseudo_control(name: str, n_points: int, n_places: int) -> dict:
    from jaxphoto import Brown, ExteriorOrientation, InteriorOrientation
    from jaxphoto.lidar import index_cloud, pseudo_control_points

    xyz, _ = cloud_and_places(n_points, 1)
    camera, middle = InteriorOrientation(34.0, 0.06, 0.27, Brown(k1=-9e-5, k2=1e-7)), np.sqrt(n_points / _DENSITY) / 2
    image = ExteriorOrientation.from_angles(np.array([middle, middle, 1000.0]), np.array([0.01, -0.02, 0.3]))
    xy = np.random.default_rng(11).uniform(-11, 11, (_FEATURES, 2))
    return _measured(
        lambda: index_cloud(xyz), lambda grid: np.asarray(pseudo_control_points(camera, image, xy, grid).xyz)
    )


def _tree(name: str, n_points: int, n_places: int) -> dict:
    from scipy.spatial import cKDTree

    xyz, places = cloud_and_places(n_points, n_places)

    def idw(tree: cKDTree) -> np.ndarray:
        distance, index = tree.query(places, k=_NEIGHBOURS)
        weight = distance**-2.0
        return np.sum(weight * xyz[index, 2], axis=1) / np.sum(weight, axis=1)

    return _measured(lambda: cKDTree(xyz[:, :2]), idw)


def _measured(index: Callable, heights: Callable) -> dict:
    """Seconds of the index, of the first heights and of the same again, and what memory they took beyond the cloud."""
    forget_peak()
    before = memory("VmRSS")
    began = time.perf_counter()
    indexed = index()
    ready = time.perf_counter()
    heights(indexed)
    first = time.perf_counter()
    heights(indexed)
    again = time.perf_counter()
    peak = memory("VmHWM") - before
    return {"index": ready - began, "first": first - ready, "again": again - first, "peak_mb": peak}


# What is measured, each in a process of its own.
_WORK: dict[str, Callable[[str, int, int], dict]] = {
    **dict.fromkeys(_METHODS, _heights),
    "pseudo control of 10,000 features": _pseudo_control,
    "SciPy's cKDTree, idw without sigma": _tree,
}


if __name__ == "__main__":
    main()
