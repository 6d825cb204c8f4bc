"""Every benchmark, one after the other: the one command that repeats all of results.md. See README.md.

python benchmarks/everything.py --out DIR [--data DIR --ceres BIN] [--bal FILE --ceres-bal BIN] [--quick]
"""

import argparse
import subprocess
import sys
from pathlib import Path

from machine import HERE


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for results.jsonl and results.md")
    parser.add_argument("--data", type=Path, help="folder of P31.npz, B200.npz, B1000.npz; else blocks of our own")
    parser.add_argument("--ceres", type=Path, help="the C++ peers' binary")
    parser.add_argument("--bal", type=Path, help='a problem file of "Bundle Adjustment in the Large"')
    parser.add_argument("--ceres-bal", type=Path, help="the C++ peer's binary for it")
    parser.add_argument("--field", type=Path, help="folder that holds mrcal_board; mrcal is the system's")
    parser.add_argument("--quick", action="store_true", help="a few minutes: small blocks, few rounds")
    arguments = parser.parse_args()
    for command in commands(arguments):
        print("#", *command, file=sys.stderr)
        subprocess.run([sys.executable, str(HERE / command[0]), *command[1:], "--out", str(arguments.out)], check=True)


def commands(arguments) -> list[list[str]]:
    """What is run, in order."""
    peer = ["--ceres", str(arguments.ceres)] if arguments.ceres else []
    problems = {"P31": ["--rounds", "9", "--start"], "B200": ["--rounds", "5"], "B1000": ["--rounds", "3"]}
    if arguments.quick:
        problems = {"P31": ["--rounds", "3"]}
    runs = []
    for name, options in problems.items():
        source = ["--npz", str(arguments.data / f"{name}.npz")] if arguments.data else ["--problem", name]
        runs.append(["run.py", *source, *options, *peer])
    draws = ["--npz", str(arguments.data / "P31.npz")] if arguments.data else []
    draws += [*peer, "--growth", "1000" if arguments.quick else "100000"]
    if arguments.bal:
        peer = ["--ceres-bal", str(arguments.ceres_bal)] if arguments.ceres_bal else []
        runs.append(["run.py", "--bal", str(arguments.bal), "--rounds", "2" if arguments.quick else "3", *peer])
    if arguments.quick:
        growth, blocks = ["--most", "10000", "--images", "31", "--widest", "200"], "4"
        device = ["--problems", "P31", "--draws", "16"]
    else:
        growth, blocks, device = ["--most", "1000000"], "20", []
    data = ["--npz", str(arguments.data)] if arguments.data else []
    fields = [["test_field.py", "--data", str(arguments.field)]] if arguments.field else []
    return [
        *runs,
        ["growth.py", *growth],
        ["compilations.py", "--blocks", blocks],
        ["monte_carlo.py", *draws],
        ["twins.py", "--twins", *(["target"] if arguments.quick else ["target", "indoor", "uav"])],
        *fields,
        ["lidar.py", *(["--points", "1000000"] if arguments.quick else [])],
        ["accelerator.py", *device, *data],
    ]


if __name__ == "__main__":
    main()
