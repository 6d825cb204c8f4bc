"""Spatially correlated errors of image points, and what they do to the shared unknowns.

Unmodelled distortion, blur, refraction and rolling shutter make the errors of neighbouring image points alike. Standard
deviations for independent errors are then too small, each by a factor of its own: an estimate that is a mean over the
format suffers most. The errors are modelled as a sum of independent parts,

    e = s_0 e_0 + sum_k s_k f_k,

with e_0 independent errors of the stated standard deviations, and f_k random fields over the format with the covariance
exp(-d^2 / 2 L^2) at the distance d. Fields are new for each image (blur, refraction), or common to the images of a
camera (distortion); L is 1/4 to 1/32 of the longer side of the format. The variances s_k^2 follow from quadratic forms
of the residuals, one per part, equated to their expectations (moments; Rao 1971). The expectations, which contain what
the adjustment absorbs, are means over simulated errors. The covariance of the estimates x = S e is

    S (sum_k s_k^2 F_k) S',    F_k the covariance of part k.

Fields are sums of cosines of random frequency and phase (Rahimi and Recht 2007), so F_k is a product Z Z'.
"""

import dataclasses
from itertools import islice
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics.covariance import Covariance
from jaxphoto.statistics.hat_matrix import HatMatrix

LENGTHS = (1 / 4, 1 / 8, 1 / 16, 1 / 32)
"""Correlation lengths L, as fractions of the longer side of the format."""
# Number of cosines of a field. Numbers of simulated errors: of independent errors and of fields of the images, which
# are averaged over the images, and of fields of the cameras.
_COSINES, _FEW, _MANY = 100, 6, 24


@pretty_repr
class CorrelatedNoise(NamedTuple):
    """Parts of the errors of image points, and the covariance of the shared unknowns that they cause."""

    parts: tuple[tuple[str, float], ...]
    """Kind ("independent", "image" or "camera") and correlation length as a fraction of the format's longer side."""
    size: Float[np.ndarray, "parts"]
    """Standard deviation of each part, relative to the stated standard deviations of image points."""
    labels: tuple[str, ...]
    """Shared unknowns, as in `Structure.labels`."""
    covariance: Float[np.ndarray, "shared shared"]
    """Covariance of the shared unknowns, in their own units."""
    of_images: Float[np.ndarray, "shared shared"]
    """Part of `covariance` due to image points."""
    independent: Float[np.ndarray, "shared shared"]
    """Covariance for independent errors of the stated standard deviations."""
    sigma0: float

    @property
    def factors(self) -> dict[str, float]:
        """Standard deviations over those of independent errors, a posteriori, by shared unknown."""
        ratio = np.sqrt(np.diagonal(self.covariance) / np.diagonal(self.independent)) / self.sigma0
        return dict(zip(self.labels, ratio.tolist(), strict=True))

    def widened(self, independent: Covariance) -> Covariance:
        """Return the covariance of independent errors with that of the shared unknowns replaced.

        Correlations of exterior with shared unknowns are those of independent errors.
        """
        matrix, n, factor = np.array(independent.matrix), 6 * independent.n_images, np.array([*self.factors.values()])
        matrix[n:, :n] *= factor[:, None]
        matrix[:n, n:] *= factor
        matrix[n:, n:] = self.covariance / float(independent.variance_factor)
        return dataclasses.replace(independent, matrix=matrix)


class _Field(NamedTuple):
    """Random field: cosines over the format, by group of consecutive image rows (an image or a camera)."""

    cosines: Float[np.ndarray, "rows cosines"]
    ends: Int[np.ndarray, "groups"]
    """End of the rows of each group."""

    def draw(self, rng: np.random.Generator) -> Float[np.ndarray, "2 rows"]:
        """Draw x and y of one field per group."""
        parts = np.split(self.cosines, self.ends[:-1])
        return np.concatenate([part @ rng.normal(size=(part.shape[1], 2)) for part in parts]).T

    def products(self, values: Float[np.ndarray, "n 2 rows"]) -> Float[np.ndarray, "n modes"]:
        """Return Z' of each of `values`."""
        flat = values.reshape(-1, values.shape[2])
        pairs = zip(np.split(flat, self.ends[:-1], axis=1), np.split(self.cosines, self.ends[:-1]), strict=True)
        return np.concatenate([(v @ part).reshape(len(values), -1) for v, part in pairs], axis=1)


def correlated_noise(adjusted: Adjustment) -> CorrelatedNoise:
    """Estimate spatially correlated errors of the image points and their effect on the shared unknowns.

    The stated standard deviations of all other observations are used: scale them by their variance components first.
    Fixed random numbers are used, so equal adjustments give equal results.
    """
    block, hat = adjusted.block, HatMatrix.of(adjusted)
    cameras, camera = np.unique(block.image_camera, return_inverse=True)
    longer = np.array([max(s.width_mm, s.height_mm) for s in (block.sensors[name] for name in cameras)])
    # By camera and image, so that the rows of each are consecutive.
    image = np.asarray(block.image_points.image)
    order = np.lexsort((image, camera[image]))
    image, place = image[order], hat.places["image_points"][:, order]
    # Fields are in units of the median standard deviation; divided by that of a row they are whitened.
    sigma = np.asarray(block.image_points.sigma)[order].T
    weight = np.median(sigma) / sigma
    at = np.asarray(block.image_points.xy)[order] / longer[camera[image], None]
    ends = {"image": _ends(image), "camera": _ends(camera[image])}
    cosines = {length: _cosines(at / length) for length in LENGTHS}
    fields = {(kind, length): _Field(cosines[length], ends[kind]) for kind in ends for length in LENGTHS}

    def forms(whitened: Float[np.ndarray, "n 2 rows"]) -> Float[np.ndarray, "n parts"]:
        """Return the quadratic form of each part: sum of squares, and |Z' v|^2."""
        squares = [np.sum(whitened**2, axis=(1, 2))]
        squares += [np.sum(field.products(whitened * weight) ** 2, axis=1) for field in fields.values()]
        return np.stack(squares, axis=1)

    parts: list[tuple[tuple[str, float], _Field | None]] = [(("independent", 0.0), None), *fields.items()]
    drawn = [k for k, ((kind, _), _) in enumerate(parts) for _ in range(_MANY if kind == "camera" else _FEW)]

    def error(k: int) -> Float[np.ndarray, "n"]:
        rng, field = np.random.default_rng(k), parts[drawn[k]][1]
        errors = np.zeros(hat.count)
        errors[place] = field.draw(rng) * weight if field else rng.normal(size=weight.shape)
        return errors

    changes = (error(k) - absorbed for k, (_, absorbed) in enumerate(hat.apply(error, len(drawn))))
    simulated = (np.array([v[place] for v in islice(changes, drawn.count(k))]) for k in range(len(parts)))
    expected = np.stack([forms(v).mean(axis=0) for v in simulated], axis=1)
    observed = forms(hat.residuals[place][None])[0]
    # Divide each equation by the expectation of its own part, so all have the same size.
    own = expected.diagonal()
    variance, _ = scipy.optimize.nnls(expected / own[:, None], observed / own)

    labels = adjusted.structure.labels
    influence = np.array(list(hat.influence_on(range(len(labels)))))
    of_rows = influence[:, place]
    influence[:, place] = 0.0
    ordinary = np.einsum("pan,qan->pq", of_rows, of_rows)
    of_images = variance[0] * ordinary
    for size, field in zip(variance[1:], fields.values(), strict=True):
        if size > 0:
            products = field.products(of_rows * weight)
            of_images += size * products @ products.T
    others = influence @ influence.T
    names = tuple(name for name, _ in parts)
    sums = of_images + others, of_images, ordinary + others
    return CorrelatedNoise(names, np.sqrt(variance), tuple(labels), *sums, float(adjusted.sigma0))


def _cosines(at: Float[np.ndarray, "rows 2"]) -> Float[np.ndarray, "rows cosines"]:
    """Return cosines whose sum with normal amplitudes has the covariance exp(-d^2 / 2) at the distance d."""
    rng = np.random.default_rng(0)
    phase = at @ rng.normal(size=(2, _COSINES)) + rng.uniform(0, 2 * np.pi, _COSINES)
    return np.sqrt(2 / _COSINES) * np.cos(phase)


def _ends(group: Int[np.ndarray, "rows"]) -> Int[np.ndarray, "groups"]:
    """Return where each run of equal numbers ends."""
    return np.append(np.flatnonzero(np.diff(group)) + 1, len(group))
