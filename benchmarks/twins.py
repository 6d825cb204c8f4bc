"""The twins of paper 002, adjusted with all their covariances: time, memory, and how far off their cameras are.

python benchmarks/twins.py [--twins target indoor uav]
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

from machine import HERE, machine, markdown, memory, run_here, sentence, write_results

_TWINS = ("target", "indoor", "uav")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--twins", nargs="*", default=list(_TWINS), help=f"of {', '.join(_TWINS)}")
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--block", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        print(json.dumps(_WORK[arguments.worker](arguments.block)))
        return
    head = machine()
    command = f"python benchmarks/twins.py --twins {' '.join(arguments.twins)}"
    records = [{"kind": "head", **head}]
    for twin in arguments.twins:
        with tempfile.TemporaryDirectory() as folder:
            block, cache = Path(folder) / twin, {"XDG_CACHE_HOME": folder, "JAX_COMPILATION_CACHE_DIR": f"{folder}/jax"}
            run_here("twins.py", "--worker", "simulate", "--block", block)
            for kind in ("first", "again"):
                (record,) = run_here("twins.py", "--worker", "adjust", "--block", block, environment=cache)
                records.append({"kind": kind, "twin": twin, **record})
    titles = [
        "twin",
        "images",
        "points",
        "image points",
        "",
        "adjust s",
        "covariances s",
        "peak MB",
        "sigma naught",
        "off",
    ]
    rows = [_row(r) for r in records[1:]]
    lines = ["### Twins of paper 002", "", sentence(head), "", f"`{command}`", "", *markdown(titles, rows)]
    lines += ["", "Each in a process of its own: *first* compiles, *again* finds the programs in the cache."]
    write_results(arguments.out, "twins", records, "\n".join(lines))


def _row(r: dict) -> list[str]:
    counts = [f"{r[k]:,}" for k in ("images", "points", "image_points")]
    return [
        r["twin"], *counts, r["kind"], f"{r['adjust_s']:.1f}", f"{r['covariances_s']:.1f}", f"{r['peak_mb']:.0f}",
        f"{r['sigma0']:.4f}", f"{r['off']:.1f} sigma",
    ]  # fmt: skip


def _simulate(folder: Path) -> dict:
    """The twin's block with its truth."""
    import pickle

    import jaxphoto
    from jaxphoto.simulation import simulate

    recipe = jaxphoto.read_recipe(HERE.parent / "experiments" / "002" / f"{folder.name}.toml")
    folder.write_bytes(pickle.dumps(simulate(recipe)))
    return {}


def _adjust(folder: Path) -> dict:
    """What a notebook waits for: the adjustment, and standard deviations of all unknowns."""
    import pickle

    import jaxphoto
    from jaxphoto.camera import get_parameter

    simulation = pickle.loads(folder.read_bytes())
    block = simulation.block
    began = time.perf_counter()
    adjusted = jaxphoto.adjust(block)
    done = time.perf_counter()
    tables = jaxphoto.Tables(adjusted)
    exterior, significance = tables.exterior, tables.significance
    ended = time.perf_counter()
    assert len(exterior) == len(block.images)
    off = [
        abs(s.value - float(get_parameter(interior, s.parameter))) / s.sigma
        for interior in simulation.truth.interior.values()
        for s in significance
    ]
    return {
        "images": len(block.images),
        "points": len(block.points),
        "image_points": len(block.image_points.xy),
        "adjust_s": done - began,
        "covariances_s": ended - done,
        "seconds": adjusted.seconds,
        "steps": int(adjusted.steps),
        "peak_mb": memory("VmHWM"),
        "sigma0": float(adjusted.sigma0),
        "off": max(off),
    }


_WORK = {"simulate": _simulate, "adjust": _adjust}

if __name__ == "__main__":
    main()
