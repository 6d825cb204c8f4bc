"""Global test of the variance factor, for the whole adjustment and for each group of observations.

With correct weights v'Pv follows chi-square with nu degrees of freedom (the redundancy), and v'Pv of a group has the
mean nu_g, the sum of its redundancy numbers (Förstner 1979). Its variance is at most the variance of chi-square with
nu_g degrees of freedom, so the group test is conservative. If nu_g is below 1 (a group with far too large weights),
v'Pv / nu_g exceeds a value above 1.54 at most with the probability of chi-square with one degree of freedom (Székely
and Bakirov, Extremal probabilities for Gaussian quadratic forms, 2003).

A part with far too small standard deviations determines the unknowns: its residuals and nu_g are nearly zero, and these
bounds have little power. With v = R e, v'Pv is the sum of lambda_i chi-square_1, with the eigenvalues lambda_i of the
block of R of the part and the sum nu_g. If lambda is the largest, no such sum has larger moments than lambda times
chi-square with nu_g / lambda degrees of freedom (the moment generating function is convex in every lambda_i).
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.camera import InteriorOrientation
from jaxphoto.compiling import call_compiled
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.hat_matrix import HatMatrix
from jaxphoto.statistics.quantiles import chi_square_tails
from jaxphoto.statistics.reliability import UNCHECKED, Redundancy
from jaxphoto.statistics.variance_components import Parts

# Value above which the bound for a redundancy below one holds.
_EXTREMAL = 1.54


@pretty_repr
class VarianceFactor(eqx.Module):
    """Variance factor v'Pv / redundancy of a group of observations, with its two-sided p-value."""

    group: str
    n: int
    redundancy: float
    factor: float
    p_value: float
    expected: float = 1.0
    """Expected factor if the a priori standard deviations are correct."""

    @property
    def sigma(self) -> float:
        """Factor by which the a priori standard deviations of the group must be multiplied to fit the residuals."""
        return (self.factor / self.expected) ** 0.5


def global_test(adjusted: Adjustment, redundancy: Redundancy | None = None) -> VarianceFactor:
    """Test the variance factor of all observations against 1.

    With redundancy numbers, test it against its expectation for residuals of corrected coordinates
    (`expected_residual_scale`).
    """
    n, sum_of_squares = sum(adjusted.n_observations.values()), float(adjusted.sum_of_squares)
    expected = 1.0
    if redundancy is not None and adjusted.redundancy > 0:
        image_numbers = np.asarray(redundancy.image).sum(axis=0)
        expected += float(image_numbers @ (_expected(adjusted) - 1)) / adjusted.redundancy
    return _tested("", n, sum_of_squares, adjusted.redundancy, expected)


def group_factors(adjusted: Adjustment, redundancy: Redundancy) -> list[VarianceFactor]:
    """Test the variance factor of every group with redundancy."""
    names = tuple(observation_groups(adjusted))
    whole = {name: np.full(np.shape(adjusted.residuals[name]), k) for k, name in enumerate(names)}
    return part_factors(adjusted, Parts(names, whole), redundancy)


def part_factors(adjusted: Adjustment, parts: Parts, redundancy: Redundancy) -> list[VarianceFactor]:
    """Test the variance factor of every part with redundancy."""
    sums = np.zeros((4, len(parts.labels) + 1))
    for name, part in parts.part_of.items():
        v, r = np.asarray(adjusted.residuals[name]), np.asarray(redundancy[name])
        expected = r * _expected(adjusted) if name == IMAGE_POINTS else r
        for total, values in zip(sums, (np.ones(v.shape), v**2, r, expected), strict=True):
            total += np.bincount(part.ravel(), values.ravel(), minlength=len(total))
    return [
        _tested(label, int(n), square, r, expected / r)
        for label, n, square, r, expected in zip(parts.labels, *sums[:, :-1].tolist(), strict=True)
        if r > UNCHECKED
    ]


def p_value_of_excess(adjusted: Adjustment, parts: Parts, factor: VarianceFactor) -> float:
    """Return the one-sided p-value of a large variance `factor` of a part, with the largest eigenvalue of its R.

    It needs a solution per observation of the part, which must contain no image points.
    """
    hat = HatMatrix.of(adjusted, image_rows=False)
    k = parts.labels.index(factor.group)
    at = np.concatenate([hat.places[name][part == k] for name, part in parts.part_of.items() if name != IMAGE_POINTS])
    unit = np.eye(len(at))

    def column(number: int) -> Float[np.ndarray, "n"]:
        z = np.zeros(hat.count)
        z[at] = unit[number]
        return z

    products, _ = hat.products(column, len(at))
    largest = float(np.linalg.eigvalsh(unit - products)[-1])
    square = factor.factor * factor.redundancy
    return chi_square_tails(square / largest, factor.redundancy / largest)[1]


def expected_residual_scale(adjusted: Adjustment) -> dict[str, float]:
    """Return the expected RMS of the image residuals over their standard deviations, by camera.

    It is 1 for residuals of measured coordinates. For residuals of corrected coordinates (docs/adjustment.md, residuals
    of wide-angle cameras), the distortion scales the noise with the image.
    """
    cameras, expected = np.array(adjusted.block.image_camera)[adjusted.structure.image], _expected(adjusted)
    return {name: float(expected[cameras == name].mean()) ** 0.5 for name in dict.fromkeys(cameras.tolist())}


# Number of points along each side of the grid of distortion scales; constant, so one program is compiled.
_GRID = 33


def _expected(adjusted: Adjustment) -> Float[np.ndarray, "rows"]:
    """Return the expected v'v / 2 of the whitened residuals of each image row before adjustment."""
    rows = adjusted.structure.image
    cameras, expected = np.array(adjusted.block.image_camera)[rows], np.ones(len(rows))
    for name, interior in adjusted.unknowns.interior.items():
        camera_rows, sensor = cameras == name, adjusted.block.sensors[name]
        if interior.residuals == "model" and interior.distortion.domain == "measured" and camera_rows.any():
            size = np.array([sensor.width_mm, sensor.height_mm])[:, None]
            grid = np.stack(np.meshgrid(*size * np.linspace(-0.5, 0.5, _GRID), indexing="ij"), axis=-1)
            centred = grid.reshape(-1, 2) - np.asarray(interior.principal_point)
            slopes = np.asarray(call_compiled(_slopes, interior, centred)).reshape(_GRID, _GRID, 2, 2)
            node = np.rint((np.asarray(adjusted.values.xy)[:, camera_rows] / size + 0.5) * (_GRID - 1)).astype(int)
            i, j = np.clip(node, 0, _GRID - 1)
            expected[camera_rows] = (slopes[i, j] ** 2).sum(axis=(1, 2)) / 2
    return expected


@eqx.filter_jit
def _slopes(interior: InteriorOrientation, xy: Float[Array, "rows 2"]) -> Float[Array, "rows 2 2"]:
    return jax.vmap(jax.jacfwd(interior.closed_form))(xy)


def _tested(group: str, n: int, sum_of_squares: float, redundancy: float, expected: float) -> VarianceFactor:
    if redundancy <= 0:
        return VarianceFactor(group, n, redundancy, 1.0, 1.0)
    ratio = sum_of_squares / expected
    if redundancy < 1:
        p = chi_square_tails(ratio / redundancy, 1)[1] if ratio > _EXTREMAL * redundancy else 1.0
    else:
        p = 2 * min(chi_square_tails(ratio, redundancy))
    return VarianceFactor(group, n, redundancy, sum_of_squares / redundancy, min(p, 1.0), expected)
