"""How many compilations a notebook costs that adjusts 20 different blocks. See README.md.

python benchmarks/compilations.py [--blocks 20]
"""

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from blocks import generate, parallel_strips
from machine import machine, markdown, run_here, sentence, write_results

_WAYS = {"as they come": "", "with `sizes=common_sizes(blocks)`": "--common"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=20)
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--common", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        _work(arguments.blocks, arguments.common)
        return
    head = machine()
    records = [{"kind": "head", **head}]
    rows = []
    for name, option in _WAYS.items():
        print(name, file=sys.stderr)
        with tempfile.TemporaryDirectory() as cache:
            own = run_here(
                "compilations.py",
                *("--worker", "--blocks", arguments.blocks, *([option] if option else [])),
                environment={"XDG_CACHE_HOME": cache, "JAX_COMPILATION_CACHE_DIR": f"{cache}/jax"},
            )
        records += [{"kind": "call", "way": name, **r} for r in own]
        rows.append(_row(name, own))
    names = ["way", "programs to adjust", "programs for covariances", "blocks that compiled to adjust"]
    names += ["XLA compilations, all told", "first call s", "median call ms", "all calls s"]
    text = [f"### Compilations of {arguments.blocks} different blocks in one process, nothing compiled before", ""]
    text += [sentence(head), "", f"`python benchmarks/compilations.py --blocks {arguments.blocks}`", ""]
    write_results(arguments.out, "compilations", records, "\n".join([*text, *markdown(names, rows)]))


def _row(name: str, records: list[dict]) -> list[str]:
    programs = Counter(p for r in records for p in r["programs"])
    adjusting = [sum(p in _ADJUSTING for p in r["programs"]) for r in records]
    seconds = [r["seconds"] for r in records]

    def list_of(wanted: bool) -> str:
        own = {p: n for p, n in programs.items() if (p in _ADJUSTING) == wanted}
        return f"{sum(own.values())} ({', '.join(f'{n} {p}' for p, n in own.items())})"

    return [
        name,
        list_of(True),
        list_of(False),
        str(sum(n > 0 for n in adjusting)),
        str(sum(r["xla"] for r in records)),
        f"{seconds[0]:.1f}",
        f"{1e3 * np.median(seconds):.0f}",
        f"{sum(seconds):.1f}",
    ]


# Programs of `jaxphoto.adjust`; the others belong to `jaxphoto.covariance`.
_ADJUSTING = ("_optimise", "_residuals")


def _work(n_blocks: int, common: bool) -> None:
    """Adjust one block after the other, as a notebook would; print what each call compiled and how long it took."""
    import jax.monitoring
    from ours import block_of

    import jaxphoto
    from jaxphoto.compiling import run

    rng = np.random.default_rng(20)
    blocks = []
    for k in range(n_blocks):
        strips, images = rng.integers(2, 5), rng.integers(10, 16)
        size = parallel_strips(int(strips), int(images), int(strips * images * rng.integers(5, 21)), seed=k)
        blocks.append(block_of(generate(size), f"block {k}"))
    sizes = jaxphoto.common_sizes(blocks) if common else None

    compiled = Counter[str]()
    jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: compiled.update([event]))
    for block in blocks:
        known, xla = set(run._programs), compiled[_COMPILED]
        began = time.perf_counter()
        adjusted = jaxphoto.adjust(block) if sizes is None else jaxphoto.adjust(block, sizes=sizes)
        jaxphoto.covariance(adjusted)
        record = {
            "images": len(block.images),
            "points": len(block.points),
            "image_points": len(block.image_points.xy),
            "seconds": time.perf_counter() - began,
            "programs": [key[0].__name__ for key in run._programs if key not in known],  # type: ignore[index]
            "xla": compiled[_COMPILED] - xla,
            "converged": bool(adjusted.converged),
        }
        print(json.dumps(record), flush=True)


# JAX's event of a compilation.
_COMPILED = "/jax/core/compile/backend_compile_duration"


if __name__ == "__main__":
    main()
