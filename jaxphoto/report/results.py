"""The result folder of an adjustment, written whole or not at all."""

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import RATES, model_keys, sensor_keys
from jaxphoto.compiling.freed_memory import return_freed_memory
from jaxphoto.errors import InputError
from jaxphoto.report.check_points import check_spread
from jaxphoto.report.findings import Verdict
from jaxphoto.report.made import Made, versions
from jaxphoto.report.page import report_page
from jaxphoto.report.positional_accuracy import accuracy_sentences
from jaxphoto.report.table_files import check_table_format, write_table
from jaxphoto.report.tables import Tables
from jaxphoto.statistics import LEVEL, global_test
from jaxphoto.writing import whole_folder

_TABLES = (
    "interior",
    "exterior",
    "object_points",
    "residuals",
    "trends",
    "check_points",
    "positional_accuracy",
    "correlation",
    "correlation_summary",
    "correlation_ground",
    "sigma_map",
    "convergence",
)
# Written beside them where the files of the block were in an EPSG system.
_MAP_TABLES = ("exterior_map", "object_points_map")


def write_results(
    tables: Tables,
    verdict: Verdict,
    directory: Path,
    seconds: dict[str, float],
    told: Mapping[str, Any] = MappingProxyType({}),
    made: Made | None = None,
) -> None:
    """Write the files of docs/block_folder.md into `directory`, replacing earlier results only when all is written.

    `seconds` (read, compile, solve, covariance) goes into summary.json with the time of writing, and so does what is
    `told` of how the results came about; the report says how they were `made`. Raises what `whole_folder` raises.
    """
    began = time.perf_counter()
    with whole_folder(directory) as work:
        for name in table_names(tables):
            getattr(tables, name).to_csv(work / f"{name}.csv", index=False)
            # A table of millions of rows leaves hundreds of MB behind.
            return_freed_memory()
        (work / "report.html").write_text(report_page(tables, verdict, made), encoding="utf-8")
        summary = summary_of(tables, verdict, seconds | {"write": time.perf_counter() - began})
        write_summary(summary | dict(told), work)


def table_names(tables: Tables) -> tuple[str, ...]:
    """What the result folder of an adjustment has tables of."""
    in_map = tables.adjusted.block.frame.kind == "epsg"
    changing = any(rates.kind in tables.adjusted.unknowns.more for rates in RATES)
    return (
        *_TABLES,
        *(("camera_drift",) if changing else ()),
        *(_MAP_TABLES if in_map else ()),
        *(("recovery",) if tables.truth else ()),
    )


def write_tables(tables: Tables, directory: str | Path, kind: str = "csv", names: Sequence[str] = ()) -> None:
    """Write the tables of an adjustment, or those of `names`, as csv, parquet, markdown or latex into a folder.

    Raises InputError for a format or a table that there is not, and what `whole_folder` raises.
    """
    check_table_format(kind)
    known = table_names(tables)
    if missing := [name for name in names if name not in known]:
        raise InputError(f"there is no table {missing[0]}; there are {', '.join(known)}")
    with whole_folder(Path(directory)) as work:
        for name in names or known:
            write_table(getattr(tables, name), name, work, kind)


def write_summary(summary: dict, directory: Path) -> None:
    """summary.json."""
    (directory / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def summary_of(tables: Tables, verdict: Verdict, seconds: dict[str, float]) -> dict:
    """What summary.json says."""
    adjusted = tables.adjusted
    observations, unknowns = adjusted.n_observations, adjusted.n_unknowns
    return {
        "title": adjusted.block.title,
        **verdict.summary,
        "converged": bool(adjusted.converged),
        "outcome": adjusted.outcome.value,
        "n_images": len(adjusted.block.images),
        "sigma0": float(adjusted.sigma0),
        **_tested(tables),
        **({"doubts": told} if (told := adjusted.block.doubts) else {}),
        "redundancy": adjusted.redundancy,
        "n_observations": {"total": sum(observations.values()), **observations},
        "n_constraints": adjusted.n_constraints,
        "n_unknowns": {"total": sum(unknowns.values()), **unknowns},
        "iterations": int(adjusted.steps),
        "cameras": _cameras(adjusted),
        "georeferencing": {p: {"value": v, "sigma": s} for p, v, s in tables.georeferencing.itertuples(index=False)},
        "check_points": {
            axis: {"n": int(n), "mean_m": mean, "rmse_m": rmse, "max_abs_m": most}
            for axis, n, mean, rmse, most, _ in check_spread(tables.check_points).itertuples(index=False)
            if n
        },
        "positional_accuracy": accuracy_sentences(tables.tested_accuracy),
        "seconds": {name: round(value, 6) for name, value in seconds.items()},
        "versions": versions(),
    }


def _tested(tables: Tables) -> dict:
    """The test of sigma naught, where there is an optimum and anything checks it."""
    if not bool(tables.adjusted.converged) or tables.adjusted.redundancy <= 0:
        return {}
    test = global_test(tables.adjusted, tables.redundancy)
    told = {"expected_sigma0": test.expected**0.5, "p_value": test.p_value, "passed": test.p_value >= LEVEL}
    return {"global_test": told}


def _cameras(adjusted: Adjustment) -> dict:
    """Sensor and models of every camera, by which interior.csv can be read."""
    told = {}
    for name, interior in adjusted.unknowns.interior.items():
        told[name] = sensor_keys(adjusted.block.sensors[name]) | model_keys(interior)
    return told
