"""jaxphoto: differentiable photogrammetry on JAX.

Importing it switches JAX to float64 (docs/precision.md) and, unless you chose otherwise, keeps compiled code in a
cache on disk.
"""

import contextlib
import importlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

# SciPy's OpenBLAS, which JAX uses for LAPACK, spins threads that fight XLA's own pool (docs/solver.md).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)
# One device of JAX a core: large blocks are dealt out to them (docs/scaling.md).
_chosen = "host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
if jax.config.values["jax_num_cpu_devices"] <= 0 and not _chosen:
    # Too late where JAX has begun to compute: then its devices stay what they are.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))
if jax.config.values["jax_compilation_cache_dir"] is None:
    _cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxphoto"
    jax.config.update("jax_compilation_cache_dir", str(_cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

from jaxphoto.adjustment import MAX_STEPS, Adjustment, Outcome, common_sizes
from jaxphoto.block import Block
from jaxphoto.camera import (
    AbstractDistortion,
    AffineBrown,
    Balanced,
    Brown,
    Brown14,
    BundlerRadial,
    Ebner,
    Gruen,
    InteriorOrientation,
    PpsRadial,
    RadialPolynomial,
    Sensor,
    Smac,
    conversion_error,
    decentring_from_symmetry,
    principal_points,
    rebalance,
    rebalance_covariance,
    symmetry_from_decentring,
)
from jaxphoto.collinearity import ExteriorOrientation, image_ray, intersect, project
from jaxphoto.errors import BlockError, DatumError, InputError, JaxphotoError, RankError
from jaxphoto.georeferencing import Mount, StripBias, Surface, direct_orientation, ground_point
from jaxphoto.procedures import adjust, boresight, georeference
from jaxphoto.simulation import simulate
from jaxphoto.statistics import angle_differences, covariance, point_differences
from jaxphoto.unknowns import FIXED, FREE, Unknowns, Weighted

if TYPE_CHECKING:
    from jaxphoto.io import convert, read_block, read_recipe, read_source, write_block, write_simulation
    from jaxphoto.report import Tables
    from jaxphoto.sensitivity import bias, monte_carlo, readjust

__version__ = "0.1.0"

__all__ = [
    "FIXED", "FREE", "MAX_STEPS", "AbstractDistortion", "Adjustment", "AffineBrown", "Balanced", "Block",
    "BlockError", "Brown", "Brown14", "BundlerRadial", "DatumError", "Ebner", "ExteriorOrientation", "Gruen",
    "InputError", "InteriorOrientation", "JaxphotoError", "Mount", "Outcome", "PpsRadial", "RadialPolynomial",
    "RankError", "Sensor", "Smac", "StripBias", "Surface", "Tables", "Unknowns", "Weighted", "adjust",
    "angle_differences", "bias", "boresight", "common_sizes", "conversion_error", "convert", "covariance",
    "decentring_from_symmetry", "direct_orientation", "georeference", "ground_point", "image_ray", "intersect",
    "monte_carlo", "point_differences", "principal_points", "project", "read_block", "read_recipe",
    "read_source", "readjust", "rebalance", "rebalance_covariance", "simulate", "symmetry_from_decentring",
    "write_block", "write_simulation",
]  # fmt: skip

# Files and tables bring pandas and more, a third of a second, and studies are not for every day: they are imported when
# first asked for.
_LATER = {
    "convert": "io", "read_block": "io", "read_recipe": "io", "read_source": "io", "write_block": "io",
    "write_simulation": "io", "Tables": "report", "bias": "sensitivity", "monte_carlo": "sensitivity",
    "readjust": "sensitivity",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _LATER.values():
        return importlib.import_module(f"jaxphoto.{name}")
    if name in _LATER:
        return getattr(importlib.import_module(f"jaxphoto.{_LATER[name]}"), name)
    raise AttributeError(f"module 'jaxphoto' has no attribute {name!r}")
