"""Image points beside files that have no place for them: image_points.csv, as `jaxphoto convert` reads it with them.

Columns as in a block folder: image, point, column_px, row_px (the corner of the upper left pixel is (0, 0)) and
sigma_px.
"""

import csv
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs

FILE = "image_points.csv"
# What rounding makes of two equal numbers.
_SAME = 1e-12


def write_image_points(photographs: AdjustedPhotographs, folder: Path, names: Sequence[str] | None = None) -> None:
    """Write image_points.csv into `folder`; `names` are those that the file beside it has for photographs, those of
    their files where it is None.

    A UserWarning tells where standard deviations of x and y differ, of which there is one here.
    """
    p, named = photographs, names or photographs.files
    columns = {"image": np.array(named, object)[p.image], "point": np.array(p.points, object)[p.point]}
    columns |= {"column_px": p.column_row[:, 0], "row_px": p.column_row[:, 1]}
    if p.sigma_px is not None:
        x, y = p.sigma_px.T
        columns["sigma_px"] = np.sqrt((x**2 + y**2) / 2)
        if (np.abs(x - y) > _SAME * x).any():
            warnings.warn(
                f"{FILE} has one standard deviation for x and y, and those of the block differ: it is the root of the "
                "mean of their squares",
                UserWarning,
                stacklevel=3,
            )
    table = pd.DataFrame(columns)
    # A first name that starts with # is quoted, or its line would be a comment.
    quoting: Literal[0, 2] = csv.QUOTE_NONNUMERIC if any(n.startswith("#") for n in named) else csv.QUOTE_MINIMAL
    table.to_csv(folder / FILE, index=False, quoting=quoting)
