"""Correlations of interior with exterior orientation, and of the camera with deformations of the ground.

Source of the image-wise correlations: paper 000, Table 4 (mean absolute correlation over the images, per angle or
coordinate and IOP).

Over flat ground imaged from one height, a longer c is equivalent to a greater flying height, and radial distortion to a
dome of the ground: neither changes the residuals. Correlations with the exterior orientation of single images do not
show this, because all images and points move jointly. Each form below is a linear function f = g' x of the coordinates
of points and stations, so

    cov(f, u) = sigma0^2 g' N^-1 e_u,   var(f) = sigma0^2 g' N^-1 g.

    height          mean Z of the points
    flying_height   mean Z of the projection centres minus mean Z of the points
    dome            height of the centre of the ground over its edge: of Z = a + b X + c Y + d (X^2 + Y^2),
                    fitted to the points, -d R^2 with the distance R from the centre to the farthest point

Source: the dome as the typical deformation of flat blocks, M. R. James and S. Robson, Mitigating systematic error in
topographic models derived from UAV and ground-based image networks, Earth Surface Processes and Landforms 39 (2014).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.right_hand_sides import solve_many
from jaxphoto.arrays import ArrayLike, is_traced, namespace, to_numpy
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics.covariance import EOP_NAMES, Covariance
from jaxphoto.statistics.hat_matrix import inner_products


@pretty_repr
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
    """Correlations among the exterior orientation elements of each image."""

    @property
    def mean_abs(self) -> Float[Any, "6 iop"]:
        """Mean over the camera's images of |rho| (paper 000, Table 4)."""
        return abs(self.exterior).mean(axis=0)

    @property
    def max_abs(self) -> Float[Any, "6 iop"]:
        """Maximum over the camera's images of |rho|."""
        return abs(self.exterior).max(axis=0)


def correlation_matrix(covariance: Covariance) -> Float[Any, "reduced reduced"]:
    """Compute the correlation matrix of `covariance.labels`; zero for fixed unknowns."""
    matrix = to_numpy(covariance.matrix)
    xp, variance = namespace(matrix), matrix.diagonal()
    inverse = xp.where(variance > 0, 1 / xp.sqrt(xp.where(variance > 0, variance, 1.0)), 0.0)
    return matrix * inverse[:, None] * inverse[None, :]


def correlations(adjusted: Adjustment, covariance: Covariance) -> dict[str, Correlations]:
    """Compute the correlations of each camera: IOP with IOP, and EOP of each image with IOP."""
    rho, n = correlation_matrix(covariance), 6 * covariance.n_images
    names = EOP_NAMES[covariance.rotations]
    result = {}
    for camera in adjusted.unknowns.interior:
        prefix = f"interior[{camera}]."
        columns = [k for k, label in enumerate(covariance.labels) if k >= n and label.startswith(prefix)]
        images = [i for i, c in enumerate(adjusted.block.image_camera) if c == camera]
        rows = 6 * np.array(images, int)[:, None] + np.arange(6)
        exterior = rho[rows][:, :, np.array(columns, int)]
        result[camera] = Correlations(
            camera,
            tuple(covariance.labels[k].removeprefix(prefix) for k in columns),
            names,
            tuple(adjusted.block.images[i] for i in images),
            rho[np.ix_(columns, columns)],
            exterior,
            rho[rows[:, :, None], rows[:, None]],
        )
    return result


def high_pairs(names: Sequence[str], rho: Float[np.ndarray, "n n"], above: float) -> list[tuple[str, str, float]]:
    """List the pairs of parameters with |rho| > `above` and their correlation, largest first."""
    upper = [(i, j) for j in range(len(names)) for i in range(j)]
    pairs = [(names[i], names[j], float(rho[i, j])) for i, j in upper if abs(rho[i, j]) > above]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))


@pretty_repr
class LinearForms(NamedTuple):
    """Covariances of linear functions of the unknowns: among themselves and with the shared unknowns."""

    variance: Float[Any, "forms forms"]
    with_shared: Float[Any, "forms shared"]


def linear_forms(
    adjusted: Adjustment,
    n_forms: int,
    *,
    points: Float[ArrayLike, "forms points 3"] | None = None,
    exterior: Float[ArrayLike, "forms images 6"] | None = None,
    shared: Float[ArrayLike, "forms shared"] | None = None,
) -> LinearForms:
    """Compute the a posteriori covariances of `n_forms` functions f = g' x of the unknowns.

        cov(f, h) = sigma0^2 g' N^-1 h    with the normal matrix N

    Omitted weights are zero. Unknowns are the coordinates of the points (m), the position (m) and small rotations about
    the camera axes (rad) of each image, and the shared unknowns in the order and units of `Structure.labels`.
    """
    equations, places = adjusted.equations.on_one_device.weighed, adjusted.padded.places
    scale = jax.tree.map(to_numpy, equations.scale)

    def weights(g: Any, index: Any, scale: Any) -> Any:
        if g is None:
            return np.zeros((n_forms, *scale.shape))
        if is_traced((g, scale)):
            return jnp.zeros((n_forms, *scale.shape)).at[..., index].set(g) * scale
        padded = np.zeros((n_forms, *scale.shape))
        padded[..., index] = g
        return padded * scale

    b = Increments(
        weights(None if exterior is None else exterior.swapaxes(1, 2), places.image, scale.eop),
        weights(shared, np.arange(0 if shared is None else shared.shape[1]), scale.shared),
        weights(None if points is None else points.swapaxes(1, 2), places.point, scale.points),
    )
    x, factor = solve_many(equations, b, adjusted.seconds), adjusted.sigma0**2
    return LinearForms(factor * inner_products(b, x), factor * x.shared * scale.shared)


FORMS = ("height", "flying_height", "dome")
# Minimum number of rays per point (two-ray points would dominate the variance of a mean), and minimum number of points
# with that many rays for the limit to apply.
_MIN_RAYS, _MIN_POINTS = 3, 10
# Minimum mean cosine of the tilt of near-vertical photographs.
_MIN_COSINE = 0.7
# Ratio to the largest point variance below which the variance of a form is rounding: the datum fixes the form.
_ROUNDING = 1e-9


@pretty_repr
class GroundCorrelations(eqx.Module):
    """Correlations of the ground deformations `FORMS` with the interior orientation of a camera."""

    camera: str = eqx.field(static=True)
    parameters: tuple[str, ...] = eqx.field(static=True)
    """The camera's estimated interior parameters (c_mm ...)."""
    sigma_m: Float[np.ndarray, "forms"]
    """Standard deviation (m) of each of `FORMS`; zero if the datum fixes it."""
    rho: Float[np.ndarray, "forms iop"]
    together: Float[np.ndarray, "forms"]
    """Multiple correlation of each form with all interior parameters of the camera."""


def ground_correlations(adjusted: Adjustment, covariance: Covariance) -> dict[str, GroundCorrelations]:
    """Compute the ground correlations of each camera; empty for oblique blocks and for fewer than five points."""
    rays = np.bincount(adjusted.structure.point, minlength=len(adjusted.block.points))
    chosen = rays >= _MIN_RAYS if (rays >= _MIN_RAYS).sum() >= _MIN_POINTS else rays > 0
    cosine = np.mean(np.asarray(adjusted.unknowns.exterior.camera_from_object)[:, 2, 2])
    if not cosine > _MIN_COSINE or chosen.sum() < 5:
        return {}
    points, positions = _weights(np.asarray(adjusted.unknowns.points), chosen, len(adjusted.block.images))
    exterior = np.concatenate([positions, np.zeros_like(positions)], axis=2)
    forms = linear_forms(adjusted, len(FORMS), points=points, exterior=exterior)
    variance, n = np.diagonal(forms.variance), 6 * covariance.n_images
    variable = variance > _ROUNDING * np.max(np.square(covariance.point_sigma), initial=0.0)
    sigma = np.where(variable, np.sqrt(np.maximum(variance, 0.0)), 0.0)
    labels, matrix = covariance.labels[n:], np.asarray(covariance.matrix)[n:, n:] * float(covariance.variance_factor)
    result = {}
    for camera in adjusted.unknowns.interior:
        prefix = f"interior[{camera}]."
        columns = [k for k, label in enumerate(labels) if label.startswith(prefix)]
        if not columns:
            continue
        cross, interior = forms.with_shared[:, columns], matrix[np.ix_(columns, columns)]
        size = np.where(variable, sigma, np.inf)[:, None] * np.sqrt(np.diagonal(interior))
        rho = cross / size
        correlation = interior / np.sqrt(np.outer(np.diagonal(interior), np.diagonal(interior)))
        square = np.einsum("fi,fi->f", rho, np.linalg.solve(correlation, rho.T).T)
        result[camera] = GroundCorrelations(
            camera,
            tuple(labels[k].removeprefix(prefix) for k in columns),
            sigma,
            rho,
            np.sqrt(np.clip(square, 0.0, 1.0)),
        )
    return result


def _weights(
    xyz: Float[np.ndarray, "points 3"], chosen: np.ndarray, n_images: int
) -> tuple[Float[np.ndarray, "3 points 3"], Float[np.ndarray, "3 images 3"]]:
    """Return the weights of the point coordinates and of the projection centres in each of `FORMS`."""
    points, positions = np.zeros((3, *xyz.shape)), np.zeros((3, n_images, 3))
    points[0, chosen, 2] = 1 / chosen.sum()
    points[1], positions[1, :, 2] = -points[0], 1 / n_images
    plan = xyz[chosen, :2] - xyz[chosen, :2].mean(axis=0)
    square = (plan**2).sum(axis=1)
    farthest = max(float(square.max()), np.finfo(float).tiny)
    terms = np.column_stack([np.ones(len(plan)), plan / np.sqrt(farthest), square / farthest])
    points[2, chosen, 2] = -np.linalg.pinv(terms)[3]
    return points, positions
