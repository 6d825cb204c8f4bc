"""Fixtures for all tests."""

import gc
import os
import subprocess
import sys
from pathlib import Path
from zlib import crc32

import pytest


def known_flags(*flags: str) -> str:
    """Those of `flags` that this jaxlib knows: XLA ends a process that is given another, so a process is asked."""
    ask = "import jax; jax.devices()"

    def started(value: str) -> bool:
        asked = [sys.executable, "-c", ask]
        return not subprocess.run(asked, env=os.environ | {"XLA_FLAGS": value}, capture_output=True).returncode

    return " ".join(flags if started(" ".join(flags)) else filter(started, flags))


# As `jaxphoto` does where it is imported first; here NumPy's OpenBLAS is loaded before, by JAX.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# What costs here is compiling: least optimisation takes half the time and less, and changes results by rounding only.
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = known_flags(
        "--xla_backend_optimization_level=0",
        "--xla_cpu_use_fusion_emitters=false",
        "--xla_cpu_parallel_codegen_split_count=1",
    )
# What one process compiles serves the others and the next run: the smallest programs too, of which there are thousands.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR",
    str(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxphoto" / "tests"),
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

import jax  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

from tests.checked_types import check_types  # noqa: E402
from tests.marks import QUICK  # noqa: E402

check_types()
# Of a machine that does other work, too.
settings.register_profile("patient", suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

from jaxphoto.adjustment.adjust import _layouts  # noqa: E402
from jaxphoto.compiling import run, store  # noqa: E402

# The suite's programs are hundreds, of 2 MB: with a user's room each would be gone before another process needs it.
store.MOST = 2_000_000_000
# Of the 65,530 mappings of memory that Linux gives a process; XLA crashes where it finds none. A large program takes
# some three hundred, a module of tests up to 43,000 (test_declared on jax 0.12). After a module, and after a test.
_MOST_MAPPINGS, _MOST_WITHIN = 30_000, 50_000
# Bytes in memory, of pages of 4 kB: two processes and what they start must fit into 16 GB.
_MOST_MEMORY = 4_000_000_000


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real measurements; a test that needs it is skipped where it is absent."""
    root = Path(__file__).resolve().parents[1]
    folder = (root / os.environ.get("JAXPHOTO_DATA", "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(
            f"no real measurements in {folder}: set JAXPHOTO_DATA to the folder that holds sxb, camcal and aicon"
        )
    return folder


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--part K/N`: of the slow tests the Kth of N parts, by their names; each function with all its cases."""
    parser.addoption("--part", default="1/1", help="which part of the slow tests: K/N")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what `-m quick` runs, and leave out other parts of the slow tests, before pytest chooses by marks."""
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
    """Look for garbage seldom, and not in what is there to stay: it took a quarter of the time that tracing takes."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 10, 10)


def _mappings() -> int:
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else 0


def _let_go() -> None:
    run._programs.clear()
    _layouts.clear()
    jax.clear_caches()
    gc.collect()


@pytest.fixture(scope="module", autouse=True)
def programs_let_go():
    """Let JAX's compiled programs go before a process runs out of memory or of mappings; most are on disk."""
    yield
    memory = Path("/proc/self/statm")
    if _mappings() > _MOST_MAPPINGS or (memory.exists() and int(memory.read_text().split()[1]) * 4096 > _MOST_MEMORY):
        _let_go()


@pytest.fixture(autouse=True)
def mappings_left():
    """The same within a module that takes very many."""
    yield
    if _mappings() > _MOST_WITHIN:
        _let_go()
