"""How near to the limits of a GPU (or, without one, of the CPU) the adjustment runs. See README.md.

python benchmarks/accelerator.py [--problems P31 B200 B1000] [--draws 64]
"""

import argparse
import dataclasses
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from blocks import SIZES, Problem, generate, read_npz
from machine import machine, markdown, sentence, write_results
from ours import block_of

import jaxphoto
from jaxphoto.adjustment import Linearised, NormalEquations, PaddedStructure, PaddedValues, solve
from jaxphoto.adjustment.layout.sharding import EVERYWHERE, along_points, sharded
from jaxphoto.adjustment.model.numbers import Increments, zero_increments
from jaxphoto.adjustment.solver.band import factor_band
from jaxphoto.adjustment.solver.non_image_rows import non_image_rows
from jaxphoto.adjustment.solver.reduced import ray_columns, reduce_normal
from jaxphoto.block import Block
from jaxphoto.compiling import run_compiled

_ROUNDS = 5
# Sides of the square matrices, and numbers of a vector, that show the limits: far beyond any cache, a second at most.
_LIMITS = {"cpu": (2048, 1 << 25), "gpu": (8192, 1 << 28)}
# Strips are shifted by up to this many metres (standard deviation), as in the Monte Carlo of the peers.
_SHIFTS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="*", default=list(SIZES), choices=list(SIZES))
    parser.add_argument("--npz", type=Path, help="folder of P31.npz ... of the peers' generator, instead of our own")
    parser.add_argument("--draws", type=int, default=64, help="adjustments of the Monte Carlo (none for 0)")
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    arguments = parser.parse_args()
    kind, head = jax.default_backend(), machine()
    device = jax.devices()[0].device_kind
    if kind == "cpu":
        print("No GPU is present (or jax is installed without it): this measures the CPU.", file=sys.stderr)
    limits = _limits(kind)
    records: list[dict] = [{"kind": "head", "backend": kind, "device": device, **limits, **head}]
    for name in arguments.problems:
        records.append(measure(block_of(_problem(name, arguments.npz), name if arguments.npz else f"own {name}")))
        print(name, file=sys.stderr)
    if arguments.draws:
        problem = _problem("P31", arguments.npz)
        records.append(monte_carlo(block_of(problem, "P31"), problem.strip, arguments.draws))
    write_results(arguments.out, "accelerator", records, "\n".join(table(records)))


def _problem(name: str, folder: Path | None) -> Problem:
    return read_npz(folder / f"{name}.npz") if folder else generate(SIZES[name])


def _seconds(call: Callable[[], Any], rounds: int = _ROUNDS) -> list[float]:
    """Seconds of each warm call."""
    jax.block_until_ready(call())
    seconds = []
    for _ in range(rounds):
        began = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - began)
    return seconds


def _limits(kind: str) -> dict[str, float]:
    """What the device reaches in this run: operations of a large product, bytes of a large sum a + 3 b."""
    side, length = _LIMITS["cpu" if kind == "cpu" else "gpu"]
    a, v = jnp.ones((side, side)), jnp.ones(length)
    product, triad = jax.jit(jnp.matmul), jax.jit(lambda x, y: x + 3 * y)
    other = v + 1
    return {
        "gflops": 2 * side**3 / min(_seconds(lambda: product(a, a))) / 1e9,
        "gbytes": 3 * 8 * length / min(_seconds(lambda: triad(v, other))) / 1e9,
    }


def measure(block: Block) -> dict:
    """One block: solve and covariance, and one linearisation with its factorisation against the limits."""

    def once():
        adjusted = solve(block, block.start.unknowns, block.priors)
        jaxphoto.covariance(adjusted)
        return adjusted

    once()
    adjusted = [once() for _ in range(_ROUNDS)]
    last = adjusted[-1].equations
    at, work = _at(last), _work(last)
    # Compiled as `solve` is.
    steps = _seconds(lambda: run_compiled(_step, (at.values, at.scale, at.structure), {}, ""))
    return {
        "kind": "block",
        "problem": block.title,
        "images": len(block.images),
        "image_points": len(block.image_points.xy),
        "steps": int(adjusted[-1].steps),
        "solve_s": statistics.median(a.seconds["solve"] for a in adjusted),
        "covariance_s": statistics.median(a.seconds["covariance"] for a in adjusted),
        "step_s": statistics.median(steps),
        **work,
    }


def _at(equations: NormalEquations) -> Linearised:
    """Where the block was linearised last; arrays by way of the host, so that no device holds them for itself."""
    free = jax.tree.map(lambda v: jnp.asarray(np.asarray(v)) if eqx.is_array(v) else v, equations)
    return Linearised(zero_increments(free.structure), free.factored.scale, free.values, free.structure)


@eqx.filter_jit
def _step(values: PaddedValues, scale: Increments, structure: PaddedStructure):
    """Sums of the reduced normal equations and their factor."""

    def of_device(values, scale, structure):
        a, reduced, _ = reduce_normal(Linearised(jax.tree.map(jnp.zeros_like, scale), scale, values, structure), 0.0)
        return factor_band(a), reduced.l

    return sharded(of_device, structure, (EVERYWHERE, along_points(2)))(values, scale, structure)


def _work(equations: NormalEquations) -> dict[str, float]:
    """Operations of one such step, and the bytes that it has to move at least.

    Operations of residuals and derivatives are those that XLA counts (`cost_analysis`) for one batch of rays, times
    batches; those of products and of the factorisation are counted by hand, as XLA counts loops once. Empty slots
    count like others. Bytes are those of what is read and written once: measurements, structure, results, and the
    reduced matrix before it is factored; what stays in caches is not counted.
    """
    at, s = _at(equations), equations.structure
    rest, rays = non_image_rows(at), s.rays
    numbers = rays.chunk_image[0], rays.ray_point[0], at.values.xy[0], at.values.sigma_xy[0]
    cost = jax.jit(ray_columns(at)).lower(numbers).compile().cost_analysis() or {}
    batches, pair_batches = rays.used.sum(axis=0)
    border = s.n_interior + len(rest.coupled) + 1
    of_ray = 2 * 2 * (7 + s.n_image_colours) ** 2 + 2 * 3 * 6 * (6 + border)
    slots, pairs = batches * rays.ray_point[0].size, pair_batches * rays.pair[0].size // 2
    products = slots * of_ray + pairs * 2 * 3 * 6 * 6 + 2 * 3 * s.n_points * border**2
    band = equations.factored.factor
    inner, _, width = band.columns.shape
    k, q = inner + 1, len(band.end) - width
    n = k * width
    factor = k * width**3 / 3 + (k - 1) * 3 * width**3 + 2 * n * q * width + n * q * q
    # Read: everything that goes in. Written, read and written again: the reduced matrix and its factor.
    into = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(eqx.filter(at, eqx.is_array)))
    out = 3 * 8 * sum(v.size for v in band) + 8 * (9 * s.n_points)
    return {
        "derivative_gflop": batches * cost.get("flops", 0.0) / 1e9,
        "product_gflop": products / 1e9,
        "factor_gflop": factor / 1e9,
        "gbyte": (into + out) / 1e9,
    }


def monte_carlo(block: Block, strip: np.ndarray, draws: int) -> dict:
    """Adjustments with shifted strips, all at once by `jax.vmap`, from the optimum of the block as it is."""
    optimum = solve(block, block.start.unknowns, block.priors)
    rng = np.random.default_rng(0)
    shift = rng.normal(size=(draws, strip.max() + 1, 3)) * np.resize(_SHIFTS, draws)[:, None, None]
    stations = np.ravel(block.stations.value) + shift[:, strip].reshape(draws, -1)

    def adjusted(values) -> tuple:
        shifted = dataclasses.replace(block, stations=dataclasses.replace(block.stations, value=values))
        found = solve(shifted, optimum.unknowns, block.priors)
        return found.unknowns.interior["cam"].c, found.steps

    @eqx.filter_jit
    def together(values):
        return jax.vmap(adjusted)(values)

    first: dict[str, float] = {}
    _, steps = run_compiled(together, (stations,), first, "")
    seconds = statistics.median(_seconds(lambda: run_compiled(together, (stations,), {}, ""), 3))
    few = stations[: min(draws, 8)]
    began = time.perf_counter()
    for values in few:
        adjusted(values)
    return {
        "kind": "monte carlo",
        "draws": draws,
        "compile_s": first["compile"],
        "per_s": draws / seconds,
        "loop_per_s": len(few) / (time.perf_counter() - began),
        "steps": int(np.max(steps)),
        "seconds": seconds,
        **_work(optimum.equations),
    }


def table(records: list[dict]) -> list[str]:
    """The records as Markdown."""
    head = records[0]
    lines = [
        f"### Limits reached: {head['device']} ({head['backend']})",
        "",
        sentence(head),
        *(["No GPU is present: this is the CPU."] if head["backend"] == "cpu" else []),
        f"Limits measured in the same run: {head['gflops']:.0f} GFLOP/s (product of large matrices, float64), "
        f"{head['gbytes']:.1f} GB/s (a + 3 b of long vectors).",
        "",
        "`python benchmarks/accelerator.py`",
        "",
    ]
    names = ["problem", "solve ms", "steps", "covariance ms", "one linearisation and factor ms"]
    names += ["Gflop: derivatives, products, factor", "GFLOP/s", "of the limit", "MB", "GB/s", "of the limit"]
    rows = []
    for r in records:
        if r["kind"] == "block":
            cells = [r["problem"], f"{1e3 * r['solve_s']:.1f}", str(r["steps"]), f"{1e3 * r['covariance_s']:.1f}"]
            rows.append([*cells, f"{1e3 * r['step_s']:.2f}", *_reached(r, head, r["step_s"], 1)])
    lines += markdown(names, rows)
    for r in records:
        if r["kind"] != "monte carlo":
            continue
        # All go on until the last is done, and under vmap each step linearises: both sides of a condition are computed.
        reached = _reached(r, head, r["seconds"], r["draws"] * r["steps"])
        lines += [
            "",
            f"Monte Carlo, P31 re-adjusted {r['draws']} times with shifted strips: {r['per_s']:.0f} adjustments a "
            f"second by `jax.vmap` ({r['steps']} steps at most; compiling {r['compile_s']:.0f} s), "
            f"{r['loop_per_s']:.0f} one after the other from Python. "
            f"{reached[1]} GFLOP/s, {reached[2]} of the limit; {reached[4]} GB/s, {reached[5]}.",
        ]
    return lines


def _reached(r: dict, head: dict, seconds: float, times: int) -> list[str]:
    parts = [r[f"{name}_gflop"] for name in ("derivative", "product", "factor")]
    flops, rate = times * sum(parts) / seconds, times * r["gbyte"] / seconds
    return [
        ", ".join(f"{v:.2g}" for v in parts),
        f"{flops:.1f}",
        f"{flops / head['gflops']:.0%}",
        f"{1e3 * r['gbyte']:.1f}",
        f"{rate:.2f}",
        f"{rate / head['gbytes']:.1%}",
    ]


if __name__ == "__main__":
    main()
