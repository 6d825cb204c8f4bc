"""Fixtures for all tests."""

import gc
import os
from importlib.metadata import version
from pathlib import Path
from zlib import crc32

import pytest

# As `jaxphoto` does where it is imported first; here NumPy's OpenBLAS is loaded before, by JAX.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Most time is compilation: without optimisation it takes less than half, and results change by rounding only.
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
    # XLA ends a process that is given an unknown flag.
    if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):
        os.environ["XLA_FLAGS"] += " --xla_cpu_use_fusion_emitters=false"
# Processes and runs share compiled programs, also the thousands of small ones.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR",
    str(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxphoto" / "tests"),
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

import jax
from hypothesis import HealthCheck, settings

from tests.checked_types import check_types
from tests.marks import QUICK

check_types()
# The machine may be busy.
settings.register_profile("patient", suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

from jaxphoto.adjustment.adjust import _layouts  # noqa: E402
from jaxphoto.compiling import run, store  # noqa: E402

# The suite compiles hundreds of programs of 2 MB: a user's limit would remove them before another process needs them.
store.MOST = 2_000_000_000
# Linux gives a process 65,530 memory mappings, and XLA crashes without one. A large program takes some three hundred, a
# module of tests up to 43,000 (test_declared on jax 0.12). Limits after a module, and after a test.
_MOST_MAPPINGS, _MOST_WITHIN = 30_000, 50_000
# Bytes in memory: two processes and their children must fit into 16 GB.
_MOST_MEMORY = 4_000_000_000


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real measurements; skips the test if it is absent."""
    root = Path(__file__).resolve().parents[1]
    folder = (root / os.environ.get("JAXPHOTO_DATA", "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(
            f"no real measurements in {folder}: set JAXPHOTO_DATA to the folder that holds sxb, camcal and aicon"
        )
    return folder


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--part K/N`: run the Kth of N parts of the slow tests, by name; each function with all its cases."""
    parser.addoption("--part", default="1/1", help="which part of the slow tests: K/N")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the quick tests and skip the other parts of the slow tests, before pytest selects by marks."""
    part, parts = map(int, config.getoption("--part").split("/"))
    if not 1 <= part <= parts:
        raise pytest.UsageError(f"--part is K/N with K from 1 to N, not {part}/{parts}")
    items[:] = [
        item
        for item in items
        if not item.get_closest_marker("slow") or crc32(item.nodeid.split("[")[0].encode()) % parts == part - 1
    ]
    chosen = {f"tests/{test}" for tests in QUICK.values() for test in tests}
    for item in items:
        # A module, a function or one case of it.
        names = item.nodeid.split("::")[0], item.nodeid.split("[")[0], item.nodeid
        if not item.get_closest_marker("slow") and not chosen.isdisjoint(names):
            item.add_marker(pytest.mark.quick)


def pytest_collection_finish() -> None:
    """Collect garbage rarely, and not among permanent objects: it took a quarter of the tracing time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 10, 10)


def _mappings() -> int:
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else 0


def _release() -> None:
    run._programs.clear()
    _layouts.clear()
    jax.clear_caches()
    gc.collect()


@pytest.fixture(scope="module", autouse=True)
def release_after_module():
    """Release compiled programs before a process runs out of memory or mappings; most are on disk."""
    yield
    memory = Path("/proc/self/statm")
    if _mappings() > _MOST_MAPPINGS or (memory.exists() and int(memory.read_text().split()[1]) * 4096 > _MOST_MEMORY):
        _release()


@pytest.fixture(autouse=True)
def release_after_test():
    """Release compiled programs within a module of very many."""
    yield
    if _mappings() > _MOST_WITHIN:
        _release()
