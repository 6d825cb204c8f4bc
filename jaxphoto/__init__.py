"""jaxphoto: differentiable photogrammetry on JAX.

Importing it switches JAX to float64 (docs/statistics.md) and, unless configured otherwise, enables JAX's compilation
cache on disk.
"""

import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

# SciPy's OpenBLAS, which JAX uses for LAPACK, spins threads that fight XLA's own pool (docs/solver.md).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)
# One JAX device per core: large blocks are sharded over them (docs/solver.md).
_chosen = "host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
if jax.config.values["jax_num_cpu_devices"] <= 0 and not _chosen:
    # If JAX is already initialised, its number of devices cannot be changed.
    with contextlib.suppress(RuntimeError):
        # Cores available to this process, where the system reports them (macOS and Windows do not).
        _cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        jax.config.update("jax_num_cpu_devices", _cores)
if jax.config.values["jax_compilation_cache_dir"] is None:
    _cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxphoto"
    jax.config.update("jax_compilation_cache_dir", str(_cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

from jaxphoto.adjustment import MAX_STEPS, Adjustment, Outcome, common_sizes
from jaxphoto.block import Block, Datum, Frame, Start
from jaxphoto.camera import (
    AbstractDistortion,
    AbstractProjection,
    InteriorOrientation,
    Sensor,
    conversion_error,
    decentring_from_symmetry,
    principal_points,
    rebalance,
    rebalance_covariance,
    symmetry_from_decentring,
)
from jaxphoto.camera.distortion import *  # noqa: F403 - all that are declared are public
from jaxphoto.camera.distortion import DISTORTIONS
from jaxphoto.camera.projection import *  # noqa: F403
from jaxphoto.camera.projection import PROJECTIONS
from jaxphoto.collinearity import ExteriorOrientation, image_ray, intersect, project
from jaxphoto.errors import BlockError, DatumError, InputError, JaxphotoError, RankError
from jaxphoto.georeferencing import Corrections, Exposure, Mount, StripBias, Surface, direct_orientation, ground_point
from jaxphoto.later import later
from jaxphoto.observations import (
    AbstractObservations,
    Attitudes,
    CameraPositions,
    ControlCoordinates,
    Distances,
    ImagePoints,
    KnownParameters,
    SurfaceRows,
    correlated,
    index_of,
)
from jaxphoto.parameters import AbstractParameters
from jaxphoto.unknowns import FIXED, FREE, Unknowns, Weighted, default_priors

if TYPE_CHECKING:
    from jaxphoto.extras.formats import convert, read_source
    from jaxphoto.io import read_block, read_recipe, write_block, write_simulation
    from jaxphoto.procedures.adjust import adjust
    from jaxphoto.procedures.boresight import boresight
    from jaxphoto.procedures.calibration import calibrate
    from jaxphoto.procedures.compare import compare, halves
    from jaxphoto.procedures.georeference import georeference
    from jaxphoto.procedures.lidar import simultaneous
    from jaxphoto.procedures.orientation import orient
    from jaxphoto.procedures.robust import robust
    from jaxphoto.procedures.snooping import snoop
    from jaxphoto.procedures.weights import estimate_weights
    from jaxphoto.report import Tables
    from jaxphoto.sensitivity import bias, monte_carlo, readjust
    from jaxphoto.simulation import simulate
    from jaxphoto.statistics import (
        Selection,
        angle_differences,
        covariance,
        point_differences,
        significance,
        variance_components,
    )
    from jaxphoto.statistics.sigma_map import sigma_map

__version__ = "0.1.0"

__all__ = [
    *(model.__name__ for model in (*DISTORTIONS.values(), *PROJECTIONS.values())),
    "FIXED", "FREE", "MAX_STEPS", "AbstractDistortion", "AbstractObservations", "AbstractParameters",
    "AbstractProjection", "Adjustment", "Attitudes", "Block", "BlockError", "CameraPositions",
    "ControlCoordinates", "Corrections", "Datum", "DatumError", "Distances", "Exposure", "ExteriorOrientation",
    "Frame", "ImagePoints", "InputError", "InteriorOrientation", "JaxphotoError", "KnownParameters", "Mount",
    "Outcome", "RankError", "Selection", "Sensor", "Start", "StripBias", "Surface", "SurfaceRows", "Tables",
    "Unknowns", "Weighted", "adjust", "angle_differences", "bias", "boresight", "calibrate", "common_sizes",
    "compare", "conversion_error", "convert", "correlated", "covariance", "decentring_from_symmetry",
    "default_priors", "direct_orientation", "estimate_weights", "georeference", "ground_point", "halves", "image_ray",
    "index_of", "intersect", "monte_carlo", "orient", "point_differences", "principal_points", "project", "read_block",
    "read_recipe", "read_source", "readjust", "rebalance", "rebalance_covariance", "robust", "sigma_map",
    "significance", "simulate", "simultaneous", "snoop", "symmetry_from_decentring", "variance_components",
    "write_block", "write_simulation",
]  # fmt: skip

# Files and tables require pandas, which takes 0.3 s to import.
__getattr__, __dir__ = later(__name__)
