"""What an installation takes: megabytes by package, and seconds of the processor until it is imported.

python benchmarks/install.py [--lean] [--out DIR]

Builds the wheel, installs it into a fresh environment (with --lean without extras) and
starts it some times, away from the checkout. The first import writes bytecode and does not count.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_STARTS = {
    "import jax": ["python", "-c", "import jax"],
    "import jaxphoto": ["python", "-c", "import jaxphoto"],
    "jaxphoto --version": ["jaxphoto", "--version"],
    "jaxphoto adjust --help": ["jaxphoto", "adjust", "--help"],
}
_ROUNDS = 5


def main() -> None:
    """Print both tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lean", action="store_true", help="without extras")
    parser.add_argument("--out", type=Path, help="folder whose results.md they are appended to")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        said = measured(Path(folder), given.lean)
    print(said)
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
        with (given.out / "results.md").open("a", encoding="utf-8") as file:
            file.write(said + "\n")


def measured(work: Path, lean: bool) -> str:
    """The tables of an environment made in `work`."""
    subprocess.run([sys.executable, "-m", "venv", work / "venv"], check=True)
    beside = work / "venv" / ("Scripts" if os.name == "nt" else "bin")
    (site,) = {p.parent for p in (work / "venv").rglob("site-packages/pip")}
    before = size(site)
    pip = [beside / "python", "-m", "pip", "-q", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", work, ROOT], check=True)
    (wheel,) = work.glob("jaxphoto-*.whl")
    subprocess.run([*pip, "install", wheel if lean else f"{wheel}[all]"], check=True)
    of = {path.name: size(path) for path in site.iterdir()}
    rows = [f"all of it | {sum(of.values()) - before:.0f}"]
    rows += [f"`{name}` | {of[name]:.0f}" for name in sorted(of, key=lambda n: -of[n]) if of[name] >= 20]
    starts = []
    for name, (program, *words) in _STARTS.items():
        took = [cpu_seconds([beside / program, *words], work) for _ in range(_ROUNDS + 1)]
        starts.append(f"`{name}` | {min(took[1:]):.2f}")
    return "\n".join([
        "| installed | MB |", "| --- | --- |", *(f"| {row} |" for row in rows), "",
        "| start | seconds of the processor, least of 5 |", "| --- | --- |", *(f"| {row} |" for row in starts),
    ])  # fmt: skip


def size(path: Path) -> float:
    """Megabytes of a file or a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(p.stat().st_size for p in files if p.is_file()) / 1e6


def cpu_seconds(call: list, folder: Path) -> float:
    """User and system time of a process, all its threads together."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    subprocess.run(call, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


if __name__ == "__main__":
    main()
