"""Recipe of a simulation: everything but the seed.

The model of the block and the truth are separate: `Assumed` for parameters, `Sigmas` twice for noise.
"""

import dataclasses
from typing import Generic, Literal, TypeVar

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Datum
from jaxphoto.camera import InteriorOrientation, RollingShutter, Sensor
from jaxphoto.georeferencing import Mount, StripBias
from jaxphoto.parameters import AbstractParameters
from jaxphoto.short_repr import pretty_repr
from jaxphoto.simulation.plans import ConvergentPlan, Field, FlightPlan, ScanPlan, Swaths, Triple
from jaxphoto.simulation.scene import Settlement, Terrain

Role = Literal["control", "vertical", "check", "tie"]
"""Role of a target: control in X, Y and Z, control in Z only, check point, or tie point of a target's precision."""
ROLES: tuple[Role, ...] = ("control", "vertical", "check", "tie")
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Assumed(Generic[T]):
    """Parameters: `truth`, `start` of the block, and its priors."""

    truth: T
    start: T
    prior: T


@dataclasses.dataclass(frozen=True)
class SimulatedBias:
    """Shift (m) and drift (m/s) of the GNSS positions of a strip.

    Truth is `truth` plus normal shifts and drifts of `shift_sigma_m` and `drift_sigma_m_per_s` for each strip. `model`
    is the block's start and prior, None if the block models no bias.
    """

    truth: StripBias
    shift_sigma_m: Triple = (0.0, 0.0, 0.0)
    drift_sigma_m_per_s: Triple = (0.0, 0.0, 0.0)
    model: tuple[StripBias, StripBias] | None = None


@dataclasses.dataclass(frozen=True)
class SimulatedShutter:
    """Rolling shutter of a camera; `model` is the block's start and prior, None if the block models none.

    The block receives motions of its images with normal errors of `velocity_m_per_s` and `rate_deg_per_s`, observed
    with these standard deviations; exact and fixed if these are zero.
    """

    truth: RollingShutter
    velocity_m_per_s: float = 0.0
    rate_deg_per_s: float = 0.0
    model: tuple[RollingShutter, RollingShutter] | None = None


@dataclasses.dataclass(frozen=True)
class SimulatedChange:
    """Change of a camera during the flight, or in a strip.

    Truth is `truth`, plus a random part where the same field of `spread`, a tree of priors, is `Weighted`. `model` is
    the block's start and prior, None if it models no change.
    """

    truth: AbstractParameters
    spread: AbstractParameters
    model: tuple[AbstractParameters, AbstractParameters] | None = None


@dataclasses.dataclass(frozen=True)
class CameraWalk:
    """Random walk of c, x_p and y_p (mm) from strip to strip: standard deviations of a step of an hour.

    `truth` is the true walk, `stated` that of the block's `StripCameraSteps`; None if it has none.
    """

    truth: Triple
    stated: Triple | None = None


@dataclasses.dataclass(frozen=True)
class Cooling:
    """Camera temperature (degrees Celsius), approaching that of the air by Newton's law of cooling.

    t after the first exposure it is air + (begin - air) exp(-t / time constant). The block knows it; its interior
    orientation refers to `reference_c`.
    """

    begin_c: float
    air_c: float
    time_constant_s: float
    reference_c: float

    def at(self, time: Float[np.ndarray, "images"]) -> Float[np.ndarray, "images"]:
        """Return temperatures at times (s) on any clock; the earliest is the first exposure."""
        gone = (time - np.min(time)) / self.time_constant_s
        return self.air_c + (self.begin_c - self.air_c) * np.exp(-gone)


@dataclasses.dataclass(frozen=True)
class Jitter:
    """Standard deviations of a flight, or a convergent set, about its plan.

    `position_m` per axis X, Y, Z; `angle_deg` of roll and of pitch; `crab_deg` of yaw against the track (the track
    stays); `rate_deg_per_s` of the rotation rates about right, forward and up. In a convergent set `angle_deg` is that
    of the aim, about the camera's x and y axes, and `crab_deg` that of the roll.
    """

    position_m: Triple = (0.0, 0.0, 0.0)
    angle_deg: float = 0.0
    crab_deg: float = 0.0
    rate_deg_per_s: float = 0.0


@dataclasses.dataclass(frozen=True)
class PointPlan:
    """Number, area and visibility of tie points.

    Points lie in the swaths (`Swaths`: `across`, `ends`) or the `Field`, and are visible in at least `min_images`
    images, `margin_mm` from the edge of the format. Every such image measures the point, unless `mean_rays` sets the
    average number of rays per point, to which rays are thinned at random. With buildings, the fraction `on_roofs` of
    the tie points lies on them, the others on ground and roofs alike; none is close to a wall or crown.
    """

    ties: int
    min_images: int = 2
    mean_rays: float | None = None
    across: float = 0.95
    ends: float = 0.0
    margin_mm: float = 0.0
    on_roofs: float = 0.2


@dataclasses.dataclass(frozen=True)
class Choice:
    """Targets of a group with another role: the `outermost` of each arm, the one at the `centre`, the `first`.

    Arms lead from the centre of the block in both directions of the strips, or along each side of a field. A target is
    chosen once: a later rule takes its next one.
    """

    role: Role
    outermost: int = 0
    centre: bool = False
    first: int = 0


@dataclasses.dataclass(frozen=True)
class TargetPlan:
    """Signalised points of one role: `count` uniformly distributed, and those at given places.

    `at_m` gives (X, Y) or (X, Y, Z) in m; `at` gives places as fractions of half the block's length and width, along
    and to the right of the first strip's heading, from the centre of the block; in a field along X and Y.
    """

    role: Role
    prefix: str = "T"
    count: int = 0
    at_m: tuple[tuple[float, ...], ...] = ()
    at: tuple[tuple[float, float], ...] = ()
    choice: Choice | None = None


@dataclasses.dataclass(frozen=True)
class Sigmas:
    """Standard deviations of tie points and targets in the images, control, stations, attitudes, laser points,
    positions and rotations of rig cameras, and relative positions and attitudes of successive exposures.

    None if not observed.
    """

    image_mm: float
    target_mm: float
    control_m: Triple | None = None
    station_m: Triple | None = None
    attitude_deg: Triple | None = None
    lidar_m: Triple | None = None
    rig_place_m: Triple | None = None
    rig_turn_deg: Triple | None = None
    relative_position_m: Triple | None = None
    relative_attitude_deg: Triple | None = None


@dataclasses.dataclass(frozen=True)
class Approximation:
    """Standard deviations of the approximate values: of orientations, and of all points if given."""

    position_m: float = 5.0
    angle_deg: float = 1.0
    points_m: float | None = None


@pretty_repr
@dataclasses.dataclass(frozen=True)
class Recipe:
    """Recipe of a simulation, without its seed.

    `mounts` are by name, "default" or that of a camera, `shutters` by camera; `biases` by name, "default" or that of a
    strip; `changes` of cameras by kind and owner; `rig` has the other cameras of a rig. `stated` sigmas are those of
    the block's observations, `noise` those of their true errors. `datum_offset_m` is added to all observed stations and
    is not modelled. `settlement` are buildings and trees on the terrain; `lidar` scans both, in strips.
    """

    title: str
    sensors: dict[str, Sensor]
    cameras: dict[str, Assumed[InteriorOrientation]]
    plan: FlightPlan | ConvergentPlan
    points: PointPlan
    stated: Sigmas
    noise: Sigmas
    targets: tuple[TargetPlan, ...] = ()
    mounts: dict[str, Assumed[Mount]] = dataclasses.field(default_factory=dict)
    biases: dict[str, SimulatedBias] = dataclasses.field(default_factory=dict)
    shutters: dict[str, SimulatedShutter] = dataclasses.field(default_factory=dict)
    changes: dict[str, dict[str, SimulatedChange]] = dataclasses.field(default_factory=dict)
    temperature: Cooling | None = None
    walk: CameraWalk | None = None
    rig: dict[str, SimulatedChange] = dataclasses.field(default_factory=dict)
    datum_offset_m: Triple = (0.0, 0.0, 0.0)
    jitter: Jitter = Jitter()
    terrain: Terrain = dataclasses.field(default_factory=Terrain)
    start: Approximation = Approximation()
    datum: Datum = dataclasses.field(default_factory=Datum)
    settlement: Settlement = dataclasses.field(default_factory=Settlement)
    lidar: ScanPlan | None = None

    @property
    def ground(self) -> Swaths | Field:
        """Area of the points."""
        if isinstance(self.plan, ConvergentPlan):
            return self.plan.field
        return Swaths(self.plan.strips, self.points.across, self.points.ends)

    def mount_of(self, camera: str) -> str:
        """Return the name of a camera's mount: its own, "default", or "" without any."""
        return camera if camera in self.mounts else "default" if "default" in self.mounts else ""


def triple(values: Triple) -> Float[np.ndarray, "3"]:
    """Return a triple of the recipe as an array."""
    return np.array(values, float)
