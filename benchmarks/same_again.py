"""One block adjusted again: on one device and on two, with one thread of BLAS and with two, and twice alike.

python benchmarks/same_again.py [--problem B200] [--block FOLDER]

Prints by how much the numbers of each table differ, how many tokens of the screen and of the report's text do, and
whether two runs alike have the same bits in every file but for times and dates.
"""

import argparse
import html
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from blocks import SIZES, generate
from machine import HERE, machine, sentence
from ours import block_of

sys.path.insert(0, str(HERE.parent))

# By name: devices of JAX, threads of the linear algebra that numpy calls.
_RUNS = {"one of each": (1, 1), "the same again": (1, 1), "two devices": (2, 1), "two threads": (1, 2)}
# Files that are named.
_NAMED = 4
# What says when and how long.
_TIMES = ("summary.json", "report.html", ".jaxphoto.json")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", choices=list(SIZES), default="B200")
    parser.add_argument("--block", type=Path, help="a block folder instead")
    arguments = parser.parse_args()
    print(sentence(machine()))
    with tempfile.TemporaryDirectory() as work:
        block = (arguments.block or _written(arguments.problem, Path(work) / "block")).resolve()
        screens = {name: _adjusted(block, Path(work) / name, *run) for name, run in _RUNS.items()}
        first, *others = (Path(work) / name for name in _RUNS)
        same = True
        for other in others:
            screen = screens[first.name].split() != screens[other.name].split()
            words = _differing(first / "report.html", other / "report.html")
            worst, where = _numbers(first, other)
            unlike = [f.name for f in _files(first) if f.name not in _TIMES and not _alike(f, first, other)]
            print(
                f"{other.name}: screen {'differs' if screen else 'the same'}, {words} tokens of the report differ, "
                f"numbers of tables by {worst:.1e} at most ({where}), {len(unlike)} files of other bits"
                + (f": {', '.join(unlike)}" if len(unlike) < _NAMED else "")
            )
            same &= not screen and not words
        return 0 if same else 1


def _written(problem: str, folder: Path) -> Path:
    from jaxphoto.io import write_block

    write_block(block_of(generate(SIZES[problem]), problem), folder)
    return folder


def _adjusted(block: Path, out: Path, devices: int, threads: int) -> str:
    """What the command prints, without where it wrote."""
    number = {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads, "JAX_NUM_CPU_DEVICES": devices}
    command = [
        sys.executable,
        "-c",
        "from jaxphoto_command import main; main()",
        "adjust",
        str(block),
        "--out",
        str(out),
    ]
    done = subprocess.run(
        command,
        cwd=HERE.parent,
        env=os.environ | {name: str(value) for name, value in number.items()},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if not (out / "summary.json").exists():
        raise SystemExit(f"the adjustment wrote nothing: {done.stdout}")
    return re.sub(r"results in .*", "", done.stdout, flags=re.DOTALL)


def _files(folder: Path) -> list[Path]:
    return sorted(f for f in folder.rglob("*") if f.is_file())


def _alike(file: Path, first: Path, other: Path) -> bool:
    return file.read_bytes() == (other / file.relative_to(first)).read_bytes()


def _differing(one: Path, other: Path) -> int:
    """Tokens of two pages' texts, without pictures and numbers for these, dates and seconds."""
    shown = []
    for page in (one, other):
        text = re.sub(r"<(script|style|svg).*?</\1>", " ", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        text = html.unescape(re.sub(r"<[^>]+>", " ", text))
        shown.append(re.sub(r"\d{4}-\d\d-\d\d( \d\d:\d\d)?|[\d.]+ s\b|/\S+", "", text).split())
    return sum(a != b for a, b in zip(*shown, strict=False)) + abs(len(shown[0]) - len(shown[1]))


def _numbers(first: Path, other: Path) -> tuple[float, str]:
    """The largest difference of two numbers of a column beside its largest, and the file and column."""
    worst = (0.0, "none")
    for file in first.glob("*.csv"):
        tables = [pd.read_csv(folder / file.name).select_dtypes("number") for folder in (first, other)]
        for column in tables[0].columns:
            one, two = (table[column].to_numpy(float) for table in tables)
            if len(one) != len(two) or not np.array_equal(np.isfinite(one), np.isfinite(two)):
                return np.inf, f"{file.name} {column}"
            one, two = one[np.isfinite(one)], two[np.isfinite(two)]
            size, off = (float(np.abs(v).max(initial=0.0)) for v in (one, one - two))
            worst = max(worst, (off / size if size else off, f"{file.name} {column}"))
    return worst


if __name__ == "__main__":
    sys.exit(main())
