"""Test for a camera change between two adjustments."""

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import ArrayLike
from jaxphoto.block_edits import one_camera
from jaxphoto.camera import parameter_names
from jaxphoto.errors import InputError
from jaxphoto.stability import Change, Method, change, image_grid
from jaxphoto.statistics import covariance
from jaxphoto.tracing import outside_transformations


@outside_transformations
def compare(
    first: Adjustment,
    second: Adjustment,
    camera: str | None = None,
    camera_b: str | None = None,
    *,
    points: Float[ArrayLike, "points 2"] | None = None,
    method: Method = "rot",
) -> Change:
    """Compare a camera in two adjustments of different photographs: by parameters, and by its bundle of rays.

    `camera` and `camera_b` name it in each if a block has several. `points` (mm from the centre) are the places of the
    format at which rays are compared, 15 x 11 from edge to edge by default; `method` defines which orientation is
    estimated between the bundles (docs/stability.md). `jaxphoto.report.stability` has its tables and messages.
    Raises InputError for adjustments that did not converge, formats that differ, and bundles that cannot be compared.
    """
    for adjusted in (first, second):
        if not bool(adjusted.converged):
            raise InputError(f"{adjusted.block.title or 'a block'} is no calibration: {adjusted.outcome.value}")
    names = [one_camera(a.block, given) for a, given in ((first, camera), (second, camera_b or camera))]
    sensors = [a.block.sensors[name] for a, name in zip((first, second), names, strict=True)]
    if sensors[0] != sensors[1]:
        raise InputError(f"{names[0]} is a {sensors[0]}, {names[1]} a {sensors[1]}; compare two sets of one camera")
    interiors = [a.unknowns.interior[name] for a, name in zip((first, second), names, strict=True)]
    covariances = [
        covariance(a).of_interior(name, parameter_names(interior))
        for a, name, interior in zip((first, second), names, interiors, strict=True)
    ]
    at = image_grid(sensors[0]) if points is None else np.asarray(points, float)
    return change(interiors[0], interiors[1], at, (covariances[0], covariances[1]), method)
