"""The interior orientations as a table."""

from collections.abc import Iterable

import numpy as np
import pandas as pd

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import constant_names, get_parameter, parameter_names, parameter_unit
from jaxphoto.statistics import Significance


def interior_table(adjusted: Adjustment, tested: Iterable[Significance]) -> pd.DataFrame:
    """camera, parameter, value, sigma, significant, unit; sigma and significant of what was `tested` alone."""
    tests = {(s.camera, s.parameter): s for s in tested}
    rows = []
    for camera, interior in adjusted.unknowns.interior.items():
        for name in (*parameter_names(interior), *constant_names(interior)):
            test = tests.get((camera, name))
            known = (test.sigma, test.significant) if test else (np.nan, None)
            rows.append((camera, name, float(get_parameter(interior, name)), *known, parameter_unit(interior, name)))
    return pd.DataFrame(rows, columns=["camera", "parameter", "value", "sigma", "significant", "unit"])
