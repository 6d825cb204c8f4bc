"""A simulation -> its block folder; beside the block's tables the truth, in the columns of the result tables."""

from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.camera import constant_names, get_parameter, parameter_names
from jaxphoto.io.block_folder import whole_block
from jaxphoto.io.block_folder.table_layout import ANGLES, XYZ
from jaxphoto.io.recipe.scan_files import drift_table, in_degrees, scanner_rows, write_scan
from jaxphoto.io.result_tables import read_table
from jaxphoto.observations import AXES
from jaxphoto.simulation import Simulation
from jaxphoto.simulation.flight import omega_phi_kappa
from jaxphoto.tracing import outside_transformations

FOLDER = "truth"
_SCANNER = "scanner"
_DRIFT = "trajectory_errors"


@outside_transformations
def write_simulation(simulation: Simulation, folder: str | Path) -> None:
    """Write the block as `write_block` does, with the truth in its sub-folder `truth` (docs/simulation.md).

    Of a lidar there are also `cloud.laz` and `trajectory.csv`. All of it takes its place in one step, and that of an
    older simulation goes. Raises what `write_block` raises.
    """
    with whole_block(simulation.block, folder) as work:
        (work / FOLDER).mkdir()
        for name, table in truth_tables(simulation).items():
            table.to_csv(work / FOLDER / f"{name}.csv", index=False)
        if simulation.cloud is not None and simulation.trajectory is not None:
            write_scan(simulation.cloud, simulation.trajectory, work)


def truth_tables(simulation: Simulation) -> dict[str, pd.DataFrame]:
    """The truth by name of the result table that it joins: interior, exterior, object_points, georeferencing.

    That of a scanner, which joins georeferencing too, is the table scanner; what its trajectory is off by, shift and
    drift, is trajectory_errors.
    """
    block, truth = simulation.block, simulation.truth
    interior = [
        (camera, name, float(get_parameter(one, name)))
        for camera, one in truth.interior.items()
        for name in (*parameter_names(one), *constant_names(one))
    ]
    angles = np.degrees(omega_phi_kappa(truth.exterior))
    tables = {
        "interior": pd.DataFrame(interior, columns=["camera", "parameter", "value"]),
        "exterior": _table("image", block.images, (*XYZ, *ANGLES), np.hstack([truth.exterior.position, angles])),
        "object_points": _table("point", block.points, XYZ, np.asarray(truth.points)),
        "georeferencing": pd.DataFrame(_georeferencing(simulation), columns=["parameter", "value"]),
    }
    errors = simulation.errors
    if truth.scanner is not None and errors is not None:
        tables[_SCANNER] = pd.DataFrame(scanner_rows(truth.scanner, errors), columns=["parameter", "value"])
        if np.ptp(errors.position, axis=0).any() or errors.attitude.any():
            tables[_DRIFT] = drift_table(errors, tuple(truth.scanner.shifts))
    return tables


def read_truth(folder: str | Path) -> dict[str, pd.DataFrame]:
    """The tables that `write_simulation` wrote beside a block; none where the block of `folder` was not simulated."""
    return {path.stem: read_table(path) for path in sorted((Path(folder) / FOLDER).glob("*.csv"))}


def _table(id_column: str, ids: tuple[str, ...], names: tuple[str, ...], values: np.ndarray) -> pd.DataFrame:
    table = pd.DataFrame(values, columns=list(names))
    table.insert(0, id_column, list(ids))
    return table


def _georeferencing(simulation: Simulation) -> list[tuple[str, float]]:
    rows = []
    for name, mount in simulation.truth.mounts.items():
        arm, boresight = np.asarray(mount.lever_arm), np.degrees(mount.boresight)
        rows += [
            (f"mounts[{name}].lever_arm_{axis}_m", v) for axis, v in zip(("right", "forward", "up"), arm, strict=True)
        ]
        rows += [(f"mounts[{name}].boresight_{axis}_deg", v) for axis, v in zip("xyz", boresight, strict=True)]
        rows.append((f"mounts[{name}].time_offset_s", float(mount.time_offset)))
    for name, bias in simulation.truth.strips.items():
        rows += [(f"strips[{name}].shift_{a}_m", v) for a, v in zip(AXES, np.asarray(bias.shift), strict=True)]
        rows += [(f"strips[{name}].drift_{a}_m_per_s", v) for a, v in zip(AXES, np.asarray(bias.drift), strict=True)]
    for owners in simulation.truth.more.values():
        for name, own in owners.items():
            rows += in_degrees(own, name)
    return rows + [(f"datum_offset_{a}_m", v) for a, v in zip(AXES, simulation.datum_offset_m, strict=True)]
