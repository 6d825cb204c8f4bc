"""What a simulation is made from: everything but the seed.

What the block says and what is true are told apart everywhere: `Assumed` for parameters, `Sigmas` twice for noise.
"""

import dataclasses
from typing import Generic, Literal, TypeVar

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Datum
from jaxphoto.camera import InteriorOrientation, RollingShutter, Sensor
from jaxphoto.georeferencing import Mount, StripBias
from jaxphoto.parameters import AbstractParameters
from jaxphoto.short_repr import shown
from jaxphoto.simulation.convergent_plan import ConvergentPlan, Field
from jaxphoto.simulation.flight_plan import FlightPlan, Swaths
from jaxphoto.simulation.scan_plan import ScanPlan, Triple
from jaxphoto.simulation.settlement import Settlement
from jaxphoto.simulation.terrain import Terrain

Role = Literal["control", "vertical", "check", "tie"]
"""What a target is: control in X, Y and Z, control in Z only, a check point, or a tie point as good as a target."""
ROLES: tuple[Role, ...] = ("control", "vertical", "check", "tie")
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Assumed(Generic[T]):
    """Parameters as they are (`truth`), as the block starts with (`start`), and its priors for them."""

    truth: T
    start: T
    prior: T


@dataclasses.dataclass(frozen=True)
class SimulatedBias:
    """Shift (m) and drift (m/s) of the GNSS positions of a strip.

    Truth is `truth` plus, for each strip by itself, normal shifts and drifts of `shift_sigma_m` and
    `drift_sigma_m_per_s`. `model` is the block's start and prior, None where the block knows of no bias.
    """

    truth: StripBias
    shift_sigma_m: Triple = (0.0, 0.0, 0.0)
    drift_sigma_m_per_s: Triple = (0.0, 0.0, 0.0)
    model: tuple[StripBias, StripBias] | None = None


@dataclasses.dataclass(frozen=True)
class SimulatedShutter:
    """The rolling shutter of a camera; `model` is the block's start and prior, None where the block knows of none.

    Motions of its images are told to the block with normal errors of `velocity_m_per_s` and `rate_deg_per_s`, and
    observed with these standard deviations; exactly, and held, where these are zero.
    """

    truth: RollingShutter
    velocity_m_per_s: float = 0.0
    rate_deg_per_s: float = 0.0
    model: tuple[RollingShutter, RollingShutter] | None = None


@dataclasses.dataclass(frozen=True)
class SimulatedChange:
    """How a camera changes during the flight, or in a strip.

    Truth is `truth`, plus what is drawn where the same field of `spread`, a tree of priors, is `Weighted`. `model` is
    the block's start and prior, None where it knows of no change.
    """

    truth: AbstractParameters
    spread: AbstractParameters
    model: tuple[AbstractParameters, AbstractParameters] | None = None


@dataclasses.dataclass(frozen=True)
class CameraWalk:
    """A random walk of c, x_p and y_p (mm) from strip to strip: standard deviations of a step of an hour.

    `truth` is how far cameras of strips truly walk, `stated` what the block says of it in `StripCameraSteps`; None
    where it says nothing.
    """

    truth: Triple
    stated: Triple | None = None


@dataclasses.dataclass(frozen=True)
class Cooling:
    """The temperature of the cameras (degrees Celsius): it approaches that of the air by Newton's law of cooling.

    t after the first exposure it is air + (begin - air) exp(-t / time constant). The block knows it, and takes the
    interior orientation to be that at `reference_c`.
    """

    begin_c: float
    air_c: float
    time_constant_s: float
    reference_c: float

    def at(self, time: Float[np.ndarray, "images"]) -> Float[np.ndarray, "images"]:
        """At times (s) on any clock, of which the first is the least."""
        gone = (time - np.min(time)) / self.time_constant_s
        return self.air_c + (self.begin_c - self.air_c) * np.exp(-gone)


@dataclasses.dataclass(frozen=True)
class Jitter:
    """Standard deviations by which a flight, or a convergent set, leaves its plan.

    `position_m` per axis X, Y, Z; `angle_deg` of roll and of pitch; `crab_deg` of yaw against the track (the track
    stays); `rate_deg_per_s` of the rates of turn about right, forward and up. In a convergent set `angle_deg` is that
    of the aim, about the camera's x and y axes, and `crab_deg` that of the roll.
    """

    position_m: Triple = (0.0, 0.0, 0.0)
    angle_deg: float = 0.0
    crab_deg: float = 0.0
    rate_deg_per_s: float = 0.0


@dataclasses.dataclass(frozen=True)
class PointPlan:
    """How many tie points there are, where, and what is measured.

    Points lie in the swaths (`Swaths`: `across`, `ends`) or the `Field`, and are seen in `min_images` images at least,
    with `margin_mm` to the edge of the format. Every image that sees a point measures it, unless `mean_rays` says to
    how many images a point, on average over all points, rays are thinned out by chance. Where there are buildings, the
    part `on_roofs` of the tie points lies on them, the others on ground and roofs alike; none is near a wall or crown.
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
    """Targets of a group that play another role: the `outermost` of each arm, the one at the `centre`, the `first`.

    Arms lead from the middle of the block both ways along each direction in which strips are flown, or each side of a
    field. A target is chosen once: the rule that comes to it later takes its next one.
    """

    role: Role
    outermost: int = 0
    centre: bool = False
    first: int = 0


@dataclasses.dataclass(frozen=True)
class TargetPlan:
    """Signalised points of one role: `count` of them uniform over the ground, and those at given places.

    `at_m` gives (X, Y) or (X, Y, Z) in m; `at` gives places as parts of half the block's length and width, along and
    to the right of the first strip's heading, from the middle of the block; in a field along X and Y.
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
    places and turns of cameras in their rig, positions and attitudes beside those of the exposure before.

    None where these are not observed.
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
    """Standard deviations of the approximate values: of orientations, and of all points where they are given."""

    position_m: float = 5.0
    angle_deg: float = 1.0
    points_m: float | None = None


@shown
@dataclasses.dataclass(frozen=True)
class Recipe:
    """A simulation but for its seed.

    `mounts` are by name, "default" or that of a camera, `shutters` by camera; `biases` by name, "default" or that of a
    strip; `changes` of cameras by kind and owner; `rig` has the cameras of a rig beside the one that is flown. `stated`
    sigmas are those of the block's observations, `noise` those by which these are truly off. `datum_offset_m` is added
    to all observed stations and is in no model. `settlement` is what stands on the terrain; `lidar` scans both, in
    strips.
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
        """Where points lie."""
        if isinstance(self.plan, ConvergentPlan):
            return self.plan.field
        return Swaths(self.plan.strips, self.points.across, self.points.ends)

    def mount_of(self, camera: str) -> str:
        """The name of a camera's mount: its own, "default", or "" without any."""
        return camera if camera in self.mounts else "default" if "default" in self.mounts else ""


def triple(values: Triple) -> Float[np.ndarray, "3"]:
    """A triple of the recipe as an array."""
    return np.array(values, float)
