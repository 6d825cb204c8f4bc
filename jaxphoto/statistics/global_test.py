"""Do the residuals fit the standard deviations: sigma naught of the whole adjustment, and of each group by itself.

With true weights v'Pv follows chi-square of the redundancy nu, and v'Pv of a group has the mean nu_g, the sum of its
redundancy numbers (Förstner 1979). It varies at most as chi-square of nu_g does, so its test is on the safe side.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.camera import InteriorOrientation
from jaxphoto.compiling import call_compiled
from jaxphoto.short_repr import shown
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.quantiles import chi_square_tails
from jaxphoto.statistics.reliability import Redundancy


@shown
class VarianceFactor(eqx.Module):
    """v'Pv over the redundancy of a group of observations, and the two-sided probability of one as far from 1."""

    group: str
    n: int
    redundancy: float
    factor: float
    p_value: float
    expected: float = 1.0
    """Of the factor, where the a priori standard deviations are true."""

    @property
    def sigma(self) -> float:
        """By what the a priori standard deviations of the group would be multiplied to fit."""
        return (self.factor / self.expected) ** 0.5


def global_test(adjusted: Adjustment, redundancy: Redundancy | None = None) -> VarianceFactor:
    """Sigma naught of all observations against 1; with their redundancy numbers, against what stretched residuals
    (`stretch`) let expect."""
    n, square_sum = sum(adjusted.n_observations.values()), float(adjusted.square_sum)
    expected = 1.0
    if redundancy is not None and adjusted.redundancy > 0:
        of_images = np.asarray(redundancy.image).sum(axis=0)
        expected += float(of_images @ (_expected(adjusted) - 1)) / adjusted.redundancy
    return _tested("", n, square_sum, adjusted.redundancy, expected)


def group_factors(adjusted: Adjustment, redundancy: Redundancy) -> list[VarianceFactor]:
    """The same of each group, with the a priori variance factor 1; groups that nothing checks are left out."""
    found = []
    for name in observation_groups(adjusted):
        v, numbers = np.asarray(adjusted.residuals[name]), np.asarray(redundancy[name])
        if (r := float(numbers.sum())) >= 1:
            expected = float(numbers.sum(axis=0) @ _expected(adjusted)) / r if name == IMAGE_POINTS else 1.0
            found.append(_tested(name, v.size, float((v**2).sum()), r, expected))
    return found


def stretch(adjusted: Adjustment) -> dict[str, float]:
    """By camera, the root mean square of its image residuals over their standard deviations that true weights give.

    1 where residuals are of measured coordinates. Where they are of corrected ones (docs/adjustment.md, residuals of
    wide-angle cameras), a noise of equal size has been stretched with the image.
    """
    cameras, expected = np.array(adjusted.block.image_camera)[adjusted.structure.image], _expected(adjusted)
    return {name: float(expected[cameras == name].mean()) ** 0.5 for name in dict.fromkeys(cameras.tolist())}


# Of the grid over the format on which a distortion's stretch is taken: always as many, so that it is compiled for once.
_GRID = 33


def _expected(adjusted: Adjustment) -> Float[np.ndarray, "rows"]:
    """The mean of v'v / 2 of each image row's whitened residuals, were the noise as given and nothing adjusted."""
    rows = adjusted.structure.image
    cameras, found = np.array(adjusted.block.image_camera)[rows], np.ones(len(rows))
    for name, interior in adjusted.unknowns.interior.items():
        mine, sensor = cameras == name, adjusted.block.sensors[name]
        if interior.residuals == "model" and interior.distortion.domain == "measured" and mine.any():
            size = np.array([sensor.width_mm, sensor.height_mm])[:, None]
            grid = np.stack(np.meshgrid(*size * np.linspace(-0.5, 0.5, _GRID), indexing="ij"), axis=-1)
            centred = grid.reshape(-1, 2) - np.asarray(interior.principal_point)
            slopes = np.asarray(call_compiled(_slopes, interior, centred)).reshape(_GRID, _GRID, 2, 2)
            node = np.rint((np.asarray(adjusted.values.xy)[:, mine] / size + 0.5) * (_GRID - 1)).astype(int)
            i, j = np.clip(node, 0, _GRID - 1)
            found[mine] = (slopes[i, j] ** 2).sum(axis=(1, 2)) / 2
    return found


@eqx.filter_jit
def _slopes(interior: InteriorOrientation, xy: Float[Array, "rows 2"]) -> Float[Array, "rows 2 2"]:
    return jax.vmap(jax.jacfwd(interior.closed_form))(xy)


def _tested(group: str, n: int, square_sum: float, redundancy: float, expected: float) -> VarianceFactor:
    if redundancy <= 0:
        return VarianceFactor(group, n, redundancy, 1.0, 1.0)
    p = 2 * min(chi_square_tails(square_sum / expected, redundancy))
    return VarianceFactor(group, n, redundancy, square_sum / redundancy, min(p, 1.0), expected)
