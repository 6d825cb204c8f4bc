"""Positional accuracy as a table and as the sentences that are signed."""

import math

import pandas as pd

from jaxphoto.errors import counted
from jaxphoto.statistics import LEAST_CHECK_POINTS, ComponentAccuracy, PositionalAccuracy

STANDARD = "ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2 (2023)"


def accuracy_table(found: PositionalAccuracy) -> pd.DataFrame:
    """component, check_points, fit_m, survey_m, rmse_m (survey included), class_cm, claimed."""
    columns = ["component", "check_points", "fit_m", "survey_m", "rmse_m", "class_cm", "claimed"]
    rows = [(t.symbol, t.n, t.fit_m, t.survey_m, t.rmse_m, t.class_cm, t.claimed) for t in found.tested]
    return pd.DataFrame(rows, columns=columns)


def accuracy_sentences(found: PositionalAccuracy) -> list[str]:
    """What was tested, which class it is, and why it cannot be claimed where it cannot; none without check points."""
    if not found.tested:
        return []
    said = [f"Positional accuracy by the {STANDARD}; survey errors of the check points are included where known."]
    said += class_sentences(found)
    unknown = [t.name for t in found.tested if math.isnan(t.survey_m) and t.n >= LEAST_CHECK_POINTS]
    if unknown:
        said.append(
            f"The survey's standard deviations are not given for every check point ({', '.join(unknown)}): add them to "
            "control_points.csv, then the class can be claimed"
        )
    for axis in found.axes:
        if axis.biased:
            said.append(
                f"The mean error in {axis.axis}, {_cm(axis.mean_m)}, is more than a quarter of its RMSE "
                f"({_cm(axis.rmse_m)}): look for a shift, such as of a datum or of a geoid, before signing"
            )
    weak = [t.name for t in found.tested[:2] if t.survey_m > t.rmse_m / 2]
    if weak:
        said.append(
            f"The survey of the check points is not twice as accurate as what it tests ({', '.join(weak)}), as the "
            "standard asks: survey them better"
        )
    return said


def class_sentences(found: PositionalAccuracy) -> list[str]:
    """Which class each component is, and why it cannot be claimed where it cannot; horizontal first."""
    return [_sentence(t) for t in found.tested]


def _sentence(t: ComponentAccuracy) -> str:
    survey = "not known" if math.isnan(t.survey_m) else _cm(t.survey_m)
    measured = f"{t.symbol} = {_cm(t.rmse_m)} (block to check points {_cm(t.fit_m)}, survey {survey})"
    the_class = f"the {t.class_cm:g}-cm {t.symbol} {t.name} positional accuracy class"
    points = counted(t.n, "check point")
    if t.claimed:
        return f"Tested with {points} to meet {the_class}: {measured}."
    few = f"tested with {points} only, where the standard asks for {LEAST_CHECK_POINTS}"
    why = few if t.n < LEAST_CHECK_POINTS else f"tested with {points} whose survey errors are not all known"
    return f"Cannot be claimed: {why}: {measured}, which would be {the_class}."


def _cm(metres: float) -> str:
    return f"{100 * metres:.3g} cm"
