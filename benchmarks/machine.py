"""The machine that is measured on, memory, and solvers in processes of their own."""

import datetime
import json
import os
import platform
import resource
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

HERE = Path(__file__).resolve().parent


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
        "jax": release("jax"),
        "jaxphoto": release("jaxphoto"),
    }


def release(package: str) -> str:
    """The installed version, "" where there is none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def sentence(head: dict) -> str:
    """What `machine` said, for the top of a table."""
    return (
        f"{head['date']}; {head['cpu']}, {head['cores']} cores, load {head['load'][0]:.1f} at the start; "
        f"Python {head['python']}, jax {head['jax']}, jaxphoto {head['jaxphoto']}."
    )


def memory(field: str) -> float:
    """Of this process in MB: "VmHWM", its peak of resident memory, or "VmRSS", what is resident now.

    The peak is that of the process itself, without what it inherited from the one that started it.
    """
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def forget_peak() -> bool:
    """Let the peak of resident memory begin anew; False where the system cannot."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def run_apart(command: list[str], cores: int | None = None, environment: dict[str, str] | None = None) -> list[dict]:
    """The JSON objects that a program prints, one a line; on the first `cores` cores only, if given."""
    # By way of a small shell: a process starts with the peak memory of the one it was forked from.
    small = ["sh", "-c", '"$0" "$@"; exit $?', *pinned(command, cores)]
    given = os.environ | {"OPENBLAS_NUM_THREADS": "1"} | (environment or {})
    done = subprocess.run(small, capture_output=True, text=True, env=given)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed: {done.stderr.strip()[-800:]}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def run_here(script: str, *arguments: object, **options) -> list[dict]:
    """`run_apart` of a script of this folder."""
    return run_apart([sys.executable, str(HERE / script), *map(str, arguments)], **options)


def pinned(command: list[str], cores: int | None) -> list[str]:
    """The command on the first `cores` cores only."""
    return ["taskset", "--cpu-list", f"0-{cores - 1}", *command] if cores else command


def write_results(folder: Path | None, name: str, records: list[dict], text: str) -> None:
    """Print the text; append it and every single measurement to files of `folder`, if given."""
    print(text)
    if folder:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "results.jsonl").open("a", encoding="utf-8") as file:
            file.writelines(json.dumps({"benchmark": name, **record}) + "\n" for record in records)
        with (folder / "results.md").open("a", encoding="utf-8") as file:
            file.write(text + "\n\n")


def exponent(sizes: list[float], values: list[float]) -> str:
    """The power of `sizes` that `values` follow: the slope of the straight line through their logarithms."""
    import numpy as np

    pairs = [(s, v) for s, v in zip(sizes, values, strict=True) if s > 0 and v > 0]
    if len(pairs) < 2:
        return "-"
    x, y = np.log(np.array(pairs)).T
    return f"{np.polyfit(x, y, 1)[0]:.2f}"


def markdown(head: list[str], rows: list[list[str]]) -> list[str]:
    """A table."""
    return ["| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows)]
