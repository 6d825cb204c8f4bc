"""Ours against the peers on the same block, in one interleaved run. See README.md.

python benchmarks/run.py [--problem P31] [--npz FILE] [--ceres BIN [--bin FILE]] [--rounds 7]
"""

import argparse
import datetime
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
HERE = Path(__file__).resolve().parent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", default="P31", choices=("P31", "B200"), help="size of a block of our own")
    parser.add_argument("--npz", type=Path, help="a problem of the peers' generator, instead of our own")
    parser.add_argument("--bin", type=Path, help="the same problem for the C++ peer; written from the npz by default")
    parser.add_argument("--ceres", type=Path, help="the C++ peer's binary")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--no-scipy", action="store_true", help="leave scipy out")
    parser.add_argument("--no-start", action="store_true", help="leave the starts of the command line out")
    parser.add_argument("--no-cache", action="store_true", help="compile anew, to measure compiling")
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        _work(arguments.worker)
        return
    with tempfile.TemporaryDirectory() as folder:
        records = measure(arguments, Path(folder))
    text = "\n".join(table(records))
    print(text)
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        with (arguments.out / "results.jsonl").open("a", encoding="utf-8") as file:
            file.writelines(json.dumps(record) + "\n" for record in records)
        with (arguments.out / "results.md").open("a", encoding="utf-8") as file:
            file.write(text + "\n\n")


def measure(arguments, folder: Path) -> list[dict]:
    """All records: one head, one a solve and round, one a start of the command line."""
    import numpy as np
    from blocks import generate, read_npz, write_bin
    from peers import run_ceres, run_scipy

    problem = read_npz(arguments.npz) if arguments.npz else generate(arguments.problem)
    title = arguments.npz.stem if arguments.npz else f"own {arguments.problem}"
    npz, flat = folder / "problem.npz", arguments.bin or folder / "problem.bin"
    np.savez(npz, **asdict(problem))
    if not arguments.bin:
        write_bin(problem, flat)
    head = {
        "kind": "head",
        "problem": title,
        "images": len(problem.init_eop),
        "points": len(problem.init_pts),
        "image_points": len(problem.obs_xy),
        "unknowns": problem.n_unknowns,
        "rounds": arguments.rounds,
        "command": _command(arguments),
        **machine(),
    }
    records, small = [head], len(problem.init_pts) < 5000
    worker = Worker(npz, cached=not arguments.no_cache)
    try:
        for k in range(arguments.rounds):
            records.append({"kind": "solve", "round": k, "load": os.getloadavg()[0], **worker.solve()})
            if arguments.ceres:
                record = run_ceres(arguments.ceres, flat, small, covariance=True)
                records.append({"kind": "solve", "round": k, "load": os.getloadavg()[0], **record})
            if not arguments.no_scipy:
                records.append({"kind": "solve", "round": k, "load": os.getloadavg()[0], **run_scipy(npz)})
            print(f"round {k + 1} of {arguments.rounds}", file=sys.stderr)
    finally:
        worker.stop()
    if not arguments.no_start:
        records += starts(npz, title, folder)
    return records


def machine() -> dict:
    """What may be told of the machine: no names, no places."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {
        "date": datetime.date.today().isoformat(),
        "cpu": model,
        "cores": os.cpu_count(),
        "load": [round(v, 2) for v in os.getloadavg()],
        "python": platform.python_version(),
        "jax": _version("jax"),
        "jaxphoto": _version("jaxphoto"),
    }


def _version(name: str) -> str:
    from importlib.metadata import version

    return version(name)


def _command(arguments) -> str:
    words = ["python benchmarks/run.py"]
    words += ["--npz", arguments.npz.name] if arguments.npz else ["--problem", arguments.problem]
    words += ["--ceres ceres_ba"] if arguments.ceres else []
    return " ".join([*words, "--rounds", str(arguments.rounds)])


class Worker:
    """A long-lived process that holds the block and solves it on request."""

    def __init__(self, npz: Path, cached: bool):
        environment = os.environ | ({} if cached else {"JAX_ENABLE_COMPILATION_CACHE": "false"})
        command = [sys.executable, __file__, "--worker", str(npz)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def solve(self) -> dict:
        """One warm solve."""
        stdin, stdout = self.process.stdin, self.process.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write("solve\n")
        stdin.flush()
        line = stdout.readline()
        if not line:
            raise SystemExit("our worker process failed; its message is above")
        return json.loads(line)

    def stop(self) -> None:
        """End the process."""
        if self.process.stdin:
            self.process.stdin.close()
        self.process.wait(timeout=60)


def _work(npz: Path) -> None:
    """The worker: compile and warm up once, then one solve a line."""
    from blocks import block_of, read_npz
    from peers import peak_memory

    import jaxphoto
    from jaxphoto.adjustment import solve

    block = block_of(read_npz(npz), "benchmark")

    def once() -> tuple:
        began = time.perf_counter()
        adjusted = solve(block, block.start.unknowns, block.priors)
        whole = time.perf_counter() - began
        jaxphoto.covariance(adjusted)
        return adjusted, whole

    first, _ = once()
    compiling = first.seconds["compile"]
    once()
    for _ in sys.stdin:
        adjusted, whole = once()
        record = {
            "solver": "jaxphoto",
            "solve_s": adjusted.seconds["solve"],
            "call_s": whole,
            "covariance_s": adjusted.seconds["covariance"],
            "compile_s": compiling,
            "steps": int(adjusted.steps),
            "cost": float(adjusted.square_sum) / 2,
            "memory_mb": peak_memory(),
        }
        print(json.dumps(record), flush=True)


def starts(npz: Path, title: str, folder: Path) -> list[dict]:
    """Cold start (nothing compiled), cached start, and the import alone, each in a fresh process."""
    from blocks import block_of, read_npz

    from jaxphoto import write_block

    block = folder / "block"
    write_block(block_of(read_npz(npz), title), block)
    cache = folder / "cache"
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "JAX_COMPILATION_CACHE_DIR": str(cache / "jax")}
    program = "import sys; from jaxphoto.cli import main; sys.argv = ['jaxphoto', *sys.argv[1:]]; main()"
    run = [sys.executable, "-c", program, "adjust", str(block), "--out", str(folder / "out")]
    records = []
    for name, command in (
        ("`jaxphoto adjust`, nothing compiled", run),
        ("`jaxphoto adjust`, compiled before", run),
        ("`jaxphoto adjust`, compiled before, again", run),
        ("`import jaxphoto`", [sys.executable, "-c", "import jaxphoto"]),
    ):
        shutil.rmtree(folder / "out", ignore_errors=True)
        load, began = os.getloadavg()[0], time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        seconds = time.perf_counter() - began
        if done.returncode:
            raise SystemExit(f"{name} failed: {done.stderr.strip()[-500:]}")
        records.append({"kind": "start", "what": name, "seconds": seconds, "load": load})
    return records


def table(records: list[dict]) -> list[str]:
    """The records as Markdown."""
    head, solves = records[0], [r for r in records if r["kind"] == "solve"]
    by_solver: dict[str, list[dict]] = {}
    for r in solves:
        by_solver.setdefault(r["solver"], []).append(r)
    reference = next((v for k, v in by_solver.items() if k.startswith("Ceres")), None) or next(
        (v for k, v in by_solver.items() if k != "jaxphoto"), by_solver["jaxphoto"]
    )
    best = min(r["cost"] for r in solves)
    base = statistics.median(r["solve_s"] for r in reference)
    loads = [r["load"] for r in solves]
    lines = [
        f"### {head['problem']}: {head['images']} images, {head['points']} points, "
        f"{head['image_points']} image points, {head['unknowns']} unknowns",
        "",
        f"{head['date']}; {head['cpu']}, {head['cores']} cores, load {min(loads):.1f} to {max(loads):.1f}; "
        f"Python {head['python']}, jax {head['jax']}, jaxphoto {head['jaxphoto']}; "
        f"{head['rounds']} interleaved rounds, median [min-max].",
        "",
        f"`{head['command']}`",
        "",
        f"| solver | solve ms | ratio to {reference[0]['solver']} | steps | cost above the best (relative) | "
        "covariance ms | peak memory MB |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, rows in by_solver.items():
        ratio = statistics.median(r["solve_s"] for r in rows) / base
        excess = max(r["cost"] for r in rows) / best - 1
        lines.append(
            f"| {name} | {_spread(rows, 'solve_s')} | {ratio:.2f} | {rows[0]['steps']} | {excess:.1e} | "
            f"{_spread(rows, 'covariance_s')} | {max(r['memory_mb'] for r in rows):.0f} |"
        )
    ours = by_solver["jaxphoto"]
    lines += ["", f"Our whole call from Python: {_spread(ours, 'call_s')} ms; compiling: {ours[0]['compile_s']:.1f} s."]
    begun = [r for r in records if r["kind"] == "start"]
    if begun:
        lines += ["", "| start | seconds | load |", "| --- | --- | --- |"]
        lines += [f"| {r['what']} | {r['seconds']:.1f} | {r['load']:.1f} |" for r in begun]
    return lines


def _spread(rows: list[dict], key: str) -> str:
    values = [1e3 * r[key] for r in rows if r.get(key) is not None]
    if not values:
        return "-"
    digits = 0 if statistics.median(values) >= 100 else 1
    return f"{statistics.median(values):.{digits}f} [{min(values):.{digits}f}-{max(values):.{digits}f}]"


if __name__ == "__main__":
    main()
