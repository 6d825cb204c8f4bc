"""`jaxphoto strips` on a simulated flight of ten strips and many returns: time, memory, and whether the truth is found.

python benchmarks/large_strips.py FOLDER [--density 4] [--planes 4000] [--photographs 1000] [--ties 10000] [--seed 5]

The flight is that of the tests with eight parallel and two crossing strips of 2 to 3 km; 4 returns a square metre are
50 million. With photographs these are adjusted together with the strips, which are so long that there are as many, with
80 % of overlap: 1,000 photographs and one return a square metre are 50 million, too. The flight is kept in FOLDER and
taken from there if it is there already.
"""

import argparse
import copy
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

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
    parser.add_argument("--photographs", type=int, default=0, help="about so many, taken with the strips")
    parser.add_argument("--ties", type=int, default=10_000, help="tie points of the photographs")
    parser.add_argument("--seed", type=int, default=5)
    arguments = parser.parse_args()
    import laspy

    from jaxphoto.io import read_truth
    from jaxphoto.report import recovery_table

    print(sentence(machine()))
    folder = arguments.folder.resolve()
    flight, results = folder / "flight", folder / "results"
    if not (flight / "cloud.laz").exists():
        fly(flight, arguments)
    # So that those of an earlier run are not taken for what this one found.
    shutil.rmtree(results, ignore_errors=True)
    command = [sys.executable, "-c", "from jaxphoto_command import main; main()", "strips", flight / "cloud.laz"]
    command += ["--trajectory", flight / "trajectory.csv", "--out", results, *_OPTIONS.split()]
    if arguments.photographs:
        command += ["--block", flight]
    began = time.perf_counter()
    child = subprocess.Popen([*command, "--most-planes", str(arguments.planes)], cwd=HERE.parent)
    # As `wait`, and what it used.
    _, status, used = os.wait4(child.pid, 0)
    took = time.perf_counter() - began
    print(
        f"{laspy.open(flight / 'cloud.laz').header.point_count / 1e6:.1f} million returns, {took:.0f} s, "
        f"{used.ru_utime + used.ru_stime:.0f} s of processor, {used.ru_maxrss / 1e6:.2f} GB, exit code "
        f"{os.waitstatus_to_exitcode(status)}"
    )
    if not results.exists():
        return 1
    truth = read_truth(flight)
    camera = truth["interior"]
    camera = camera.assign(parameter="interior[" + camera["camera"] + "]." + camera["parameter"])
    told = pd.concat([truth["scanner"], truth["georeferencing"], camera[["parameter", "value"]]])
    # scanner.csv has mounts and cameras, too.
    found: Any = SimpleNamespace(interior=None, georeferencing=pd.read_csv(results / "scanner.csv"))
    for row in recovery_table(found, {"georeferencing": told}).to_dict("records"):
        value = f"{row['estimate']:.5g}, sigma {row['sigma']:.2g}, off by {row['ratio']:+.2f} sigma"
        print(f"  {row['parameter']}: {value}")
    print((results / "rounds.csv").read_text(encoding="utf-8"))
    return 0


def fly(folder: Path, arguments: argparse.Namespace) -> None:
    """Simulate, and write block, cloud, trajectory and the truth."""
    from jaxphoto.io import write_simulation
    from tests.procedures.joint import JOINT
    from tests.procedures.strips import STRIPS
    from tests.simulation.small import made

    recipe = copy.deepcopy(JOINT if arguments.photographs else STRIPS)
    along, across = 12, 8
    if arguments.photographs:
        along, across = round(0.108 * arguments.photographs), round(0.068 * arguments.photographs)
        recipe["flight.forward_overlap_percent"] = 80
    recipe["flight.strips"] = [
        {"name": f"S{k}", "heading_deg": 90.0 + 180.0 * (k % 2), "images": along, "across_spacings": 0.4 * (k - 4)}
        for k in range(8)
    ]
    recipe["flight.strips"] += [
        {"name": f"X{k}", "heading_deg": 180.0 * k, "images": across, "across_spacings": 0.6 * k} for k in range(2)
    ]
    recipe["points"] = {"ties": arguments.ties if arguments.photographs else 600}
    recipe["lidar"]["density_per_m2"] = arguments.density
    write_simulation(made(recipe, arguments.seed), folder)


if __name__ == "__main__":
    sys.exit(main())
