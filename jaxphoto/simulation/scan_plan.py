"""The laser scanner as planned: which strips, how wide and how dense, and what is wrong with its georeferencing."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxphoto.georeferencing import Pattern
from jaxphoto.simulation.flight_plan import Strip

Triple = tuple[float, float, float]
_ZERO = (0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class ScanPlan:
    """A scanner that sweeps across the track, line after line, `scan_angle_deg` to either side of the body's nadir.

    One whose `pattern` is a "circle" looks through two prisms that turn against one another, as far to all sides.
    `density_per_m2` is that of the pulses of one strip on level ground at the mean height of the terrain. It scans the
    flight's own strips, or `strips` of a flight of its own. `boresight_deg` (about the body's right, forward and up
    axes) is the true misalignment; the true shift of a strip is that of `shift_m`, by its name or "default", plus a
    normal one of `shift_sigma_m`: by so much the trajectory of the strip, and so its points, are off. On top of it
    position and attitude (about right, forward, up) drift with `drift_sigma_m`, `drift_sigma_deg` and `correlation_s`,
    from knot to knot `knots_s` apart. `lever_arm_m`, `range_offset_m` and the scales are those of
    `georeferencing.ScannerCalibration`. With `same_trajectory` the stations and attitudes of the exposures are those of
    this trajectory, with all that it is off by; their noise comes on top.
    """

    density_per_m2: float
    scan_angle_deg: float = 20.0
    pattern: Pattern = "line"
    strips: tuple[Strip, ...] = ()
    boresight_deg: Triple = _ZERO
    shift_m: dict[str, Triple] = dataclasses.field(default_factory=dict)
    shift_sigma_m: Triple = _ZERO
    drift_sigma_m: Triple = _ZERO
    drift_sigma_deg: Triple = _ZERO
    correlation_s: float = 100.0
    knots_s: float = 5.0
    lever_arm_m: Triple = _ZERO
    range_offset_m: float = 0.0
    range_scale_ppm: float = 0.0
    angle_scale_ppm: float = 0.0
    same_trajectory: bool = False

    @property
    def half_width(self) -> float:
        """Of the swath, as part of the height above ground: the tangent of the scan angle."""
        return float(np.tan(np.deg2rad(self.scan_angle_deg)))

    def shift_of(self, strip: str) -> Float[np.ndarray, "3"]:
        """What the plan says of a strip's shift (m), without chance."""
        return np.array(self.shift_m.get(strip, self.shift_m.get("default", _ZERO)))
