"""Write a simulation as a block folder with point cloud and trajectory, and its true values as result tables."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.camera import constant_names, get_parameter, parameter_names
from jaxphoto.georeferencing import Scanner, StripErrors
from jaxphoto.io import clouds
from jaxphoto.io.block_folder import whole_block
from jaxphoto.io.block_folder.table_layout import ANGLES, XYZ
from jaxphoto.io.result_tables import TRUTH
from jaxphoto.io.trajectory import records_of, write_flight_csv
from jaxphoto.observations import AXES
from jaxphoto.parameters import AbstractParameters, numbers_of
from jaxphoto.simulation import Simulation
from jaxphoto.simulation.flight import omega_phi_kappa
from jaxphoto.tracing import outside_transformations

CLOUD, TRAJECTORY = "cloud.laz", "trajectory.csv"
_SCANNER = "scanner"
_DRIFT = "trajectory_errors"


@outside_transformations
def write_simulation(simulation: Simulation, folder: str | Path) -> None:
    """Write the block, and the true values into its subfolder `truth` (docs/simulation.md).

    A lidar adds `cloud.laz` and `trajectory.csv`. Files are written atomically and replace an older simulation. Raises
    the errors of `write_block`.
    """
    with whole_block(simulation.block, folder) as work:
        (work / TRUTH).mkdir()
        for name, table in truth_tables(simulation).items():
            table.to_csv(work / TRUTH / f"{name}.csv", index=False)
        if simulation.cloud is not None and simulation.trajectory is not None:
            clouds.write_cloud(simulation.cloud, work / CLOUD)
            write_flight_csv(records_of(simulation.trajectory, TRAJECTORY), work / TRAJECTORY)


def truth_tables(simulation: Simulation) -> dict[str, pd.DataFrame]:
    """Return the true values by name of the result table: interior, exterior, object_points, georeferencing.

    With a scanner, the table scanner has its parameters, and trajectory_errors the shift and drift of its trajectory.
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
        tables[_SCANNER] = pd.DataFrame(_scanner_rows(truth.scanner, errors), columns=["parameter", "value"])
        if np.ptp(errors.position, axis=0).any() or errors.attitude.any():
            tables[_DRIFT] = _drift_table(errors, tuple(truth.scanner.shifts))
    return tables


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
            rows += _in_degrees(own, name)
    return rows + [(f"datum_offset_{a}_m", v) for a, v in zip(AXES, simulation.datum_offset_m, strict=True)]


def _scanner_rows(scanner: Scanner, errors: StripErrors) -> list[tuple[str, float]]:
    """Return (parameter, value) of the scanner, with the labels of result tables; omit zero calibration values."""
    angles = zip(("right", "forward", "up"), np.degrees(scanner.boresight), strict=True)
    rows = [(f"scanner.boresight_{axis}_deg", float(v)) for axis, v in angles]
    for name, shift in scanner.shifts.items():
        rows += [(f"scanner[{name}].shift_{a}_m", float(v)) for a, v in zip(AXES, np.asarray(shift), strict=True)]
    return rows + [(name, v) for name, v in _in_degrees(errors.calibration, "") if v]


def _in_degrees(parameters: AbstractParameters, owner: str) -> list[tuple[str, float]]:
    """Return (label, value) of declared parameters, angles in degrees."""
    pairs = zip(parameters.labels(owner), numbers_of(parameters), strict=True)
    return [(name.replace("_rad", "_deg"), float(np.degrees(v) if "_rad" in name else v)) for name, v in pairs]


def _drift_table(errors: StripErrors, strips: Sequence[str]) -> pd.DataFrame:
    """Return a table strip, time_s, X_m ... right_deg ...: trajectory errors at the knots of its splines."""
    of = np.repeat(np.array(strips, object), [s.size for s in errors.splines])
    time = np.concatenate([s.times for s in errors.splines])
    values = np.column_stack([errors.position, np.rad2deg(errors.attitude)])
    names = ("X_m", "Y_m", "Z_m", "right_deg", "forward_deg", "up_deg")
    return pd.DataFrame({"strip": of, "time_s": time} | {name: values[:, k] for k, name in enumerate(names)})
