"""Correlations: interior with interior orientation, and each image's exterior with its camera's interior.

Source: paper 000, Table 4 (mean absolute correlation over the images, per angle or coordinate and IOP).
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import namespace, still
from jaxphoto.short_repr import shown
from jaxphoto.statistics.covariance import EOP_NAMES, Covariance


@shown
class Correlations(eqx.Module):
    """Correlation coefficients of one camera, as arrays with the names of their axes."""

    camera: str = eqx.field(static=True)
    parameters: tuple[str, ...] = eqx.field(static=True)
    """The camera's estimated interior parameters (c_mm ...)."""
    eop_names: tuple[str, ...] = eqx.field(static=True)
    images: tuple[str, ...] = eqx.field(static=True)
    interior: Float[Any, "iop iop"]
    exterior: Float[Any, "images 6 iop"]
    within_image: Float[Any, "images 6 6"]
    """Of each image's exterior orientation with itself."""

    @property
    def mean_abs(self) -> Float[Any, "6 iop"]:
        """Mean over the camera's images of |rho| (paper 000, Table 4)."""
        return abs(self.exterior).mean(axis=0)

    @property
    def max_abs(self) -> Float[Any, "6 iop"]:
        """Maximum over the camera's images of |rho|."""
        return abs(self.exterior).max(axis=0)


def correlation_matrix(covariance: Covariance) -> Float[Any, "reduced reduced"]:
    """Correlations of everything in `covariance.labels`; zero for what is fixed."""
    matrix = still(covariance.matrix)
    xp, variance = namespace(matrix), matrix.diagonal()
    inverse = xp.where(variance > 0, 1 / xp.sqrt(xp.where(variance > 0, variance, 1.0)), 0.0)
    return matrix * inverse[:, None] * inverse[None, :]


def correlations(adjusted: Adjustment, covariance: Covariance) -> dict[str, Correlations]:
    """By camera: IOP x IOP, and EOP x IOP of each of its images."""
    rho, n = correlation_matrix(covariance), 6 * covariance.n_images
    names = EOP_NAMES[covariance.rotations]
    result = {}
    for camera in adjusted.unknowns.interior:
        prefix = f"interior[{camera}]."
        columns = [k for k, label in enumerate(covariance.labels) if k >= n and label.startswith(prefix)]
        images = [i for i, c in enumerate(adjusted.block.image_camera) if c == camera]
        own = 6 * np.array(images, int)[:, None] + np.arange(6)
        exterior = rho[own][:, :, np.array(columns, int)]
        result[camera] = Correlations(
            camera,
            tuple(covariance.labels[k].removeprefix(prefix) for k in columns),
            names,
            tuple(adjusted.block.images[i] for i in images),
            rho[np.ix_(columns, columns)],
            exterior,
            rho[own[:, :, None], own[:, None]],
        )
    return result


def high_pairs(names: Sequence[str], rho: Float[np.ndarray, "n n"], above: float) -> list[tuple[str, str, float]]:
    """Pairs of parameters whose correlation is larger than `above`, either sign, and it; the largest first."""
    lower = [(i, j) for i in range(len(names)) for j in range(i)]
    pairs = [(names[i], names[j], float(rho[i, j])) for i, j in lower if abs(rho[i, j]) > above]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))
