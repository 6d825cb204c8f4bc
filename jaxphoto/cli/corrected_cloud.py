"""Writing the corrected cloud of `strips` and `simultaneous`: every point of its file, those withheld, too."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Frame
from jaxphoto.cli.cloud_options import corrected_name
from jaxphoto.cloud import Cloud
from jaxphoto.errors import counted
from jaxphoto.georeferencing import Trajectory
from jaxphoto.io import clouds
from jaxphoto.lidar.coverage import CoveredTimes


def write_corrected(
    cloud: Path,
    folder: Path,
    corrected: Callable[[Cloud], Float[np.ndarray, "n 3"]],
    strips: Sequence[str],
    trajectory: Trajectory | None,
    frame: Frame | None,
    said: dict[str, Any],
) -> None:
    """Write `cloud` to `folder` as `corrected` says, which is given parts whose strips are numbered as in `strips`.

    Points withheld of other strips, or of times that the trajectory does not cover, stay where they were, with a
    UserWarning: a file may withhold them for that.
    """
    coverage = None if trajectory is None else CoveredTimes(trajectory)

    def moved(part: Cloud) -> Float[np.ndarray, "n 3"]:
        part = part.numbered(strips)
        if part.withheld is None or not part.withheld.any():
            return corrected(part)
        known = np.ones(len(part), bool) if part.strip is None else part.strip < len(strips)
        if coverage is not None and part.time is not None:
            known &= coverage.covers(part.time)
        own = np.flatnonzero(known | ~part.withheld)
        xyz = np.full(part.xyz.shape, np.nan)
        xyz[own] = corrected(part.take(own))
        return xyz

    stay = clouds.rewrite_cloud(cloud, folder / corrected_name(cloud), moved, frame=frame, **said)
    if stay:
        warnings.warn(
            f"{cloud.name}: {counted(stay, 'point')} marked as withheld cannot be corrected (of a strip that has no "
            "others, where the trajectory has no records, or out of reach of the system) and stay where they were",
            stacklevel=2,
        )
