"""How an adjustment converged, step by step, as a table."""

import numpy as np
import pandas as pd

from jaxphoto.adjustment import Adjustment


def convergence_table(adjusted: Adjustment) -> pd.DataFrame:
    """step, sigma0 before it, length (standard deviations), damping, bent, taken (yes, no); no rows if none is known.

    `length` bounds by how many of its standard deviations any unknown moved. `bent` is the fraction of the step that
    was tried along its curve (geodesic acceleration), empty for a straight step. The last row is where it ended.
    """
    course, redundancy = adjusted.course, max(adjusted.redundancy, 1)
    if course is None:
        return pd.DataFrame(columns=["step", "sigma0", "length", "damping", "bent", "taken"])
    n = len(course.length)
    # Of a very long iteration the first steps are kept; the end is known in any case.
    end = n == int(adjusted.steps)
    sums = np.append(course.square_sum, float(adjusted.square_sum)) if end else course.square_sum
    table = pd.DataFrame({"step": np.arange(1, len(sums) + 1), "sigma0": np.sqrt(sums / redundancy)})
    table["length"], table["damping"] = pd.Series(course.length), pd.Series(course.damping)
    table["bent"] = pd.Series(np.where(course.bent > 0, course.bent, np.nan))
    table["taken"] = pd.Series(np.where(course.accepted > 0, "yes", "no"))
    return table.assign(step=[*map(str, range(1, n + 1)), *(["end"] if end else [])], taken=table["taken"].fillna(""))
