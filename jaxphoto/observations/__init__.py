"""Observations: one file each declares its rows, what a row touches, and the residual of one row."""

from jaxphoto.observations.attitudes import ATTITUDE_AXES, Attitudes
from jaxphoto.observations.base import AXES, AbstractCoordinates, AbstractObservations, ImageState, touching
from jaxphoto.observations.columns import Column, columns_of, sigma_key
from jaxphoto.observations.control import ControlRows
from jaxphoto.observations.correlated import Correlated, correlated, exponential_covariance
from jaxphoto.observations.distances import Distances
from jaxphoto.observations.image_points import ImageRows
from jaxphoto.observations.priors import (
    PRIORS,
    KnownParameters,
    ParameterRows,
    PointRows,
    PositionRows,
    RotationRows,
)
from jaxphoto.observations.stations import StationRows
from jaxphoto.observations.surfaces import SurfaceRows

OBSERVATIONS: tuple[type[AbstractObservations], ...] = (
    ImageRows,
    StationRows,
    Attitudes,
    ControlRows,
    SurfaceRows,
    Distances,
    PositionRows,
    RotationRows,
    PointRows,
)
"""The classes whose tables a block folder may hold; a class of your own is given to `read_block`."""

__all__ = [
    "ATTITUDE_AXES", "AXES", "OBSERVATIONS", "PRIORS", "AbstractCoordinates", "AbstractObservations", "Attitudes",
    "Column", "ControlRows", "Correlated", "Distances", "ImageRows", "ImageState", "KnownParameters", "ParameterRows",
    "PointRows", "PositionRows", "RotationRows", "StationRows", "SurfaceRows", "columns_of", "correlated",
    "exponential_covariance", "sigma_key", "touching",
]  # fmt: skip
