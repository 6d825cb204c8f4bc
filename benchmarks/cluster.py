"""Studies on the workers of a Dask scheduler: rates, memory, faults, and a model of many workers.

python benchmarks/cluster.py rates faults model --out DIR

rates: draws of P31 and of B200, and flights of paper 000, per second by number of workers, each on one core; beside
them one process on one core, and two such processes at the same time, which is what this machine can do at most.
faults: four workers on two cores, one killed every 20 s, ten times; then the scheduler. The file of draws is compared.
model: the number of workers at which the client, or its network, would limit the study, from the measured overheads.
"""

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from statistics import median

import numpy as np
from blocks import SIZES, generate
from machine import machine, markdown, memory, run_apart, sentence, write_results
from ours import block_of

import jaxphoto
from jaxphoto.experiment import MonteCarlo
from jaxphoto.experiment.simulated_flights import simulate_flights
from jaxphoto.io.recipe import read_recipe
from jaxphoto.sensitivity import Readjustment, bias
from jaxphoto.workers import connected, in_parts

HERE = Path(__file__).resolve()
ROOT = HERE.parents[1]
# Bytes per second of a network of 1 Gbit/s.
_NETWORK = 1e8
STUDIES = {"P31": 100_000, "B200": 1000, "flights": 200}
"""Draws, or flights of paper 000."""


def main() -> None:
    """Measure the parts named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["rates", "faults", "model"])
    parser.add_argument("--studies", nargs="*", default=list(STUDIES))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--every-s", type=float, default=20.0)
    parser.add_argument("--fault-draws", type=int, default=800_000)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--study", choices=STUDIES, help=argparse.SUPPRESS)
    parser.add_argument("--workers", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.study:
        print(json.dumps(_measured(arguments.study, arguments.workers)))
        return
    head, records, lines = machine(), [], ["## Workers", ""]
    lines += [sentence(head), ""]
    if "rates" in arguments.parts or "model" in arguments.parts:
        records = _rates(arguments.studies, arguments.rounds)
        lines += [*_rate_table(records), ""]
    if "model" in arguments.parts:
        lines += [*_model(records), ""]
    if "faults" in arguments.parts:
        lines += _faults(arguments.kills, arguments.every_s, arguments.fault_draws)
    write_results(arguments.out, "cluster", [head | r for r in records], "\n".join(lines))


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _state() -> tuple[float, float]:
    """Processor time (s) and peak of memory (MB) of this process."""
    return _cpu(), memory("VmHWM")


def _one_core() -> None:
    """Restrict all threads of this process to its first core; JAX is not yet started."""
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), {min(os.sched_getaffinity(0))})


def _monte_carlo(size: str, draws: int):
    """Return a function of folder, seed and number of draws that makes a study."""
    block = block_of(generate(SIZES[size]), "draws")
    adjusted, errors = jaxphoto.adjust(block), bias(block, "station", 0.15, per="strip")
    run = Readjustment(adjusted, errors.applied, np.broadcast_to(errors.sigma, (draws, len(errors.sigma))))
    return lambda folder, seed, n: MonteCarlo(block, run, errors, n, seed, folder)


def _measured(study: str, workers: int) -> dict:
    """Run a study once to compile, then once more; 0 workers: in this process."""
    count = STUDIES[study]
    recipe = read_recipe(ROOT / "experiments" / "000" / "recipe.toml") if study == "flights" else None
    made = None if recipe else _monte_carlo(study, count)
    with tempfile.TemporaryDirectory() as name, connected(workers or None, None) as client:
        if workers == 1:
            # A single worker has all cores.
            client.run(_one_core)

        def run(n: int, seed: int) -> None:
            folder = Path(name) / str(seed)
            if made is None:
                simulate_flights(recipe, n, seed, folder, client=client)
            else:
                made(folder, seed, n).draw(client=client)

        def timed(n: int, seed: int) -> tuple[float, float]:
            """Return wall time and processor time of this process."""
            cpu, began = _cpu(), time.perf_counter()
            run(n, seed)
            return time.perf_counter() - began, _cpu() - cpu

        first = 8 * max(workers, 1) if recipe else count // 10
        run(first, 10**6)
        few = timed(first, 10**6 + 1) if client else (0.0, 0.0)
        idle = _idle() if client else 0.0
        before = client.run(_state) if client else {}
        wall, spent = timed(count, 0)
        after = client.run(_state) if client else {"here": _state()}
        part = json.loads((Path(name) / "0" / "run.json").read_text())["per_part"]
        size = sum(file.stat().st_size for file in (Path(name) / "0").rglob("*.parquet"))
        # Without what passes while workers compute, and without what a run of any length costs.
        per_draw = (spent - few[1] - idle * (wall - few[0])) / (count - first)
        scheduling = _scheduling(client) if client else 0.0
    of_workers = sum(after[at][0] - before[at][0] for at in before)
    return {
        "study": study, "workers": workers, "per_s": count / wall, "wall_s": wall, "client_cpu_s": spent,
        "workers_cpu_s": of_workers, "memory_mb": max(state[1] for state in after.values()), "bytes": size,
        "draws_per_part": part, "idle": idle, "client_s_per_draw": max(per_draw, 0.0), "s_per_part": scheduling,
    }  # fmt: skip


def _idle(seconds: float = 10.0) -> float:
    """Return the fraction of a core that client, scheduler and nannies take while they wait."""
    began = _cpu()
    time.sleep(seconds)
    return (_cpu() - began) / seconds


class _Empty:
    """Study whose parts cost nothing."""

    def compute(self, part: int) -> int:
        """Return the part."""
        return part


def _scheduling(client, parts: int = 1000) -> float:
    """Return the seconds that client and scheduler take per part."""
    began = _cpu()
    assert sorted(k for k, _ in in_parts(_Empty(), ((k, k) for k in range(parts)), client)) == list(range(parts))
    return (_cpu() - began) / parts


def _command(study: str, workers: int) -> list[str]:
    return [sys.executable, str(HERE), "--study", study, "--workers", str(workers)]


def _rates(studies: list[str], rounds: int) -> list[dict]:
    records = []
    for study in studies:
        for _ in range(rounds):
            alone = run_apart(_command(study, 0), cores=1)[0] | {"kind": "one process"}
            records += [alone, _two_alone(study)]
            for workers in (1, 2):
                (found,) = run_apart(_command(study, workers))
                records.append(found | {"kind": f"{workers} worker{'s' * (workers > 1)}"})
            print(f"{study}: " + ", ".join(f"{r['kind']} {r['per_s']:.4g}/s" for r in records[-4:]), file=sys.stderr)
    return records


def _two_alone(study: str) -> dict:
    """Two processes at the same time, each on its core: the sum of their rates."""
    found: list[dict] = []

    def run(core: int) -> None:
        found.extend(run_apart(["taskset", "--cpu-list", str(core), *_command(study, 0)]))

    threads = [threading.Thread(target=run, args=(core,)) for core in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found[0] | {"kind": "two processes", "per_s": sum(r["per_s"] for r in found)}


def _of(records: list[dict], study: str, kind: str, field: str) -> float:
    return median(r[field] for r in records if (r["study"], r["kind"]) == (study, kind))


def _rate_table(records: list[dict]) -> list[str]:
    head = ["study", "run", "per second", "to one", "client CPU [s]", "workers' CPU [s]", "memory per process [MB]"]
    rows = []
    for study in dict.fromkeys(r["study"] for r in records):
        for kind in ("one process", "two processes", "1 worker", "2 workers"):
            fields = ("per_s", "client_cpu_s", "workers_cpu_s", "memory_mb")
            rate, client, workers, mb = (_of(records, study, kind, field) for field in fields)
            one = _of(records, study, "1 worker" if kind == "2 workers" else "one process", "per_s")
            rows.append(
                [study, kind, f"{rate:.4g}", f"{rate / one:.3f}", f"{client:.2f}", f"{workers:.2f}", f"{mb:.0f}"]
            )
    return markdown(head, rows)


def _model(records: list[dict]) -> list[str]:
    """The client handles parts one after the other; workers compute at the same time."""
    rows = []
    for study in dict.fromkeys(r["study"] for r in records):
        of = {f: _of(records, study, "1 worker", f) for f in records[0] if f != "kind" and f != "study"}
        n, idle, size = STUDIES[study], of["idle"], of["draws_per_part"]
        worker, client = of["workers_cpu_s"] / n, of["client_s_per_draw"]
        network, scheduling = of["bytes"] / n / _NETWORK, of["s_per_part"] / size
        most = 1 / max((client + scheduling) / max(1 - idle, 0.1), network)
        rows.append(
            [study, f"{1e3 * worker:.3g}", f"{size:.0f}", f"{1e3 * of['s_per_part']:.2g}",
             f"{1e3 * (client + scheduling):.2g}", f"{1e3 * network:.2g}", f"{worker * most:,.0f}",
             f"{min(1000 / worker, most):,.0f}"]
        )  # fmt: skip
    head = [
        "study", "worker [ms per draw]", "draws per part", "scheduling [ms per part]", "client [ms per draw]",
        "network [ms per draw]", "workers at the limit", "draws per second with 1000 workers",
    ]  # fmt: skip
    return markdown(head, rows)


def _faults(kills: int, every_s: float, draws: int) -> list[str]:
    """Kill workers and the scheduler of a run, and compare its file with that of an undisturbed run."""
    made, lines = _monte_carlo("P31", draws), []
    with tempfile.TemporaryDirectory() as name:
        quiet, disturbed = (Path(name) / folder for folder in ("quiet", "disturbed"))
        made(quiet, 5, draws).draw()
        wanted = (quiet / "draws.parquet").read_bytes()
        done, killed, counted = threading.Event(), list[int](), list[int]()
        with connected(4, None) as client:

            def kill() -> None:
                while len(killed) < kills and not done.wait(every_s):
                    alive = list(client.run(os.getpid).values())
                    os.kill(alive[len(killed) % len(alive)], signal.SIGKILL)
                    killed.append(counted[-1] if counted else 0)

            killer = threading.Thread(target=kill)
            killer.start()
            study = made(disturbed, 5, draws)
            began = time.perf_counter()
            study.draw(counted.append, client)
            wall = time.perf_counter() - began
            done.set()
            killer.join()
        equal = (disturbed / "draws.parquet").read_bytes() == wanted
        lines.append(
            f"{draws:,} draws of P31 by four workers on two cores: {len(killed)} killed (after {killed} draws), "
            f"{wall:.0f} s, {study.computed:,} draws received; file {'equal' if equal else 'NOT EQUAL'} to the bit."
        )
        lines.append(_scheduler_killed(made, Path(name), draws // 4))
    return lines


def _scheduler_killed(made, folder: Path, draws: int) -> str:
    """Kill a scheduler in the middle of a run, start another, and go on."""
    made(folder / "whole", 6, draws).draw()
    computed, errors = list[int](), list[str]()
    for attempt in range(2):
        at = f"tcp://127.0.0.1:{8790 + attempt}"
        scheduler = ["scheduler", "--host", "127.0.0.1", "--port", at.rpartition(":")[2], "--dashboard-address", ":0"]
        dask = [sys.executable, "-m", "dask"]
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
        server = subprocess.Popen([*dask, *scheduler], **quiet)
        time.sleep(5)
        workers = subprocess.Popen([*dask, "worker", at, "--nworkers", "2", "--nthreads", "1"], **quiet)
        try:
            with connected(None, at) as client:
                client.wait_for_workers(2)
                study = made(folder / "stopped", 6, draws)

                def stop(done: int, server=server, attempt=attempt) -> None:
                    if attempt == 0 and done > draws // 3:
                        server.kill()

                study.draw(stop, client)
        except jaxphoto.InputError as error:
            errors.append(str(error))
        computed.append(study.computed)
        for process in (workers, server):
            process.kill()
            process.wait()
    equal = (folder / "stopped" / "draws.parquet").read_bytes() == (folder / "whole" / "draws.parquet").read_bytes()
    words = "equal" if equal else "NOT EQUAL"
    return (
        f"Scheduler killed in a run of {draws:,} draws: {computed[0]:,} received, then {len(errors)} message; with a "
        f"new scheduler {computed[1]:,} more, sum {sum(computed):,}; file {words} to the bit."
    )


if __name__ == "__main__":
    main()
