"""What every export writes: cameras, oriented photographs, object points and where photographs show them."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import still
from jaxphoto.block import Block, Frame
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.map_frame import map_system
from jaxphoto.io.exports.control_points import ControlPoints
from jaxphoto.unknowns import Unknowns

# Semi-major axis (m) of the ellipsoids of WGS 84 and of GRS 80, which differ by a tenth of a millimetre.
_WGS84_M = 6378137.0


class ExportCamera(NamedTuple):
    """A camera by its sensor and interior orientation."""

    sensor: Sensor
    interior: InteriorOrientation


class AdjustedPhotographs(NamedTuple):
    """Oriented photographs in the Cartesian frame of their block (docs/conventions.md), in metres and pixels.

    `files` are the names of the photographs; the ids where nobody said them. Colours of points are not known.
    """

    title: str
    cameras: dict[str, ExportCamera]
    images: tuple[str, ...]
    files: tuple[str, ...]
    image_camera: tuple[str, ...]
    exterior: ExteriorOrientation
    points: tuple[str, ...]
    xyz: Float[np.ndarray, "points 3"]
    image: Int[np.ndarray, "n"]
    """Of every image point, the photograph."""
    point: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    """Of every image point, in pixels; the centre of the upper left pixel is (0.5, 0.5)."""
    frame: Frame
    changes: tuple[str, ...] = ()
    """What the block corrects by, and no other program does: its points fit the photographs only together with it."""
    sigma_px: Float[np.ndarray, "n 2"] | None = None
    """Of every image point, the standard deviations that the block gives it, along columns and rows."""
    control: ControlPoints | None = None
    """Control and check points that the block knows; None, or none of them, where it has none."""

    @staticmethod
    def of(adjusted: Adjustment, files: Mapping[str, str] | None = None) -> "AdjustedPhotographs":
        """The values of an adjustment; `files` are names of photographs by the ids of images."""
        return AdjustedPhotographs.of_block(adjusted.block, adjusted.unknowns, files)

    @staticmethod
    def of_block(block: Block, unknowns: Unknowns, files: Mapping[str, str] | None = None) -> "AdjustedPhotographs":
        """The values `unknowns` of `block`. Raises InputError where two photographs have one file name."""
        named = tuple((files or {}).get(name, name) for name in block.images)
        if len(set(named)) < len(named):
            twice = next(name for name in named if named.count(name) > 1)
            raise InputError(f"two images are of the photograph {twice}; give each photograph one name")
        rows = block.image_points
        xy, image = still(rows.xy), np.asarray(rows.image)
        column_row, sigma_px = np.zeros((len(image), 2)), still(rows.sigma).copy()
        camera = np.array(block.image_camera, object)[image]
        used = dict.fromkeys(block.image_camera)
        for name in used:
            column_row[camera == name] = block.sensors[name].px_from_mm(xy[camera == name])
            sigma_px[camera == name] /= block.sensors[name].pixel_mm
        exterior = unknowns.exterior
        return AdjustedPhotographs(
            block.title,
            {name: ExportCamera(block.sensors[name], unknowns.interior[name]) for name in used},
            block.images,
            named,
            block.image_camera,
            ExteriorOrientation(still(exterior.position), still(exterior.camera_from_object)),
            block.points,
            still(unknowns.points),
            image,
            np.asarray(rows.point),
            column_row,
            block.frame,
            tuple(_changes(block, unknowns)),
            sigma_px,
            ControlPoints.of(block),
        )

    @property
    def rows_of_images(self) -> list[np.ndarray]:
        """The image points of each photograph, by their places, in the order in which they stand."""
        order = np.argsort(self.image, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.image, minlength=len(self.images)))[:-1])

    @property
    def rows_of_points(self) -> list[np.ndarray]:
        """The image points of each object point."""
        order = np.argsort(self.point, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.point, minlength=len(self.points)))[:-1])

    @property
    def place_in_image(self) -> Int[np.ndarray, "n"]:
        """Of every image point, its number among those of its photograph, from 0."""
        number = np.zeros(len(self.image), int)
        for rows in self.rows_of_images:
            number[rows] = np.arange(len(rows))
        return number

    @property
    def place(self) -> tuple[float, float, float] | None:
        """Longitude, latitude (degrees) and height (m) of the origin above the ellipsoid of WGS 84.

        None where the frame is not that of a map, or of one with another ellipsoid.
        """
        if self.frame.kind != "epsg" or self.frame.code is None or self.frame.origin is None:
            return None
        ellipsoid = map_system(self.frame.code).ellipsoid
        if ellipsoid is None or ellipsoid.semi_major_metre != _WGS84_M:
            return None
        # Numbers of NumPy have names in texts of other programs.
        longitude, latitude, height = map(float, self.frame.origin)
        return longitude, latitude, height


def downwards(exterior: ExteriorOrientation) -> Float[np.ndarray, "n 3 3"]:
    """Into the camera's axes of computer vision, x right, y down, z ahead, from those of the object."""
    return np.array([[1.0], [-1.0], [-1.0]]) * np.asarray(exterior.camera_from_object)


def translations(turns: Float[np.ndarray, "n 3 3"], exterior: ExteriorOrientation) -> Float[np.ndarray, "n 3"]:
    """t of x = R X + t, for cameras that `turns` bring into axes of theirs."""
    return -np.einsum("nij,nj->ni", turns, exterior.position)


def numbered(names: tuple[str, ...]) -> dict[str, int]:
    """The names as numbers where all are positive ones, otherwise counted from 1."""
    own = [int(name) if name.isascii() and name.isdigit() else 0 for name in names]
    kept = min(own, default=1) > 0 and len(set(own)) == len(own) and max(own, default=1) < 2**31
    return dict(zip(names, own if kept else range(1, len(names) + 1), strict=True))


def _changes(block: Block, unknowns: Unknowns) -> list[str]:
    found = [name for name in ("refraction", "curvature") if getattr(block.corrections, name)]
    bent = [kind for kind, owners in unknowns.tables.items() if any(type(p).bends for p in owners.values())]
    return ["earth curvature" if name == "curvature" else name for name in found] + bent
