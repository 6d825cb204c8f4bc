"""Settings of the comparison of strips, and prior standard deviations of trajectory errors."""

import dataclasses

import numpy as np

from jaxphoto.errors import InputError

_POSITIVE = (
    "cell_m", "roughness_m", "least_roughness_m", "normals_deg", "outlier", "knots_s", "correlation_s",
    "sigma_position_m", "sigma_attitude_deg", "sigma_heading_deg", "sigma_exposure_m", "sigma_exposure_deg",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class StripSettings:
    """Planes are fitted in cells of `cell_m` with at least `returns` returns, and a roughness of at most `roughness_m`.

    Normals of two strips agree to `normals_deg`; at most `most` planes of all pairs of strips together are observed. A
    gap of more than `outlier` standard deviations is rejected. The trajectory's knots are `knots_s` apart; its errors
    have `sigma_position_m`, `sigma_attitude_deg` (about right and forward) and `sigma_heading_deg`, and the correlation
    time `correlation_s` (`observations.knot_steps`). Poses of exposures have these errors and, independently,
    `sigma_exposure_m` and `sigma_exposure_deg`.
    """

    cell_m: float = 3.0
    returns: int = 10
    roughness_m: float = 0.06
    least_roughness_m: float = 0.005
    normals_deg: float = 5.0
    outlier: float = 4.0
    most: int = 4000
    knots_s: float = 10.0
    correlation_s: float = 100.0
    sigma_position_m: float = 0.08
    sigma_attitude_deg: float = 0.005
    sigma_heading_deg: float = 0.01
    sigma_exposure_m: float = 0.01
    sigma_exposure_deg: float = 0.002

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value:g}: give a positive number")
        if self.returns < 4 or self.most < 1:
            raise InputError(
                f"a plane needs 4 returns and an adjustment 1 plane, got returns {self.returns} and most {self.most}"
            )

    @property
    def sigma_attitude(self) -> np.ndarray:
        """About right, forward and up (rad)."""
        return np.deg2rad([self.sigma_attitude_deg, self.sigma_attitude_deg, self.sigma_heading_deg])
