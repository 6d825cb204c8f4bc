"""Time the lines of README.md with nothing compiled, and again in a new process. See README.md here.

python benchmarks/readme.py [--draws 2000]
"""

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from machine import machine, markdown, sentence

_ROOT = Path(__file__).parents[1]
_SETUP = "import jax, jax.numpy as jnp, jaxphoto\nblock = jaxphoto.read_block('examples/cross_block')\n"


def lines_of_readme(draws: int) -> dict[str, list[str]]:
    """Name each part of README.md and give the command that runs it."""
    python = re.findall(r"```python\n(.*?)```", (_ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    adjust, derivative, functions = python
    adjusted = _SETUP + "adjusted = jaxphoto.adjust(block)\n"
    function, _ = derivative.split("jax.jit(jax.grad", 1)
    samples = f"jax.block_until_ready(jax.jit(jax.vmap(c_mm))(jnp.linspace(-0.1, 0.1, {draws})))"
    return {
        "`jaxphoto adjust examples/cross_block`": [
            str(Path(sys.executable).with_name("jaxphoto")),
            "adjust",
            "examples/cross_block",
        ],
        "Which parameters are correlated?": [sys.executable, "-c", adjust],
        "A distortion of your own": [sys.executable, "-c", functions],
        "`adjust`, `jit(grad(c_mm))`, `jit(vmap(c_mm))` of three": [sys.executable, "-c", adjusted + derivative],
        f"`adjust`, `jit(vmap(c_mm))` of {draws:,}": [sys.executable, "-c", adjusted + function + samples],
    }


def measure(command: list[str], cache: str) -> str:
    """Run a command and return its wall and CPU seconds."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    caches = {"XDG_CACHE_HOME": cache, "JAX_COMPILATION_CACHE_DIR": f"{cache}/jax"}
    environment = os.environ | caches | {"MPLBACKEND": "agg"}
    out = ["--out", f"{cache}/results"] if "adjust" in command else []
    done = subprocess.run([*command, *out], cwd=_ROOT, env=environment, capture_output=True, text=True)
    wall = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.exit(done.stderr)
    return f"{wall:.1f}, {after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=2000)
    arguments = parser.parse_args()
    rows = []
    for name, line in lines_of_readme(arguments.draws).items():
        with tempfile.TemporaryDirectory() as cache:
            rows.append([name, measure(line, cache), measure(line, cache)])
    names = ["README", "nothing compiled: wall, CPU s", "new process: wall, CPU s"]
    print("\n".join([sentence(machine()), "", *markdown(names, rows)]))


if __name__ == "__main__":
    main()
