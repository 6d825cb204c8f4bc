"""What cameras changed by in flight, as a table."""

from collections.abc import Iterable

import pandas as pd

from jaxphoto.camera import RATES
from jaxphoto.parameters import unit_of
from jaxphoto.statistics import CameraDrift


def camera_drift_table(drifts: Iterable[CameraDrift]) -> pd.DataFrame:
    """camera, along, span, parameter, change, sigma, p_value, detectable, unit; a row an estimated rate.

    `span` is in the unit that ends `along`.
    """
    columns = ["camera", "along", "span", "parameter", "change", "sigma", "p_value", "detectable", "unit"]
    units = {
        name.split("_")[0]: unit_of(name).rpartition("per_")[0].removesuffix("_")
        for rates in RATES
        for (name,) in rates.names.values()
    }
    rows = [
        (d.camera, d.rates.along, d.span, name, *numbers, units[name])
        for d in drifts
        for name, *numbers in zip(d.parameters, *d.change[:4], strict=True)
    ]
    return pd.DataFrame(rows, columns=columns)
