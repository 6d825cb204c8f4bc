"""Surveyed points of a block after its adjustment: two tables, what is to be said, and the accuracy at check points."""

from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.errors import counted, few
from jaxphoto.procedures.control import ControlledBlock
from jaxphoto.procedures.control.control_block import CRITICAL
from jaxphoto.report.digits import of_sigma
from jaxphoto.report.findings import Finding, Level

_AXES = "XYZ"


def surveyed_points(found: ControlledBlock) -> pd.DataFrame:
    """point, role, state, n_marks, dX_m to dZ_m (surveyed minus adjusted), sigmas of both, w_X to w_Z."""
    columns: dict = {
        "point": found.ids,
        "role": np.where(found.check, "check", "control"),
        "state": found.state,
        "n_marks": found.n_marks,
    }
    columns |= {f"d{axis}_m": found.off_m[:, k] for k, axis in enumerate(_AXES)}
    columns |= {f"sigma_survey_{axis}_m": found.survey_sigma_m[:, k] for k, axis in enumerate(_AXES)}
    columns |= {f"sigma_adjusted_{axis}_m": found.sigma_m[:, k] for k, axis in enumerate(_AXES)}
    columns |= {f"w_{axis}": found.w[:, k] for k, axis in enumerate(_AXES)}
    return pd.DataFrame(columns)


def control_marks(found: ControlledBlock) -> pd.DataFrame:
    """image, point, column_px, row_px, sigma_px, d_column_px, d_row_px (measured minus computed), of those in use."""
    block, marks = found.adjusted.block, found.marks
    sensors = [block.sensors[block.image_camera[i]] for i in marks.image]
    pixel = np.array([s.pixel_mm for s in sensors])
    places = [s.px_from_mm(xy[None])[0] for s, xy in zip(sensors, marks.xy_mm, strict=True)]
    column_row = np.array(places).reshape(-1, 2)
    return pd.DataFrame(
        {
            "image": [block.images[i] for i in marks.image],
            "point": [found.ids[p] for p in marks.point],
            "column_px": column_row[:, 0],
            "row_px": column_row[:, 1],
            "sigma_px": marks.sigma_mm / pixel,
            "d_column_px": found.marks_px[:, 0],
            "d_row_px": found.marks_px[:, 1],
        }
    )


def rmse(found: ControlledBlock, state: str) -> np.ndarray:
    """Root mean squares of surveyed minus adjusted X, Y, Z (m) of the points in a state; NaN where there are none."""
    off = found.off_m[np.array(found.state, object) == state]
    n = np.isfinite(off).sum(axis=0)
    return np.where(n > 0, np.sqrt(np.nansum(off**2, axis=0) / np.maximum(n, 1)), np.nan)


def control_findings(found: ControlledBlock) -> list[Finding]:
    """What contradicts, and how far check points are off."""
    state = np.array(found.state, object)
    said = []
    left = [name for name, of in zip(found.ids, state, strict=True) if of == "left out"]
    if left:
        n = int((~found.check).sum())
        text = f"{len(left)} of {n} control points contradict the rest and are left out: {few(left)}"
        said.append(Finding(Level.WARNING, text))
    if (state == "check").any():
        told, n = ", ".join(of_sigma(v) or "-" for v in rmse(found, "check")), int((state == "check").sum())
        are = "is" if n == 1 else "are"
        text = f"{counted(n, 'check point')} {are} off by {told} m (root mean squares of X, Y, Z)"
        said.append(Finding(Level.INFORMATION, text))
        w = np.nan_to_num(found.w).max(axis=1)
        if beyond := [name for name, of, v in zip(found.ids, state, w, strict=True) if of == "check" and v > CRITICAL]:
            text = f"check points differ by more than {CRITICAL:g} standard deviations: {few(beyond)}"
            said.append(Finding(Level.WARNING, text))
    return said


def control_summary(found: ControlledBlock) -> dict:
    """The same for summary.json."""
    told = {}
    for state in ("control", "check"):
        told[state] = {
            "points": found.state.count(state),
            "rmse_m": [None if np.isnan(v) else float(v) for v in rmse(found, state)],
        }
    left = [name for name, of in zip(found.ids, found.state, strict=True) if of == "left out"]
    return {**told, "left_out": left, "marks": len(found.marks.image), "sentences": list(found.sentences)}


def write_control(found: ControlledBlock, folder: Path) -> None:
    """surveyed_points.csv and control_marks.csv."""
    surveyed_points(found).to_csv(folder / "surveyed_points.csv", index=False)
    control_marks(found).to_csv(folder / "control_marks.csv", index=False)
