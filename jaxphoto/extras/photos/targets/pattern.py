"""What every kind of calibration board is: targets with known coordinates, and a way to find them in a picture."""

import abc
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.extras.photos.targets.corners import TargetPlaces
from jaxphoto.procedures.calibration import Board


class FoundBoard(NamedTuple):
    """What a picture shows of a board."""

    point: Int[np.ndarray, "n"]
    """Index into the board's points."""
    places: TargetPlaces


class Pattern(abc.ABC):
    """A kind of calibration board; `board` has the coordinates of its targets."""

    board: Board

    @abc.abstractmethod
    def find(self, picture: np.ndarray) -> FoundBoard | None:
        """The board's targets in grey values (rows, columns) of 0 to 255; None where the board is not found."""

    @abc.abstractmethod
    def reflectance(self, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """What is printed at places of the board (m, in the frame of `board`): 0 black, 1 white."""

    def hint(self, pictures: Sequence[np.ndarray]) -> str | None:
        """What other board pictures without this one seem to show, where that can be said."""
        return None
