"""The laser scanner as planned: which strips, how wide and how dense, and what is wrong with its georeferencing."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxphoto.simulation.flight_plan import Strip

Triple = tuple[float, float, float]
_ZERO = (0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class ScanPlan:
    """A scanner that sweeps across the track, line after line, `scan_angle_deg` to either side of the body's nadir.

    `pattern` is one of `georeferencing.PATTERN_OF`: one that is "oscillating" sweeps to and fro; a "circle" or "risley"
    looks through two prisms that turn against one another, as far to all sides, one that is "nutating" always so far.
    `density_per_m2` is that of the pulses of one strip on level ground at the mean height of the terrain. It scans the
    flight's own strips, or `strips` of a flight of its own. `boresight_deg` (about the body's right, forward and up
    axes) is the true misalignment; the true shift of a strip is that of `shift_m`, by its name or "default", plus a
    normal one of `shift_sigma_m`: by so much the trajectory of the strip, and so its points, are off. Likewise its
    attitude is off by `attitude_deg` (about right, forward, up). From the middle of the strip on both go on by
    `drift_m_per_s` and `attitude_drift_deg_per_s`; on top of it they drift by chance with `drift_sigma_m`,
    `drift_sigma_deg` and `correlation_s`, from knot to knot `knots_s` apart. `lever_arm_m`, `range_offset_m`, the
    scales, `eccentricity_deg` (of cos and sin) and `time_offset_s` are those of `georeferencing.ScannerCalibration`.
    With `same_trajectory` the stations and attitudes of the exposures are those of this trajectory, with all that it is
    off by; their noise comes on top.
    """

    density_per_m2: float
    scan_angle_deg: float = 20.0
    pattern: str = "line"
    strips: tuple[Strip, ...] = ()
    boresight_deg: Triple = _ZERO
    shift_m: dict[str, Triple] = dataclasses.field(default_factory=dict)
    drift_m_per_s: dict[str, Triple] = dataclasses.field(default_factory=dict)
    attitude_deg: dict[str, Triple] = dataclasses.field(default_factory=dict)
    attitude_drift_deg_per_s: dict[str, Triple] = dataclasses.field(default_factory=dict)
    shift_sigma_m: Triple = _ZERO
    drift_sigma_m: Triple = _ZERO
    drift_sigma_deg: Triple = _ZERO
    correlation_s: float = 100.0
    knots_s: float = 5.0
    lever_arm_m: Triple = _ZERO
    range_offset_m: float = 0.0
    range_scale_ppm: float = 0.0
    angle_scale_ppm: float = 0.0
    eccentricity_deg: tuple[float, float] = (0.0, 0.0)
    time_offset_s: float = 0.0
    same_trajectory: bool = False

    @property
    def half_width(self) -> float:
        """Of the swath, as part of the height above ground: the tangent of the scan angle."""
        return float(np.tan(np.deg2rad(self.scan_angle_deg)))


def of_strip(values: dict[str, Triple], strip: str) -> Float[np.ndarray, "3"]:
    """Return the planned value of a strip, by its name or "default", without random parts."""
    return np.array(values.get(strip, values.get("default", _ZERO)))
