"""Observations: each file declares one kind of rows, the unknowns of a row, and the residual of a row.

To add a kind, add its file to this folder and its import below.
"""

import dataclasses
from typing import TYPE_CHECKING

from jaxphoto.observations.base import AXES as AXES
from jaxphoto.observations.base import AbstractCoordinates as AbstractCoordinates
from jaxphoto.observations.base import AbstractObservations as AbstractObservations
from jaxphoto.observations.base import ImageState as ImageState
from jaxphoto.observations.base import index_of as index_of

# The order of imports is the order in tables and files.
# ruff: isort: off
from jaxphoto.observations.image_points import ImagePoints as ImagePoints
from jaxphoto.observations.stations import CameraPositions as CameraPositions
from jaxphoto.observations.attitudes import ATTITUDE_AXES as ATTITUDE_AXES, Attitudes as Attitudes
from jaxphoto.observations.control import ControlCoordinates as ControlCoordinates
from jaxphoto.observations.surfaces import SurfaceRows as SurfaceRows
from jaxphoto.observations.strip_planes import StripPlanes as StripPlanes
from jaxphoto.observations.strip_points import StripPoints as StripPoints
from jaxphoto.observations.trajectory_poses import TrajectoryStations as TrajectoryStations
from jaxphoto.observations.trajectory_poses import TrajectoryAttitudes as TrajectoryAttitudes
from jaxphoto.observations.knot_steps import PositionSteps as PositionSteps, AttitudeSteps as AttitudeSteps
from jaxphoto.observations.strip_camera_steps import StripCameraSteps as StripCameraSteps
from jaxphoto.observations.rig_poses import RigPlaces as RigPlaces, RigTurns as RigTurns
from jaxphoto.observations.relative_poses import RelativePositions as RelativePositions
from jaxphoto.observations.relative_poses import RelativeAttitudes as RelativeAttitudes
from jaxphoto.observations.distances import Distances as Distances
from jaxphoto.observations.priors import PositionRows as PositionRows
from jaxphoto.observations.priors import RotationRows as RotationRows, PointRows as PointRows

# ruff: isort: on
from jaxphoto.observations.columns import Column as Column
from jaxphoto.observations.columns import columns_of as columns_of
from jaxphoto.observations.columns import sigma_key as sigma_key
from jaxphoto.observations.correlated import Correlated as Correlated
from jaxphoto.observations.correlated import correlated as correlated
from jaxphoto.observations.correlated import exponential_covariance as exponential_covariance
from jaxphoto.observations.correlated import is_covariance as is_covariance
from jaxphoto.observations.priors import PRIORS as PRIORS
from jaxphoto.observations.priors import KnownParameters as KnownParameters
from jaxphoto.observations.priors import ParameterRows as ParameterRows


def _has_a_table(kind: object) -> bool:
    """Return True for classes with a file: classes with a group that do not refer to parameters, which have no ids."""
    if not (isinstance(kind, type) and issubclass(kind, AbstractObservations) and kind.__dict__.get("group")):
        return False
    return all(f.metadata.get("touches") != "parameter" for f in dataclasses.fields(kind))


OBSERVATIONS: tuple[type[AbstractObservations], ...] = tuple(filter(_has_a_table, list(globals().values())))
"""Classes whose tables a block folder may contain; pass user-defined classes to `read_block`."""

if not TYPE_CHECKING:
    # Type checkers read a computed list as empty; the aliases above export the names.
    __all__ = sorted(
        name
        for name, what in globals().items()
        if name[0] != "_" and (isinstance(what, str | tuple) or getattr(what, "__module__", "").startswith(__name__))
    )
