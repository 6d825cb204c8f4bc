"""Correlations of cameras with exterior orientations, and with the ground, as tables."""

from collections.abc import Mapping

import pandas as pd

from jaxphoto.report.findings import symbol
from jaxphoto.statistics import Correlations, GroundCorrelations
from jaxphoto.statistics.correlation import FORMS


def correlation_summary_table(correlations: Mapping[str, Correlations]) -> pd.DataFrame:
    """camera, exterior, interior, mean_abs_rho, max_abs_rho over the camera's images (paper 000, Table 4)."""
    rows = []
    for camera, c in correlations.items():
        if c.images and c.parameters:
            mean, largest = c.mean_abs, c.max_abs
            rows += [
                (camera, name, parameter, mean[i, j], largest[i, j])
                for i, name in enumerate(c.eop_names)
                for j, parameter in enumerate(c.parameters)
            ]
    return pd.DataFrame(rows, columns=["camera", "exterior", "interior", "mean_abs_rho", "max_abs_rho"])


def correlation_ground_table(correlations: Mapping[str, GroundCorrelations]) -> pd.DataFrame:
    """camera, ground (height, flying_height, dome), sigma_m, parameter, rho; a row each."""
    rows = []
    for camera, g in correlations.items():
        for k, form in enumerate(FORMS):
            own = zip((*g.parameters, "all"), (*g.rho[k], g.together[k]), strict=True)
            rows += [(camera, form, g.sigma_m[k], parameter, rho) for parameter, rho in own]
    return pd.DataFrame(rows, columns=["camera", "ground", "sigma_m", "parameter", "rho"])


def side_by_side(table: pd.DataFrame, rows: list[str], column: str, value: str) -> pd.DataFrame:
    """For a reader: the parameters of `column` beside one another, as text; a camera that is alone is not named."""
    names = table[column].map(lambda name: symbol(name).replace("_", ""))
    told = table.assign(**{column: names, value: table[value].map("{:.3f}".format)})
    wide = told.pivot_table(value, rows, column, aggfunc="first", sort=False).fillna("").reset_index()
    return wide if len(wide["camera"].unique()) > 1 else wide.drop(columns="camera")
