"""What cameras changed by in flight, as a table."""

from collections.abc import Iterable

import pandas as pd

from jaxphoto.camera import CameraRates
from jaxphoto.parameters import unit_of
from jaxphoto.statistics import CameraDrift


def camera_drift_table(drifts: Iterable[CameraDrift]) -> pd.DataFrame:
    """camera, parameter, hours, change, sigma, p_value, detectable, unit; a row an estimated rate."""
    columns = ["camera", "parameter", "hours", "change", "sigma", "p_value", "detectable", "unit"]
    rates = [name for (name,) in CameraRates.names.values()]
    units = {name.split("_")[0]: unit_of(name).removesuffix("per_h").removesuffix("_") for name in rates}
    rows = [
        (d.camera, name, d.hours, *numbers, units[name])
        for d in drifts
        for name, *numbers in zip(d.parameters, *d.change[:4], strict=True)
    ]
    return pd.DataFrame(rows, columns=columns)
