"""Ours against the peers on the same block, in one interleaved run. See README.md.

python benchmarks/run.py [--problem P31 | --npz FILE | --bal FILE] [--ceres BIN] [--ceres-bal BIN] [--rounds 7]
"""

import argparse
import os
import shutil
import statistics
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from machine import machine, markdown, run_apart, write_results
from peers import BY_HAND, CERES, Files, Peers, peers_of

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", default="P31", choices=("P31", "B200", "B1000"), help="size of a block of our own")
    parser.add_argument("--npz", type=Path, help="a problem of the peers' generator, instead of our own")
    parser.add_argument("--bal", type=Path, help='a problem file of "Bundle Adjustment in the Large", instead')
    parser.add_argument("--ceres", type=Path, help="the C++ peers' binary")
    parser.add_argument("--ceres-bal", type=Path, help="that for BAL files")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--cores", type=int, help="all solvers on so many cores; else ours on all, the C++ ones on one")
    parser.add_argument("--also", nargs="*", default=[], metavar="PEER", help="scipy, pyceres: even if it takes long")
    parser.add_argument("--without", nargs="*", default=[], metavar="PEER", help="scipy, pyceres: leave it out")
    parser.add_argument("--start", action="store_true", help="measure starts of the command line, too")
    parser.add_argument("--no-cache", action="store_true", help="compile anew, to measure compiling")
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        records = measure(arguments, Path(folder))
    write_results(arguments.out, "run", records, "\n".join(table(records)))


def measure(arguments, folder: Path) -> list[dict]:
    """All records: one head, one a solve and round, one a start of the command line."""
    from ours import Worker

    file, files, sizes = _problem(arguments, folder)
    peers: Peers = peers_of(files, arguments)
    head = {
        "kind": "head",
        **sizes,
        "rounds": arguments.rounds,
        "command": _command(arguments),
        "missing": peers.missing,
        **machine(),
    }
    records = [head]
    worker = Worker(file, cached=not arguments.no_cache, cores=arguments.cores)
    solvers = {"ours": worker.solve, **peers.solvers}
    try:
        for k in range(arguments.rounds):
            for solve in solvers.values():
                load = os.getloadavg()[0]
                records.append({"kind": "solve", "round": k, "load": load, **solve()})
            print(f"round {k + 1} of {arguments.rounds}", file=sys.stderr)
    finally:
        worker.stop()
    return records + (starts(file, folder) if arguments.start else [])


def _problem(arguments, folder: Path) -> tuple[Path, Files, dict]:
    """The file that ours reads, those of all peers, and how large the problem is."""
    if arguments.bal:
        with arguments.bal.open() as file:
            images, points, rows = map(int, file.readline().split())
        size = {"images": images, "points": points, "image_points": rows, "unknowns": 9 * images + 3 * points}
        return arguments.bal, Files(size["unknowns"], bal=arguments.bal), {"problem": arguments.bal.stem, **size}
    import numpy as np
    from blocks import SIZES, generate, read_npz, write_bin

    problem = read_npz(arguments.npz) if arguments.npz else generate(SIZES[arguments.problem])
    title = arguments.npz.stem if arguments.npz else f"own {arguments.problem}"
    npz, flat = folder / "problem.npz", folder / "problem.bin"
    np.savez(npz, **asdict(problem))
    write_bin(problem, flat)
    size = {
        "images": len(problem.init_eop),
        "points": len(problem.init_pts),
        "image_points": len(problem.obs_xy),
        "unknowns": problem.n_unknowns,
    }
    return npz, Files(problem.n_unknowns, npz=npz, flat=flat), {"problem": title, **size}


def _command(arguments) -> str:
    words = ["python benchmarks/run.py"]
    source = next((n for n in ("bal", "npz") if getattr(arguments, n)), None)
    words += [f"--{source}", getattr(arguments, source).name] if source else ["--problem", arguments.problem]
    words += ["--ceres ceres_ba"] if arguments.ceres else []
    words += ["--ceres-bal ceres_bal"] if arguments.ceres_bal else []
    words += [f"--cores {arguments.cores}"] if arguments.cores else []
    words += [f"--{n} {' '.join(v)}" for n in ("also", "without") if (v := getattr(arguments, n))]
    words += [f"--{n.replace('_', '-')}" for n in ("start", "no_cache") if getattr(arguments, n)]
    return " ".join([*words, "--rounds", str(arguments.rounds)])


def starts(file: Path, folder: Path) -> list[dict]:
    """Cold start (nothing compiled), cached start, and the import alone, each in a fresh process."""
    import time

    from ours import read_block

    from jaxphoto import write_block

    block, cache = folder / "block", folder / "cache"
    write_block(read_block(file), block)
    environment = {"XDG_CACHE_HOME": str(cache), "JAX_COMPILATION_CACHE_DIR": str(cache / "jax")}
    program = "import sys; from jaxphoto_command import main; sys.argv = ['jaxphoto', *sys.argv[1:]]; main()"
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
        run_apart(command, environment=environment)
        records.append({"kind": "start", "what": name, "seconds": time.perf_counter() - began, "load": load})
    return records


def table(records: list[dict]) -> list[str]:
    """The records as Markdown."""
    head, solves = records[0], [r for r in records if r["kind"] == "solve"]
    by_solver: dict[str, list[dict]] = {}
    for r in solves:
        by_solver.setdefault(r["solver"], []).append(r)
    loads = [r["load"] for r in solves]
    # Ratios are to these two; without them, to the first peer that there is.
    others = [name for name in by_solver if name != "jaxphoto"]
    bases = [name for name in others if name.startswith((CERES, BY_HAND))] or others[:1]
    best = min(r["cost"] for r in solves)
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
    ]
    names = ["solver", "solve ms", *(f"ratio to {_short(b)}" for b in bases), "steps", "cost above the best (relative)"]
    names += ["covariance ms", *(f"ratio to {_short(b)}" for b in bases), "peak memory MB"]
    names += [f"ratio to {_short(b)}" for b in bases[:1]]
    rows = []
    for name, own in by_solver.items():
        cells = [name, _spread(own, "solve_s"), *(_ratio(own, by_solver[b], "solve_s") for b in bases)]
        cells += [str(own[0]["steps"]), f"{max(r['cost'] for r in own) / best - 1:.1e}"]
        cells += [_spread(own, "covariance_s"), *(_ratio(own, by_solver[b], "covariance_s") for b in bases)]
        cells += [f"{max(r['memory_mb'] for r in own):.0f}"]
        cells += [_ratio(own, by_solver[b], "memory_mb") for b in bases[:1]]
        rows.append(cells)
    lines += markdown(names, rows)
    ours = by_solver["jaxphoto"]
    lines += ["", f"Our whole call from Python: {_spread(ours, 'call_s')} ms; compiling: {ours[0]['compile_s']:.1f} s."]
    lines += [f"Our peak memory with all covariances: {max(r['memory_with_covariance_mb'] for r in ours):.0f} MB."]
    lines += [f"{sentence}." for sentence in head["missing"]]
    begun = [r for r in records if r["kind"] == "start"]
    if begun:
        rows = [[r["what"], f"{r['seconds']:.1f}", f"{r['load']:.1f}"] for r in begun]
        lines += ["", *markdown(["start", "seconds", "load"], rows)]
    return lines


def _short(name: str) -> str:
    return CERES if name.startswith(CERES) else name


def _values(rows: list[dict], key: str) -> list[float]:
    return [r[key] for r in rows if r.get(key) is not None]


def _ratio(rows: list[dict], base: list[dict], key: str) -> str:
    own, other = _values(rows, key), _values(base, key)
    return f"{statistics.median(own) / statistics.median(other):.2f}" if own and other else "-"


def _spread(rows: list[dict], key: str) -> str:
    values = [1e3 * v for v in _values(rows, key)]
    if not values:
        return "-"
    digits = 0 if statistics.median(values) >= 100 else 1
    return f"{statistics.median(values):.{digits}f} [{min(values):.{digits}f}-{max(values):.{digits}f}]"


if __name__ == "__main__":
    main()
