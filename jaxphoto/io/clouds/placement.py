"""From the coordinates of a cloud or raster to the frame of a block, and back."""

import dataclasses
import warnings

import numpy as np
from jaxtyping import Float
from pyproj import CRS, Transformer

from jaxphoto.block import Frame
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.datum_change import ways
from jaxphoto.georeferencing.map_frame import MapFrame, Place, map_system
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem


class Placement:
    """The way from coordinates of the file `name`, in `system`, to the frame of a block (m), and back.

    Without a frame coordinates stay those of the file, in metres. A frame `local` or `enu` takes those of a file
    without a system as they stand, `grid` those of a map too. A frame `epsg` takes them through its map system to its
    local frame; heights of which the file says nothing are taken to be those of the block.

    Raises InputError where the file's system and the frame cannot meet; `option` is what names the file's system.
    """

    def __init__(self, name: str, system: CoordinateSystem, frame: Frame | None, option: str = "--cloud-epsg"):
        self.name, self.system, self.option = name, system, option
        _check_kinds(name, system, frame, option)
        self._map: MapFrame | None = None
        self._plane: Transformer | None = None
        if frame is not None and frame.kind == "epsg":
            assert system.plane is not None
            self._map = frame.map
            if system.heights is not None:
                self._map = _with_heights(self._map, system.heights, name)
            self._height_unit = system.heights_unit if isinstance(system.heights, int) else 1.0
            block_plane = map_system(self._map.code)
            if not system.plane.equals(block_plane, ignore_axis_order=True):
                self._plane = _between(system.plane, block_plane, self._map.origin, name)

    def frame(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """X, Y, Z (m) in the frame of the block, of coordinates of the file; infinite where a system does not reach."""
        return self.frame_from_metres(self.system.metres(xyz))

    def frame_from_metres(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The same of coordinates in the file's system that are in metres already (degrees stay degrees)."""
        if self._map is None:
            return xyz
        x, y, z = xyz.T
        if self._plane is not None:
            x, y = self._plane.transform(x, y)
        return self._map.local(np.stack([x, y, z / self._height_unit], axis=1))

    def metres(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Coordinates in the file's system, in metres, of X, Y, Z (m) in the frame of the block."""
        if self._map is None:
            return xyz
        x, y, z = self._map.map(xyz).T
        if self._plane is not None:
            x, y = self._plane.transform(x, y, direction="INVERSE")
        return np.stack([x, y, z * self._height_unit], axis=1)

    def file(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Coordinates as the file counts them: the inverse of `frame`."""
        return self.system.own(self.metres(xyz))

    def extent(self, extent: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 3"]:
        """Least and greatest X, Y, Z (m) in the frame of the block, of those of the file: of points along its edges."""
        x, y, z = (np.linspace(low, high, 9) for low, high in extent.T)
        around = np.stack(np.meshgrid(x, y, z[[0, -1]], indexing="ij"), axis=-1).reshape(-1, 3)
        placed = self.frame(around)
        return np.stack([placed.min(axis=0), placed.max(axis=0)])

    def checked(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """`frame`, but InputError where a coordinate lies where a system does not reach."""
        placed = self.frame(xyz)
        lost = ~np.isfinite(placed).all(axis=1)
        if lost.any():
            at = ", ".join(f"{value:.2f}" for value in xyz[lost][0])
            raise InputError(
                f"{self.name}: the point ({at}) lies where {self.system.name} or the block's system does not reach; "
                f"name the system of the file ({self.option})"
            )
        return placed

    def placed(self, cloud: Cloud) -> Cloud:
        """A cloud in coordinates of the file, in the frame of the block. Raises as `checked`."""
        return dataclasses.replace(cloud, xyz=self.checked(cloud.xyz))


def _check_kinds(name: str, system: CoordinateSystem, frame: Frame | None, option: str) -> None:
    kind = "local" if frame is None else frame.kind
    if frame is None:
        if system.geographic:
            raise InputError(
                f"{name} is in {system.name}, in degrees, which is no frame in metres; convert it to a map system, or "
                "use it with a block of frame epsg"
            )
    elif kind == "epsg" and system.plane is None:
        raise InputError(
            f"{name} does not say which system its coordinates are in, but the block is in EPSG:{frame.code}; name it "
            f"({option})"
        )
    elif kind in ("local", "enu") and system.plane is not None:
        raise InputError(
            f"{name} is in {system.name}, but the block's frame is {kind}, which has no place in it; give the block a "
            "frame of kind epsg, or bring the file to the block's frame and write it without a system"
        )
    elif kind == "grid" and system.geographic:
        raise InputError(
            f"{name} is in {system.name}, in degrees, but the block's frame is a map grid; convert the file to it"
        )


def _with_heights(frame: MapFrame, heights: int | str, name: str) -> MapFrame:
    """The same local frame, from heights of the file's own system."""
    try:
        return MapFrame(frame.code, heights if isinstance(heights, int) else None, frame.origin)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _between(source: CRS, target: CRS, place: Place, name: str) -> Transformer:
    """Plane coordinates from one system to another, by the best way about `place` that PROJ has on this computer."""
    group = ways(source, target, place[0], place[1])
    if not group.transformers:
        raise InputError(f"{name}: PROJ knows no way from {source.name} to {target.name}; convert the file")
    best = group.transformers[0]
    same = source.geodetic_crs and target.geodetic_crs and source.geodetic_crs.datum == target.geodetic_crs.datum
    if "Ballpark" in best.description and not same:
        warnings.warn(
            f"{name}: PROJ knows no transformation between the datums of {source.name} and {target.name}; they are "
            "taken to be the same, which can be wrong by some metres",
            UserWarning,
            stacklevel=2,
        )
    return best
