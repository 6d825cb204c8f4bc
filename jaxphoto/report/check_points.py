"""Check points: by how much surveyed and computed coordinates differ, and what their standard deviations allow."""

from typing import Any

import numpy as np
import pandas as pd

from jaxphoto.adjustment import Adjustment
from jaxphoto.observations import AXES
from jaxphoto.statistics import Covariance, check_discrepancies


def check_point_table(adjusted: Adjustment, known: Covariance) -> pd.DataFrame:
    """point; dX_m, dY_m, dZ_m, surveyed minus computed; sigma_dX_m, ... of survey and computed point together.

    Empty where an axis was not surveyed. A point that both are right of differs by sigma_d, root mean square.
    """
    rows = check_discrepancies(adjusted)
    points = list(dict.fromkeys(rows.who.tolist()))
    place = {p: k for k, p in enumerate(points)}
    at = [place[p] for p in rows.who.tolist()], rows.axis
    off, sigma = np.full((len(points), 3), np.nan), np.full((len(points), 3), np.nan)
    off[at] = rows.value
    sigma[at] = np.hypot(np.asarray(rows.sigma), np.asarray(known.point_sigma)[rows.who, rows.axis])
    columns: dict[str, Any] = {"point": [adjusted.block.points[p] for p in points]}
    columns |= {f"d{axis}_m": off[:, k] for k, axis in enumerate(AXES)}
    return pd.DataFrame(columns | {f"sigma_d{axis}_m": sigma[:, k] for k, axis in enumerate(AXES)})


def check_spread(check: pd.DataFrame) -> pd.DataFrame:
    """axis, n, mean, rmse, max_abs, unit of discrepancies at check points."""
    values = check[[f"d{axis}_m" for axis in AXES]].set_axis(AXES, axis=1)
    columns = {
        "n": values.count(),
        "mean": values.mean(),
        "rmse": np.sqrt((values**2).mean()),
        "max_abs": values.abs().max(),
    }
    return pd.DataFrame(columns).reset_index(names="axis").assign(unit="m")
