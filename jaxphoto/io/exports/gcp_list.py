"""Control of adjusted photographs -> gcp_list.txt of OpenSfM, OpenDroneMap and WebODM.

Rows and pixels as `jaxphoto.io.control_files.gcp_list`; heights are above the ellipsoid, as OpenSfM takes them. All of
its points are control: check points stay away.
"""

import warnings
from pathlib import Path

import numpy as np

from jaxphoto.io.control_files.gcp_list import FIRST_PX
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs

FILE = "gcp_list.txt"


def write_gcp_list(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write gcp_list.txt into `folder` where the block has control; a UserWarning says what it cannot have."""
    p, control = photographs, photographs.control
    if control is None or not len(control.point):
        return
    chosen = np.flatnonzero(~control.check & ~np.isnan(control.xyz[:, :2]).any(axis=1))
    names = [*p.files, *(p.points[j] for j in control.point[chosen])]
    if p.frame.kind != "epsg":
        return _tell("is not written, because it needs a map system and the block is in a local frame")
    if blank := next((name for name in names if len(name.split()) != 1), None):
        return _tell(f"is not written, because it ends names at blanks and {blank!r} has one; rename it")
    if left := len(control.point) - len(chosen):
        _tell(f"is without {left} check points or points without X and Y, which it cannot have")
    coordinates, rows = control.on_map(p.frame, p.xyz, ellipsoidal=True), p.rows_of_points
    lines = [f"EPSG:{p.frame.code}"]
    for k in chosen.tolist():
        point = int(control.point[k])
        for row in rows[point].tolist():
            values = map(repr, [*coordinates[k].tolist(), *(p.column_row[row] - FIRST_PX).tolist()])
            lines.append("\t".join([*values, p.files[p.image[row]], p.points[point]]))
    (folder / FILE).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _tell(what: str) -> None:
    warnings.warn(f"{FILE} {what}", UserWarning, stacklevel=5)
