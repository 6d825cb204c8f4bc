"""The solvers we are measured against: what they are called with, and what they say in the same words.

Each solves in a process of its own. Those of Python come from PyPI (`scipy_peer`, `pyceres_peer`); those of C++ are
binaries that the user gives, see README.md.
"""

import importlib.util
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from machine import run_apart, run_here

CERES, BY_HAND = "Ceres", "C++ by hand"
"""How the names of the two begin that ratios are given to."""


class Files(NamedTuple):
    """A problem as each kind of peer reads it; `size` is its number of unknowns."""

    size: int
    npz: Path | None = None
    flat: Path | None = None
    bal: Path | None = None


class Peers(NamedTuple):
    """Solvers by name, each a function that solves once; and what is to be said of those that are missing."""

    solvers: dict[str, Callable[[], dict]]
    missing: list[str]


# Unknowns up to which a peer takes no longer than some ten seconds.
_MOST = {"pyceres": 5_000, "scipy": 100_000}
# Below this, reduced matrices are dense, and Ceres' own covariance takes a moment instead of minutes.
_SMALL = 5_000


def peers_of(files: Files, arguments) -> Peers:
    """The peers that can solve the problem in `files`; `arguments` are those of `run`."""
    solvers: dict[str, Callable[[], dict]] = {}
    missing, cores = [], arguments.cores
    if files.bal:
        if arguments.ceres_bal:
            solvers["ceres"] = partial(run_ceres_bal, arguments.ceres_bal, files, cores)
        return Peers(solvers, [] if solvers else ["Ceres is left out: name its binary for BAL files by --ceres-bal"])
    if arguments.ceres:
        solvers["ceres"] = partial(run_ceres, arguments.ceres, files, cores)
        solvers["by hand"] = partial(run_by_hand, arguments.ceres, files, cores)
    else:
        missing.append("C++ is left out: name a binary by --ceres, as README.md says")
    for name in ("pyceres", "scipy"):
        if name in arguments.without:
            continue
        if files.size > _MOST[name] and name not in arguments.also:
            missing.append(f"{name} is left out: it takes minutes for a block of this size; --also {name} runs it")
        elif importlib.util.find_spec(name) is None:
            missing.append(f"{name} is left out, as it is not installed: pip install {name}")
        else:
            solvers[name] = partial(_run_python, f"{name}_peer.py", files, cores)
    return Peers(solvers, missing)


def run_ceres(binary: Path, files: Files, cores: int | None) -> dict:
    """Ceres from the start values, to 1e-8 of the optimum; its own covariance where that ends."""
    if files.size <= _SMALL:
        settings = ["--solver", "dense_schur", "--cov", "ceres_full"]
    else:
        settings = ["--solver", "sparse_schur", "--gcp-in-f", "1"]
    settings += ["--radius", "1e8", "--ftol", "1e-8", "--threads", str(cores or 1)]
    return _of_ceres(run_apart([str(binary), str(files.flat), *settings], cores))


def run_by_hand(binary: Path, files: Files, cores: int | None) -> dict:
    """Gauss-Newton written by hand for this problem alone: points eliminated, LAPACK for the rest, no damping.

    It stops after the step that promised less than 1e-5 of the cost, which ends below 1e-12 of the optimum.
    """
    settings = ["--solver", "hand_gn", "--ftol", "1e-5", "--cov", "schur"]
    return _of_ceres(run_apart([str(binary), str(files.flat), *settings], cores)) | {"solver": BY_HAND}


def run_ceres_bal(binary: Path, files: Files, cores: int | None) -> dict:
    """Ceres on a BAL file; it gives no covariance, as the datum of such a problem is open."""
    settings = ["--solver", "dense_schur", "--ftol", "1e-8", "--threads", str(cores or 1)]
    return _of_ceres(run_apart([str(binary), str(files.bal), *settings], cores))


def _run_python(script: str, files: Files, cores: int | None) -> dict:
    return run_here(script, files.npz, cores=cores)[0]


def _of_ceres(lines: list[dict]) -> dict:
    solve, *rest = lines
    return {
        "solver": f"{CERES} {solve['ceres']} {solve['solver']}",
        "solve_s": solve["t_solve"],
        "steps": solve["iters"],
        "cost": solve["cost"],
        "memory_mb": lines[-1]["rss_mb"],
        "covariance_s": rest[0]["t"] if rest else None,
    }
