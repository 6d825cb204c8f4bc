"""Monte Carlo: re-adjustments a second beside the C++ peers', and how time and memory grow with the draws.

python benchmarks/monte_carlo.py --npz P31.npz --biases P31_mc.npz --ceres ceres_ba
"""

import argparse
import json
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import equinox as eqx
import numpy as np
from blocks import SIZES, Problem, generate, read_npz, write_bin
from machine import exponent, machine, markdown, memory, run_apart, run_here, sentence, write_results
from ours import SIGN, block_of

import jaxphoto
from jaxphoto.adjustment import solve
from jaxphoto.experiment import MonteCarlo
from jaxphoto.sensitivity import Readjustment, bias, join_draws

HERE = Path(__file__).resolve()
_GROWTH = (100, 1000, 10_000, 100_000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--npz", type=Path, help="a problem of the peers' generator, instead of our own P31")
    parser.add_argument("--biases", type=Path, help="npz with `bias` (draws, strips, 3) in m; else drawn, 5 to 30 cm")
    parser.add_argument("--ceres", type=Path, help="the C++ peers' binary")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--growth", type=int, default=10_000, help="most draws of the second table (0: no such table)")
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    parser.add_argument("--worker", choices=("draws", "growth"), help=argparse.SUPPRESS)
    parser.add_argument("--draws", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker == "draws":
        return _work(read_npz(arguments.npz), np.load(arguments.biases)["bias"])
    if arguments.worker == "growth":
        return _work_on_disk(read_npz(arguments.npz), arguments.draws)
    head = machine()
    with tempfile.TemporaryDirectory() as name:
        records = _measure(arguments, Path(name))
        records += _grow(arguments, Path(name))
    text = "\n".join(["## Monte Carlo", "", sentence(head), "", *_table(records), "", *_growth_table(records)])
    write_results(arguments.out, "monte carlo", [head | r for r in records], text)
    return None


def _measure(arguments, folder: Path) -> list[dict]:
    """Ours and the peers', one after the other in each round."""
    problem = _problem(arguments)
    biases = folder / "biases.npz"
    drawn = np.load(arguments.biases)["bias"] if arguments.biases else _drawn(problem)
    np.savez(biases, bias=drawn)
    peers = _peers(arguments.ceres, problem, drawn, folder) if arguments.ceres else {}
    work = [sys.executable, str(HERE), "--worker", "draws", "--npz", str(_file(arguments, folder)), "--biases"]
    ours = subprocess.Popen([*work, str(biases)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert ours.stdin is not None
    assert ours.stdout is not None
    records = []
    for _ in range(arguments.rounds):
        ours.stdin.write("again\n")
        ours.stdin.flush()
        records.append(json.loads(ours.stdout.readline()))
        for name, command in peers.items():
            (said,) = run_apart(command)
            records.append({"kind": "draws", "solver": name, "per_s": said["per_s"], "memory_mb": said["rss_mb"]})
    ours.stdin.close()
    ours.wait(timeout=60)
    if peers:
        records += _differences(problem, drawn, peers, folder)
    return records


def _problem(arguments) -> Problem:
    return read_npz(arguments.npz) if arguments.npz else generate(SIZES["P31"])


def _file(arguments, folder: Path) -> Path:
    if arguments.npz:
        return arguments.npz
    path = folder / "P31.npz"
    if not path.exists():
        np.savez(path, **vars(_problem(arguments)))
    return path


def _drawn(problem: Problem, draws: int = 1000) -> np.ndarray:
    sigma = np.resize([0.05, 0.10, 0.15, 0.20, 0.25, 0.30], draws)
    strips = int(problem.strip.max()) + 1
    return np.random.default_rng(777).normal(size=(draws, strips, 3)) * sigma[:, None, None]


def _peers(binary: Path, problem: Problem, drawn: np.ndarray, folder: Path) -> dict[str, list[str]]:
    flat, biases = folder / "problem.bin", folder / "biases.bin"
    write_bin(problem, flat)
    biases.write_bytes(struct.pack("<2q", *drawn.shape[:2]) + np.ascontiguousarray(drawn, "<f8").tobytes())
    base = [str(binary), str(flat), "--mc", str(biases), "--start", "warm"]
    ceres = [*base, "--solver", "dense_schur", "--radius", "1e8", "--ftol", "1e-8", "--threads"]
    hand = [*base, "--solver", "hand_gn", "--ftol", "1e-5", "--threads"]
    ways = {"Ceres": ceres, "C++ by hand": hand}
    return {f"{name}, {n} thread(s)": [*way, str(n)] for name, way in ways.items() for n in (1, 2)}


def _differences(problem: Problem, drawn: np.ndarray, peers: dict[str, list[str]], folder: Path) -> list[dict]:
    """The largest difference of any draw's interior orientation to a peer's tightest, in standard deviations."""
    nominal, ours = _readjusted(problem, drawn)
    cov = jaxphoto.covariance(nominal)
    sigma = np.sqrt(np.diagonal(cov.matrix))[6 * cov.n_images :]
    records = []
    for name, command in peers.items():
        if "2 thread" not in name:
            continue
        tight = [*command[: command.index("--ftol")], "--ftol", "1e-16", *command[command.index("--ftol") + 2 :]]
        run_apart([*tight, "--mc-out", str(folder / "peer.csv")])
        rows = np.genfromtxt(folder / "peer.csv", delimiter=",", skip_header=1)[:, 2:7] * SIGN
        worst = float(np.abs((rows - ours) / sigma).max())
        records.append({"kind": "difference", "solver": name, "sigmas": worst})
    return records


def _change(problem: Problem):
    def change(errors, block):
        rows = block.stations
        return eqx.tree_at(lambda b: b.stations.value, block, rows.value + errors[problem.strip[rows.who], rows.axis])

    return change


def _readjusted(problem: Problem, drawn: np.ndarray):
    block = block_of(problem, "draws")
    nominal = solve(block, block.start.unknowns, block.priors)
    run = Readjustment(nominal, _change(problem), drawn)
    return nominal, join_draws(run.batches(drawn)).shared


def _work(problem: Problem, drawn: np.ndarray) -> None:
    """The worker: compile, then all draws once for each line."""
    block = block_of(problem, "draws")
    run = Readjustment(solve(block, block.start.unknowns, block.priors), _change(problem), drawn)
    run.warm_up()
    for _ in sys.stdin:
        print(json.dumps(_once(run, drawn)), flush=True)


def _once(run: Readjustment, drawn: np.ndarray) -> dict:
    began = time.perf_counter()
    draws = join_draws(run.batches(drawn))
    seconds = time.perf_counter() - began
    return {
        "kind": "draws",
        "solver": "jaxphoto",
        "per_s": len(drawn) / seconds,
        "compile_s": run.seconds["compile"],
        "converged": int(draws.converged.sum()),
        "fallbacks": int(draws.fallback.sum()),
        "steps": float(draws.steps.mean()),
        "memory_mb": memory("VmHWM"),
    }


def _grow(arguments, folder: Path) -> list[dict]:
    """Draws streamed to disk, each number in a process of its own."""
    records = []
    for draws in (n for n in _GROWTH if n <= arguments.growth):
        given = ("--worker", "growth", "--npz", _file(arguments, folder), "--draws", draws)
        records += run_here("monte_carlo.py", *given)
    return records


def _work_on_disk(problem: Problem, draws: int) -> None:
    block = block_of(problem, "draws")
    nominal = solve(block, block.start.unknowns, block.priors)
    errors = bias(block, "station", 0.15, "strip")
    run = Readjustment(nominal, errors.applied, np.broadcast_to(errors.sigma, (draws, len(errors.sigma))))
    with tempfile.TemporaryDirectory() as name:
        study = MonteCarlo(block, run, errors, draws, 0, Path(name) / "run")
        study.draw()
        summary, _ = study.write()
    record = {"kind": "growth", "draws": draws, "per_s": summary["draws_per_second"], "memory_mb": memory("VmHWM")}
    print(json.dumps(record | {"compile_s": summary["seconds"]["compile"]}), flush=True)


def _table(records: list[dict]) -> list[str]:
    draws = [r for r in records if r["kind"] == "draws"]
    rates: dict[str, list[float]] = {}
    for r in draws:
        rates.setdefault(r["solver"], []).append(r["per_s"])
    rows = []
    for name, values in rates.items():
        ratio = median(a / b for a, b in zip(rates["jaxphoto"], values, strict=True))
        peak = max(r["memory_mb"] for r in draws if r["solver"] == name)
        spread = f"{median(values):.0f} [{min(values):.0f}-{max(values):.0f}]"
        rows.append([name, spread, f"{ratio:.1f}", f"{peak:.0f}"])
    lines = markdown(["solver", "re-adjustments a second", "ours over it", "peak MB"], rows)
    ours = next(r for r in draws if r["solver"] == "jaxphoto")
    lines += [
        "",
        f"Ours: {ours['steps']:.2f} steps, {ours['fallbacks']} fallbacks, compiling {ours['compile_s']:.1f} s.",
    ]
    for r in records:
        if r["kind"] == "difference":
            far = f"{r['sigmas']:.1e} sigma"
            lines.append(f"Largest difference of an interior parameter to {r['solver']} (ftol 1e-16): {far}.")
    return lines


def _growth_table(records: list[dict]) -> list[str]:
    grown = [r for r in records if r["kind"] == "growth"]
    if not grown:
        return []
    rows = [[f"{r['draws']}", f"{r['per_s']:.0f}", f"{r['memory_mb']:.0f}"] for r in grown]
    sizes = [r["draws"] for r in grown]
    rows.append(["exponent", *(exponent(sizes, [r[key] for r in grown]) for key in ("per_s", "memory_mb"))])
    return markdown(["draws, on disk", "a second", "peak MB"], rows)


if __name__ == "__main__":
    main()
