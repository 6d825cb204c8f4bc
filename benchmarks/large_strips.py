"""`jaxphoto strips` on a simulated flight of ten strips and many returns: time, memory, and whether the truth is found.

python benchmarks/large_strips.py FOLDER [--density 4] [--planes 4000] [--seed 5]

The flight is that of the tests with eight parallel and two crossing strips of 2 to 3 km; 4 returns a square metre are
50 million. Cloud and trajectory are kept in FOLDER and taken from there if they are there already.
"""

import argparse
import copy
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
from machine import HERE, machine, sentence

sys.path.insert(0, str(HERE.parent))

# What the cells, knots and errors of that flight are, as options.
_OPTIONS = (
    "--adjust boresight,angle-scale,range-offset --cell-m 5 --knots-s 5 --correlation-s 60 --sigma-position-m 0.05 "
    "--sigma-attitude-deg 0.003 --sigma-heading-deg 0.006"
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--density", type=float, default=4.0, help="returns a square metre of each strip")
    parser.add_argument("--planes", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=5)
    arguments = parser.parse_args()
    print(sentence(machine()))
    folder = arguments.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "flight.json").exists():
        fly(folder, arguments.density, arguments.seed)
    flight = json.loads((folder / "flight.json").read_text(encoding="utf-8"))
    command = [sys.executable, "-c", "from jaxphoto_command import main; main()", "strips", folder / "cloud.laz"]
    command += ["--trajectory", folder / "trajectory.csv", "--out", folder / "results", *_OPTIONS.split()]
    began = time.perf_counter()
    child = subprocess.Popen([*command, "--most-planes", str(arguments.planes)], cwd=HERE.parent)
    # As `wait`, and what it used.
    _, status, used = os.wait4(child.pid, 0)
    took = time.perf_counter() - began
    print(
        f"{flight['returns'] / 1e6:.1f} million returns, {took:.0f} s, {used.ru_utime + used.ru_stime:.0f} s of "
        f"processor, {used.ru_maxrss / 1e6:.2f} GB, exit code {os.waitstatus_to_exitcode(status)}"
    )
    found = pd.read_csv(folder / "results" / "scanner.csv").set_index("parameter")
    for name, true in flight["truth"].items():
        value, sigma = found.loc[name, ["value", "sigma"]]
        print(f"  {name}: {value:.5g}, sigma {sigma:.2g}, off by {(value - true) / sigma:+.2f} sigma")
    print((folder / "results" / "rounds.csv").read_text(encoding="utf-8"))
    return 0


def fly(folder: Path, density: float, seed: int) -> None:
    """Simulate, and write the cloud, its trajectory and the truth."""
    from jaxphoto.io.recipe.scan_files import write_scan
    from tests.procedures.strips import STRIPS, TRUTH
    from tests.simulation.small import made

    recipe = copy.deepcopy(STRIPS)
    along = [
        {"name": f"S{k}", "heading_deg": 90.0 + 180.0 * (k % 2), "images": 12, "across_spacings": 0.4 * (k - 4)}
        for k in range(8)
    ]
    across = [{"name": f"X{k}", "heading_deg": 180.0 * k, "images": 8, "across_spacings": 0.6 * k} for k in range(2)]
    recipe["flight.strips"], recipe["points"] = along + across, {"ties": 600}
    recipe["lidar"]["density_per_m2"] = density
    flight = made(recipe, seed)
    assert flight.cloud is not None and flight.trajectory is not None
    write_scan(flight.cloud, flight.trajectory, folder)
    axes = zip(("right", "forward", "up"), TRUTH["boresight_deg"], strict=True)
    truth = {f"scanner.boresight_{axis}_deg": value for axis, value in axes}
    truth |= {f"scanner_calibration.{name}": TRUTH[name] for name in ("range_offset_m", "angle_scale_ppm")}
    (folder / "flight.json").write_text(json.dumps({"returns": len(flight.cloud), "truth": truth}), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
