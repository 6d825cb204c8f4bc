"""Surveyed points of a block after adjustment: tables, findings, and the accuracy at check points."""

from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.errors import few
from jaxphoto.observations import AXES
from jaxphoto.procedures.control import ControlledBlock
from jaxphoto.procedures.control.control_block import CRITICAL
from jaxphoto.report.findings import Finding
from jaxphoto.report.formatting import of_sigma


def surveyed_points(control: ControlledBlock) -> pd.DataFrame:
    """point, role, state, n_marks, dX_m to dZ_m (surveyed minus adjusted), sigmas of both, w_X to w_Z."""
    roles = np.where(control.check, "check", "control")
    columns: dict = {"point": control.ids, "role": roles, "state": control.state, "n_marks": control.n_marks}
    for pattern, values in (
        ("d{}_m", control.off_m), ("sigma_survey_{}_m", control.survey_sigma_m),
        ("sigma_adjusted_{}_m", control.sigma_m), ("w_{}", control.w),
    ):  # fmt: skip
        columns |= {pattern.format(axis): values[:, k] for k, axis in enumerate(AXES)}
    return pd.DataFrame(columns)


def control_marks(control: ControlledBlock) -> pd.DataFrame:
    """image, point, column_px, row_px, sigma_px, d_column_px, d_row_px (measured minus computed) of used marks."""
    block, marks = control.adjusted.block, control.marks
    sensors = [block.sensors[block.image_camera[i]] for i in marks.image]
    places = [s.px_from_mm(xy[None])[0] for s, xy in zip(sensors, marks.xy_mm, strict=True)]
    column_row = np.array(places).reshape(-1, 2)
    columns = {
        "image": [block.images[i] for i in marks.image],
        "point": [control.ids[p] for p in marks.point],
        "column_px": column_row[:, 0],
        "row_px": column_row[:, 1],
        "sigma_px": marks.sigma_mm / np.array([s.pixel_mm for s in sensors]),
        "d_column_px": control.marks_px[:, 0],
        "d_row_px": control.marks_px[:, 1],
    }
    return pd.DataFrame(columns)


def rmse(control: ControlledBlock, state: str) -> np.ndarray:
    """RMS of surveyed minus adjusted X, Y, Z (m) of the points in a state; NaN if there are none."""
    discrepancy = control.off_m[np.array(control.state, object) == state]
    n = np.isfinite(discrepancy).sum(axis=0)
    return np.where(n > 0, np.sqrt(np.nansum(discrepancy**2, axis=0) / np.maximum(n, 1)), np.nan)


def control_findings(control: ControlledBlock) -> list[Finding]:
    """Rejected control points, RMSE and outliers of check points."""
    found, check = [], [k for k, state in enumerate(control.state) if state == "check"]
    rejected = [name for name, state in zip(control.ids, control.state, strict=True) if state == "left out"]
    if rejected:
        n = int((~control.check).sum())
        found.append(Finding("control_rejected", "warning", few(rejected), len(rejected), numbers={"n": n}))
    if check:
        sizes = ", ".join(of_sigma(v) or "-" for v in rmse(control, "check"))
        found.append(Finding("check_points", "note", sizes, len(check)))
        w = np.nan_to_num(control.w).max(axis=1)
        if beyond := [control.ids[k] for k in check if w[k] > CRITICAL]:
            found.append(Finding("check_points_far", "warning", few(beyond), len(beyond), CRITICAL))
    return found


def control_summary(control: ControlledBlock) -> dict:
    """The same for summary.json."""
    rejected = [name for name, state in zip(control.ids, control.state, strict=True) if state == "left out"]
    states = {
        state: {
            "points": control.state.count(state),
            "rmse_m": [None if np.isnan(v) else float(v) for v in rmse(control, state)],
        }
        for state in ("control", "check")
    }
    return {**states, "left_out": rejected, "marks": len(control.marks.image), "sentences": list(control.sentences)}


def write_control(control: ControlledBlock, folder: Path) -> None:
    """Write surveyed_points.csv and control_marks.csv."""
    surveyed_points(control).to_csv(folder / "surveyed_points.csv", index=False)
    control_marks(control).to_csv(folder / "control_marks.csv", index=False)
