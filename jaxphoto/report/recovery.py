"""What an adjustment found beside the truth of a simulation: errors in units of their standard deviations.

Where the model is right, (estimate - truth) / sigma is a standard normal variable, but for the datum: a block in a free
network, or one whose truth has a datum offset that the model does not know, is off as a whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from jaxphoto.report.units import label_unit

if TYPE_CHECKING:
    from jaxphoto.report.tables import Tables

# The result tables that hold one number a column: the column of names, and what labels of their numbers begin with.
_WIDE = {"exterior": ("image", "exterior"), "object_points": ("point", "points")}
_COLUMNS = ("parameter", "estimate", "truth", "sigma")


def recovery_table(tables: Tables, truth: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """parameter, estimate, truth, error (estimate - truth), sigma, ratio (error / sigma), unit, of all that was
    estimated.

    `truth` are the tables of `jaxphoto.io.truth_tables(simulation)`, which are in the folder `truth` of a simulated
    block: columns as the result tables have them. What one side does not have is left out.
    """
    found = [_named(getattr(tables, name), truth.get(name)) for name in ("interior", "georeferencing")]
    for name, (who, prefix) in _WIDE.items():
        if name in truth:
            found.append(_wide(getattr(tables, name), truth[name], who, prefix))
    rows = pd.concat([f for f in found if len(f)] or [_NONE], ignore_index=True)
    rows = rows[rows["sigma"] > 0].reset_index(drop=True)
    error = rows["estimate"] - rows["truth"]
    turns = rows["parameter"].str.endswith("_deg")
    error = error.where(~turns, (error + 180) % 360 - 180)
    cameras = tables.adjusted.unknowns.interior
    units = [label_unit(label, cameras) for label in rows["parameter"]]
    return rows.assign(error=error, ratio=error / rows["sigma"], unit=np.array(units, object))[
        ["parameter", "estimate", "truth", "error", "sigma", "ratio", "unit"]
    ]


def recovery_spread(recovery: pd.DataFrame) -> pd.DataFrame:
    """group, n, rms_ratio, beyond_2_sigma, of a `recovery_table`: about 1, and about 5 % where the model is right.

    Groups are the cameras, mounts and strips one by one, and each coordinate and angle of all images and of all points.
    """
    label = recovery["parameter"]
    many = label.str.extract(r"^(exterior|points)\[.*\]\.(.+)$")
    group = (many[0] + " " + many[1]).fillna(label.str.replace(r"\]\..*$", "]", regex=True))
    grouped = recovery["ratio"].groupby(group, sort=False)
    return pd.DataFrame(
        {
            "n": grouped.size(),
            "rms_ratio": np.sqrt(grouped.apply(lambda r: float(np.mean(np.square(r))))),
            "beyond_2_sigma": grouped.apply(lambda r: float(np.mean(np.abs(r) > 2))),
        }
    ).reset_index(names="group")


_NONE = pd.DataFrame({c: pd.Series([], dtype=str if c == "parameter" else float) for c in _COLUMNS})


def _named(own: pd.DataFrame, truth: pd.DataFrame | None) -> pd.DataFrame:
    """Tables of one number a row: of cameras, or of mounts, strips and the like."""
    if truth is None:
        return _NONE
    keys = [c for c in ("camera", "parameter") if c in own and c in truth]
    both = own.merge(truth, on=keys, suffixes=("", "_true"))
    label = both["parameter"]
    if "camera" in both:
        label = "interior[" + both["camera"].astype(str) + "]." + label
    columns = {"parameter": label, "estimate": both["value"], "truth": both["value_true"], "sigma": both["sigma"]}
    return pd.DataFrame(columns)


def _wide(own: pd.DataFrame, truth: pd.DataFrame, who: str, prefix: str) -> pd.DataFrame:
    """Tables of a row an image or a point."""
    names = [c for c in truth.columns if c != who]
    both = own.assign(**{who: own[who].astype(str)}).merge(
        truth.assign(**{who: truth[who].astype(str)}), on=who, suffixes=("", "_true")
    )
    label = np.array([f"{prefix}[{one}].{name}" for one in both[who] for name in names], object)
    numbers = {
        key: both[[pattern.format(n) for n in names]].to_numpy(float).ravel()
        for key, pattern in (("estimate", "{}"), ("truth", "{}_true"), ("sigma", "sigma_{}"))
    }
    return pd.DataFrame({"parameter": label, **numbers})
