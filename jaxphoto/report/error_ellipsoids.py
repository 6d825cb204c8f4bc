"""Error ellipsoids as triangles: what a covariance of coordinates looks like."""

import numpy as np
from jaxtyping import Float, Int

_AROUND, _DOWN = 10, 6


def ellipsoid_mesh(
    centre: Float[np.ndarray, "n 3"], covariance: Float[np.ndarray, "n 3 3"]
) -> tuple[Float[np.ndarray, "corners 3"], Int[np.ndarray, "triangles 3"]]:
    """Corners, and by number the three of each triangle, of the surfaces d' covariance^-1 d = 1 around the centres.

    A covariance may be singular: its ellipsoid is then flat.
    """
    sphere, triangles = _sphere()
    variance, axes = np.linalg.eigh(covariance)
    # What is held comes out as zero or, by rounding, below it.
    half_axes = axes * np.sqrt(np.maximum(variance, 0.0))[:, None, :]
    corners = centre[:, None, :] + np.einsum("nij,cj->nci", half_axes, sphere)
    shifted = triangles + len(sphere) * np.arange(len(centre))[:, None, None]
    return corners.reshape(-1, 3), shifted.reshape(-1, 3)


def _sphere() -> tuple[np.ndarray, np.ndarray]:
    """Corners (c x 3) and triangles (t x 3) of a ball of radius 1."""
    down = np.linspace(0, np.pi, _DOWN + 1)[1:-1, None]
    around = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    rings = np.stack(np.broadcast_arrays(np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down)), 2)
    sphere = np.concatenate([[[0, 0, 1]], rings.reshape(-1, 3), [[0, 0, -1]]])
    here, right = np.arange(_AROUND), (np.arange(_AROUND) + 1) % _AROUND
    last = len(sphere) - 1
    top = np.stack([np.zeros_like(here), 1 + here, 1 + right], axis=1)
    bottom = np.stack([np.full_like(here, last), last - _AROUND + right, last - _AROUND + here], axis=1)
    bands = []
    for ring in range(_DOWN - 2):
        above, below = 1 + ring * _AROUND, 1 + (ring + 1) * _AROUND
        bands.append(np.stack([above + here, below + here, below + right], axis=1))
        bands.append(np.stack([above + here, below + right, above + right], axis=1))
    return sphere, np.concatenate([top, *bands, bottom])
