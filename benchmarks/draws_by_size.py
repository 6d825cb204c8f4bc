"""Monte Carlo of station heights by strip: re-adjustments a second against the size of the block, as a curve.

python benchmarks/draws_by_size.py --beside ../former --picture docs/images/monte_carlo_rate.png
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
from blocks import SIZES, Problem, Size, generate, parallel_strips, read_npz
from machine import exponent, machine, markdown, memory, sentence, write_results
from ours import block_of

from jaxphoto.adjustment import solve
from jaxphoto.sensitivity import Readjustment, bias

HERE = Path(__file__).resolve()
# By name; P31 is a cross of 31 images, T39 three strips of 13 images, the others have parallel strips and two across.
_SIZES: dict[str, Size] = {
    "P31": SIZES["P31"],
    "T39 small": parallel_strips(3, 13, 1_000),
    "T39 medium": parallel_strips(3, 13, 5_000),
    "B200 small": replace(SIZES["B200"], points=5_000),
    "B200": SIZES["B200"],
    "T39": parallel_strips(3, 13, 27_000),
}
_SIGMA = (0.0, 0.0, 0.15)
# Seconds of a round, at least.
_SECONDS = 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", choices=list(_SIZES), default=list(_SIZES))
    parser.add_argument("--beside", type=Path, help="another checkout, measured in turn with this one")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--picture", type=Path, help="file for the curve")
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        return _work(read_npz(arguments.worker))
    head, records = machine(), []
    checkouts = {"jaxphoto": HERE.parents[1]} | ({"beside": arguments.beside} if arguments.beside else {})
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.sizes:
            records += _measure(name, Path(folder) / "problem.npz", checkouts, arguments.rounds)
    text = "\n".join(["## Draws by size", "", sentence(head), "", *_table(records)])
    write_results(arguments.out, "draws by size", [head | r for r in records], text)
    if arguments.picture:
        _draw(records, arguments.picture, arguments.beside.name if arguments.beside else "")
    return None


def _measure(name: str, file: Path, checkouts: dict[str, Path], rounds: int) -> list[dict]:
    """All checkouts, one after the other in each round."""
    problem = generate(_SIZES[name])
    np.savez(file, **vars(problem))
    work = [sys.executable, str(HERE), "--worker", str(file)]
    workers = {}
    for who, path in checkouts.items():
        environment = os.environ | {"PYTHONPATH": str(path.resolve())}
        workers[who] = subprocess.Popen(work, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    records = []
    for _ in range(rounds):
        for who, worker in workers.items():
            assert worker.stdin is not None
            assert worker.stdout is not None
            worker.stdin.write("again\n")
            worker.stdin.flush()
            said = json.loads(worker.stdout.readline())
            records.append({"size": name, "solver": who, "image_points": len(problem.obs_img)} | said)
    for worker in workers.values():
        assert worker.stdin is not None
        worker.stdin.close()
        worker.wait(timeout=60)
    return records


def _work(problem: Problem) -> None:
    """The worker: compile, then some batches for each line."""
    block = block_of(problem, "draws")
    errors = bias(block, "station", _SIGMA, "strip")
    # As many as are worth compiling thoroughly.
    drawn = np.random.default_rng(777).normal(size=(1000, len(errors.sigma))) * errors.sigma
    run = Readjustment(solve(block, block.start.unknowns, block.priors), errors.applied, drawn)
    run.warm_up()
    for _ in sys.stdin:
        print(json.dumps(_once(run, drawn)), flush=True)


def _once(run: Readjustment, drawn: np.ndarray) -> dict:
    began, processor, done, steps, fallbacks = time.perf_counter(), time.process_time(), 0, 0, 0
    while time.perf_counter() - began < _SECONDS:
        # Two batches: the second is begun before the first is fetched.
        for draws in run.batches(np.resize(drawn, (2 * run.batch_size, drawn.shape[1]))):
            done, steps = done + len(draws.steps), steps + int(draws.steps.sum())
            fallbacks += int(draws.fallback.sum())
    seconds, processor = time.perf_counter() - began, time.process_time() - processor
    return {
        "per_s": done / seconds,
        "per_core_s": done / processor,
        "side_by_side": run.batch_size,
        "steps": steps / done,
        "fallbacks": fallbacks,
        "memory_mb": memory("VmHWM"),
    }


def _curve(records: list[dict], solver: str, key: str) -> tuple[list[int], list[float]]:
    """Image points and the median of `key`, ascending by the former."""
    values: dict[int, list[float]] = {}
    for r in records:
        if r["solver"] == solver:
            values.setdefault(r["image_points"], []).append(r[key])
    sizes = sorted(values)
    return sizes, [median(values[n]) for n in sizes]


def _table(records: list[dict]) -> list[str]:
    sizes, rates = _curve(records, "jaxphoto", "per_core_s")
    beside = dict(zip(*_curve(records, "beside", "per_core_s"), strict=True))
    rows = []
    for n, rate, wall in zip(sizes, rates, _curve(records, "jaxphoto", "per_s")[1], strict=True):
        one = next(r for r in records if r["image_points"] == n and r["solver"] == "jaxphoto")
        ratio = f"{rate / beside[n]:.1f}" if beside else "-"
        more = f"{one['steps']:.2f}", f"{one['fallbacks']}", f"{one['memory_mb']:.0f}"
        rows.append([one["size"], f"{n}", f"{rate:.3g}", f"{1e9 / rate / n:.0f}", f"{wall:.3g}", ratio, *more])
    head = ["block", "image points", "draws a second of one core", "ns an image point", "draws a second, all cores"]
    lines = markdown([*head, "over the checkout beside", "steps", "fallbacks", "peak MB"], rows)
    return [*lines, "", f"Exponent of the rate of one core: {exponent(sizes, rates)}."]


def _draw(records: list[dict], file: Path, beside: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.subplots()
    for solver, name, style in (("beside", beside, "o--"), ("jaxphoto", "jaxphoto", "o-")):
        sizes, rates = _curve(records, solver, "per_core_s")
        if sizes:
            axes.loglog(sizes, rates, style, label=name, color="0.6" if solver == "beside" else "tab:blue")
    names = {r["image_points"]: r["size"] for r in records}
    for n, rate in zip(*_curve(records, "jaxphoto", "per_core_s"), strict=True):
        axes.annotate(names[n], (n, rate), textcoords="offset points", xytext=(6, 5), fontsize=8)
    axes.set(xlabel="image points", ylabel="re-adjustments a second of one core")
    axes.grid(which="both", color="0.9", lw=0.5)
    axes.legend(frameon=False)
    figure.savefig(file, dpi=120)


if __name__ == "__main__":
    main()
