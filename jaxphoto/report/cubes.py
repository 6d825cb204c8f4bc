"""Arrays of more than two dimensions as xarray: correlations by image, draws by image and point.

Values are in radians, metres and millimetres, as the coordinate names say.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.observations import AXES
from jaxphoto.report.draws import EXTERIOR
from jaxphoto.statistics import Correlations, Covariance, correlation_matrix

if TYPE_CHECKING:
    import xarray as xr

    from jaxphoto.sensitivity import Draws


def correlation_cube(correlations: Correlations) -> xr.Dataset:
    """The correlations of a camera: `interior` (parameter, with_parameter), `exterior` (image, element, parameter) and
    `within_image` (image, element, with_element).
    """
    # Imported here because it takes a third of a second.
    import xarray as xr

    c = correlations
    return xr.Dataset(
        {
            "interior": (("parameter", "with_parameter"), c.interior),
            "exterior": (("image", "element", "parameter"), c.exterior),
            "within_image": (("image", "element", "with_element"), c.within_image),
        },
        coords={
            "parameter": list(c.parameters),
            "with_parameter": list(c.parameters),
            "image": list(c.images),
            "element": list(c.eop_names),
            "with_element": list(c.eop_names),
        },
        attrs={"camera": c.camera},
    )


def covariance_array(known: Covariance) -> xr.DataArray:
    """All correlations of exterior orientations and shared unknowns: (unknown, with_unknown), with `sigma` (unknown),
    a posteriori, in the units of the labels. A fixed unknown has a sigma of zero, and no correlation.
    """
    import xarray as xr

    names = list(known.labels)
    sigma = np.concatenate([np.asarray(known.exterior_sigma).ravel(), np.asarray(known.shared_sigma)])
    coords = {"unknown": names, "with_unknown": names, "sigma": ("unknown", sigma)}
    return xr.DataArray(correlation_matrix(known), coords, ("unknown", "with_unknown"), name="correlation")


def draws_cube(draws: Draws, adjusted: Adjustment) -> xr.Dataset:
    """A Monte Carlo: `shared` (draw, parameter), `error` (draw, of_error), `converged`, `iterations` and `fallback`
    (draw); if kept, `exterior` (draw, image, element) and `points` (draw, point, axis).
    """
    import xarray as xr

    variables: dict[str, tuple[tuple[str, ...], np.ndarray]] = {
        "shared": (("draw", "parameter"), draws.shared),
        "converged": (("draw",), draws.converged),
        "iterations": (("draw",), draws.steps),
        "fallback": (("draw",), draws.fallback),
    }
    coords: dict[str, object] = {"draw": np.arange(len(draws.steps)), "parameter": list(draws.labels)}
    if draws.recorded:
        variables["error"] = ("draw", "of_error"), np.stack(list(draws.recorded.values()), axis=1)
        coords["of_error"] = list(draws.recorded)
    if draws.exterior is not None:
        variables["exterior"] = ("draw", "image", "element"), draws.exterior
        coords |= {"image": list(adjusted.block.images), "element": list(EXTERIOR)}
    if draws.points is not None:
        variables["points"] = ("draw", "point", "axis"), draws.points
        coords |= {"point": list(adjusted.block.points), "axis": list(AXES)}
    return xr.Dataset(variables, coords)
