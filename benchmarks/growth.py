"""How time and memory grow with image points, and with images. See README.md.

python benchmarks/growth.py [--most 100000] [--images 31 200] [--widest 800]
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from blocks import SIZES, Size, generate, parallel_strips
from machine import exponent, forget_peak, machine, markdown, memory, run_here, sentence, write_results

# Image points of a point, roughly: three quarters of a block are seen in nine images, and its edges in fewer.
_RAYS = 5.7
_ROUNDS = 3
# Points an image, where the number of images grows.
_POINTS_PER_IMAGE = 30
_STRIPS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=int, default=100_000, help="image points of the largest block (10^6 if asked)")
    parser.add_argument("--images", type=int, nargs="*", default=[31, 200], help="numbers of images that are held")
    parser.add_argument("--widest", type=int, default=800, help="images of the largest block of the second table")
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        print(json.dumps(_work(arguments.worker)))
        return
    head = machine()
    images = " ".join(map(str, arguments.images))
    command = f"python benchmarks/growth.py --most {arguments.most} --images {images} --widest {arguments.widest}"
    lines = ["### Growth", "", sentence(head), "", f"`{command}`"]
    records = [{"kind": "head", **head}]
    for held in arguments.images:
        own = [_measure(size) for size in _by_points(held, arguments.most)]
        records += own
        lines += ["", f"{own[0]['images']} images, more and more points:", "", *_points_table(own)]
    own = [_measure(size) for size in _by_images(arguments.widest)]
    records += own
    lines += ["", f"{_POINTS_PER_IMAGE} points an image, more and more images:", "", *_images_table(own)]
    write_results(arguments.out, "growth", records, "\n".join(lines))


def _by_points(images: int, most: int) -> list[Size]:
    """Blocks of P31's or B200's strips, or of parallel ones, with 10^3, 10^4 ... image points."""
    strips = {31: SIZES["P31"], 200: SIZES["B200"]}.get(images) or parallel_strips(_STRIPS, images // _STRIPS, 0)
    sizes, rows = [], 1000
    while rows <= most:
        # An image with a handful of points would leave its orientation open.
        if rows >= 20 * images:
            sizes.append(replace(strips, points=int(rows / _RAYS), control=33))
        rows *= 10
    return sizes


def _by_images(most: int) -> list[Size]:
    """Five strips, twice as long from one block to the next: a band of the same width, twice as long."""
    return [
        parallel_strips(_STRIPS, n // _STRIPS, _POINTS_PER_IMAGE * n) for n in (50, 100, 200, 400, 800) if n <= most
    ]


def _measure(size: Size) -> dict:
    """One block, in a process that did not generate it: what that takes is not to be measured."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "block.npz"
        np.savez(file, **asdict(generate(size)))
        (record,) = run_here("growth.py", "--worker", file)
    print(f"{record['images']} images, {record['image_points']} image points", file=sys.stderr)
    return record


def _work(file: Path) -> dict:
    """Time and memory of warm solves; time of the Cholesky factorisation alone, banded and dense."""
    import jax
    import jax.numpy as jnp
    from ours import read_block

    from jaxphoto.adjustment import solve
    from jaxphoto.adjustment.rank import reduced_matrix
    from jaxphoto.adjustment.solver.band import dense, factor_band
    from jaxphoto.compiling import run

    block = read_block(file)

    def once():
        return solve(block, block.start.unknowns, block.priors)

    once()
    before = memory("VmRSS")
    fresh = forget_peak()
    adjusted = [once() for _ in range(_ROUNDS)]
    peak = memory("VmHWM")
    last = adjusted[-1].equations
    (solver,) = (p for k, p in run._programs.items() if k[0].__name__ == "optimise")  # type: ignore[index]
    planned = solver.compiled.memory_analysis()
    program = sum(getattr(planned, f"{name}_size_in_bytes") for name in ("argument", "output", "temp"))
    # Planned is what one device needs.
    program *= last.structure.shards
    # By way of the host: of a block that several devices share, each would repeat what is timed here.
    reduced = reduced_matrix(last)
    reduced = jax.tree.map(lambda v: jnp.asarray(np.asarray(v)), reduced)
    inner, _, m = reduced.columns.shape
    k, q = inner + 1, len(reduced.end) - m
    n = k * m
    whole = dense(reduced)

    def seconds(function, argument) -> float:
        compiled = jax.jit(function).lower(argument).compile()
        jax.block_until_ready(compiled(argument))
        times = []
        for _ in range(_ROUNDS):
            began = time.perf_counter()
            jax.block_until_ready(compiled(argument))
            times.append(time.perf_counter() - began)
        return statistics.median(times)

    return {
        "kind": "growth",
        "images": len(block.images),
        "points": len(block.points),
        "image_points": len(block.image_points.xy),
        "steps": int(adjusted[-1].steps),
        "step_s": statistics.median(a.seconds["solve"] / int(a.steps) for a in adjusted),
        "solve_s": statistics.median(a.seconds["solve"] for a in adjusted),
        "slots": last.structure.rays.ray_point.size,
        "program_mb": program / 1e6,
        "peak_mb": peak if fresh else None,
        "resident_mb": before,
        "unknowns": n + q,
        "column_blocks": k,
        "block_images": m // 6,
        "band_flop": k * m**3 / 3 + (k - 1) * 3 * m**3 + 2 * n * q * m,
        "dense_flop": (n + q) ** 3 / 3,
        "band_mb": 8 * sum(v.size for v in reduced) / 1e6,
        "dense_mb": 8 * (n + q) ** 2 / 1e6,
        "band_s": seconds(factor_band, reduced),
        "dense_s": seconds(jnp.linalg.cholesky, whole),
    }


def _points_table(records: list[dict]) -> list[str]:
    names = ["image points", "steps", "ms a step", "us an image point", "program MB", "peak MB"]
    rows = [
        [
            str(r["image_points"]),
            str(r["steps"]),
            f"{1e3 * r['step_s']:.2f}",
            f"{1e6 * r['step_s'] / r['image_points']:.2f}",
            f"{r['program_mb']:.1f}",
            f"{r['peak_mb']:.0f}" if r["peak_mb"] else "-",
        ]
        for r in records
    ]
    sizes = [r["image_points"] for r in records]
    powers = [exponent(sizes, [r[key] or 0 for r in records]) for key in ("step_s", "program_mb", "peak_mb")]
    return markdown(names, [*rows, ["**exponent**", "", powers[0], "", powers[1], powers[2]]])


def _images_table(records: list[dict]) -> list[str]:
    names = ["images", "image points", "column blocks x images", "band Mflop", "dense Mflop", "band ms", "dense ms"]
    names += ["band MB", "dense MB", "ms a step", "program MB"]
    rows = [
        [
            str(r["images"]),
            str(r["image_points"]),
            f"{r['column_blocks']} x {r['block_images']}",
            f"{r['band_flop'] / 1e6:.0f}",
            f"{r['dense_flop'] / 1e6:.0f}",
            f"{1e3 * r['band_s']:.1f}",
            f"{1e3 * r['dense_s']:.1f}",
            f"{r['band_mb']:.1f}",
            f"{r['dense_mb']:.1f}",
            f"{1e3 * r['step_s']:.1f}",
            f"{r['program_mb']:.1f}",
        ]
        for r in records
    ]
    keys = ("band_flop", "dense_flop", "band_s", "dense_s", "band_mb", "dense_mb", "step_s", "program_mb")
    powers = [exponent([r["images"] for r in records], [r[key] for r in records]) for key in keys]
    return markdown(names, [*rows, ["**exponent**", "", "", *powers]])


if __name__ == "__main__":
    main()
