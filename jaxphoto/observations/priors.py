"""Prior information on unknowns, as observations."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.camera import table_name
from jaxphoto.errors import camera_words, few
from jaxphoto.observations.base import AXES, AbstractObservations, ImageState, index_of
from jaxphoto.rotation import small_angles
from jaxphoto.short_repr import pretty_repr

PRIORS = "priors"


class ParameterRows(AbstractObservations):
    """Prior values and sigmas of parameters, in the units of the parameters."""

    group = PRIORS
    unit = ""

    parameter: Int[np.ndarray, "n"] = index_of("parameter")
    value: Float[ArrayLike, "n"]
    sigma: Float[ArrayLike, "n"]

    def residual(self, parameter: Float[Array, ""]) -> Float[ArrayLike, ""]:
        """Return prior minus estimated value."""
        return self.value - parameter


class PositionRows(AbstractObservations):
    """Prior projection centres (m) of `image`."""

    group = "prior_positions"
    unit = "m"
    axes = AXES

    image: Int[np.ndarray, "n"] = index_of("image")
    value: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n 3"]

    def residual(self, image: ImageState) -> Float[ArrayLike, "3"]:
        """Return prior minus estimated value (m)."""
        return self.value - image.position


class RotationRows(AbstractObservations):
    """Prior rotations `camera_from_object` of `image`; sigma refers to a small rotation in the camera frame (rad)."""

    group = "prior_rotations"
    unit = "rad"
    axes = ("rx", "ry", "rz")
    observed = "turn"
    columns = {"value": tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), "turn": ()}  # noqa: RUF012

    image: Int[np.ndarray, "n"] = index_of("image")
    value: Float[ArrayLike, "n 3 3"]
    sigma: Float[ArrayLike, "n 3"]
    turn: Float[ArrayLike, "n 3"]
    """Observed rotation relative to `value` (rad): zero, unless an error is simulated."""

    def residual(self, image: ImageState) -> Float[ArrayLike, "3"]:
        """Return prior minus estimated rotation as a small rotation in the camera frame (rad)."""
        return self.turn + small_angles(jnp.asarray(self.value) @ image.camera_from_object.T)


class PointRows(AbstractObservations):
    """Prior object points (m)."""

    group = "prior_points"
    unit = "m"
    axes = AXES

    point: Int[np.ndarray, "n"] = index_of("point")
    value: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n 3"]

    def residual(self, point: Float[Array, "3"]) -> Float[ArrayLike, "3"]:
        """Return prior minus estimated value (m)."""
        return self.value - point


@pretty_repr
class KnownParameters(eqx.Module):
    """Joint prior of parameters with correlations, such as an earlier calibration.

    `labels` are paths such as `interior[kodak].c_mm` and `strips[a].shift_Z_m` (as in every table of parameters),
    `value` and `covariance` in the units of the parameters. Pass it as `adjust(block, more=...)` and set the parameters
    to FREE in `priors`.
    """

    labels: tuple[str, ...] = eqx.field(static=True)
    value: Float[ArrayLike, "n"]
    covariance: Float[ArrayLike, "n n"]
    reservation: str = eqx.field(static=True)
    """Warning about the source of the values, such as a calibration with the verdict FAIL; "" for none."""

    def __init__(
        self,
        labels: Sequence[str],
        value: Float[ArrayLike, "n"],
        covariance: Float[ArrayLike, "n n"],
        reservation: str = "",
    ):
        self.labels = tuple(map(table_name, labels))
        self.value, self.covariance, self.reservation = value, covariance, reservation
        n = len(self.labels)
        if np.shape(value) != (n,) or np.shape(covariance) != (n, n):
            raise ValueError(
                f"{n} labels need {n} values and a covariance matrix of {n} x {n}, got {np.shape(value)} and "
                f"{np.shape(covariance)}"
            )

    @property
    def doubt(self) -> str:
        """Return the warning together with the source of the parameters; "" for none."""
        if not self.reservation:
            return ""
        own = [label.removeprefix("interior[") for label in self.labels if label.startswith("interior[")]
        cameras = ", ".join(camera_words(name) for name in dict.fromkeys(label.rpartition("].")[0] for label in own))
        said = f"the calibration that {cameras} is from" if cameras else f"the prior information on {few(self.labels)}"
        return f"of {said}: {self.reservation}"
