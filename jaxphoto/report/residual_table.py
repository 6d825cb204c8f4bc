"""The residuals of an adjustment as a table: a row for each number that was observed."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import Residuals
from jaxphoto.arrays import Numbers
from jaxphoto.observations import AbstractObservations
from jaxphoto.statistics import (
    MdbEffects,
    Redundancy,
    a_priori_sigmas,
    minimal_detectable_biases,
    observation_groups,
    physical_residuals,
)

_Of = Callable[[str, AbstractObservations], Any]


def in_file_unit(unit: str) -> tuple[float, str]:
    """What numbers are multiplied by to be shown, and the name of the unit they are shown in: degrees for rad."""
    return (180 / np.pi, "deg") if unit == "rad" else (1.0, unit)


def residual_table(adjusted: Adjustment, redundancy: Redundancy, w: Residuals, undetected: MdbEffects) -> pd.DataFrame:
    """group, image, point, axis, residual, sigma, unit, redundancy_number, w, detectable and what that moves.

    Names are categories: millions of observations have few of them, and texts would take ten times the memory. Each
    column is made by itself, as all of them side by side would be copied twice.
    """
    residual, sigma = physical_residuals(adjusted), a_priori_sigmas(adjusted)
    detectable = minimal_detectable_biases(adjusted, redundancy)
    block, s = adjusted.block, adjusted.structure
    labels = np.full(len(adjusted.values.shared), "", object)
    labels[s.free] = s.labels
    groups = {name: rows for name, rows in observation_groups(adjusted).items() if np.size(residual[name])}

    def column(of: _Of) -> np.ndarray:
        # Rows run along the last axis; the components of a row stand together.
        flat = (np.broadcast_to(of(g, rows), np.shape(residual[g])).T.ravel() for g, rows in groups.items())
        return np.concatenate(list(flat))

    def names(of: _Of) -> pd.Categorical:
        return pd.Categorical(column(lambda g, rows: np.asarray(of(g, rows), object)))

    def numbers(values: Mapping[str, Numbers]) -> np.ndarray:
        return column(lambda g, rows: values[g])

    def in_units(values: Mapping[str, Numbers]) -> np.ndarray:
        return column(lambda g, rows: in_file_unit(rows.unit)[0] * np.asarray(values[g]))

    def axis(group: str, rows: AbstractObservations) -> np.ndarray:
        own = rows.axis_names()
        return np.where(own == "", rows.names_of("parameter", labels), own)

    columns = {
        "group": names(lambda g, rows: g),
        "image": names(lambda g, rows: rows.names_of("image", block.images)),
        "point": names(lambda g, rows: rows.names_of("point", block.points)),
        "axis": names(axis),
        "residual": in_units(residual),
        "sigma": in_units(sigma),
        "unit": names(lambda g, rows: in_file_unit(rows.unit)[1]),
        "redundancy_number": numbers(redundancy.named),
        "w": numbers(w.named),
        "detectable": in_units(detectable),
        **{f"{p.removesuffix('_mm')}_moves": numbers(v) for p, v in undetected.interior.items()},
        "most_moves": numbers(undetected.most),
    }
    return pd.DataFrame(columns, copy=False)
