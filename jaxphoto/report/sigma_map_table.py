"""The sigma map as a table."""

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd

from jaxphoto.camera import Sensor
from jaxphoto.statistics.sigma_map import SigmaMap

_NUMBERS = ["distance_m", "x_mm", "y_mm", "sigma_x_px", "sigma_y_px", "worst_px"]


def sigma_map_table(maps: Iterable[SigmaMap], sensors: Mapping[str, Sensor]) -> pd.DataFrame:
    """camera, distance_m (inf: a direction), x_mm, y_mm, sigma_x_px, sigma_y_px, worst_px; a row a cell."""
    frames = []
    for one in maps:
        in_mm = np.column_stack([np.sqrt(np.diagonal(one.covariance, axis1=1, axis2=2)), one.worst])
        sigma = in_mm / sensors[one.camera].pixel_mm
        rows = np.column_stack([np.full(len(sigma), one.distance_m), one.points, sigma])
        frames.append(pd.DataFrame(rows, columns=_NUMBERS).assign(camera=one.camera))
    none = pd.DataFrame({"camera": [], **dict.fromkeys(_NUMBERS, np.zeros(0))})
    return pd.concat(frames or [none], ignore_index=True)[["camera", *_NUMBERS]]
