"""Adjusted photographs -> a problem of "Bundle Adjustment in the Large", as `jaxphoto.io.bal` reads it.

Its cameras are f, k1 and k2, one a photograph, with a rotation vector and t: P = R X + t, p = -P / P_z, and image
points f (1 + k1 |p|^2 + k2 |p|^4) p are those of `same_rays`, in pixels from the principal point, x right and y up.
Source: grail.cs.washington.edu/projects/bal.
"""

from pathlib import Path

import numpy as np
import scipy

from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs, translations
from jaxphoto.io.exports.same_rays import from_principal_point, radial_values


def write_bal(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write problem-N-M-pre.txt of N photographs and M points into `folder`, both counted from 0 as the block has them,
    without points that no photograph shows."""
    p = photographs
    turns = np.asarray(p.exterior.camera_from_object)
    cameras = np.hstack(
        [
            scipy.spatial.transform.Rotation.from_matrix(turns).as_rotvec(),
            translations(turns, p.exterior),
            radial_values(p),
        ]
    )
    points, number = np.unique(p.point, return_inverse=True)
    order = np.lexsort((p.image, number))
    rows = zip(p.image[order].tolist(), number[order].tolist(), from_principal_point(p)[order].tolist(), strict=True)
    lines = [f"{len(p.images)} {len(points)} {len(order)}", *(f"{i} {j} {x!r} {y!r}" for i, j, (x, y) in rows)]
    lines += [repr(value) for value in [*cameras.ravel().tolist(), *p.xyz[points].ravel().tolist()]]
    path = folder / f"problem-{len(p.images)}-{len(points)}-pre.txt"
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
