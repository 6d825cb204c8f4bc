"""Fixtures for all tests."""

import gc
import os
from pathlib import Path

import jax
import pytest

# What costs here is compiling: these halve it and more, and change results by rounding only (measured on jax 0.10.2).
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false")


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


@pytest.fixture(scope="module", autouse=True)
def programs_let_go():
    """Let JAX's compiled programs go in time: each takes mappings of memory, and a process has 65,530 of them."""
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > 15_000:
        jax.clear_caches()
        gc.collect()
