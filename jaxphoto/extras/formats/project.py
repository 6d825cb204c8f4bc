"""The neutral model of every format: cameras, oriented images, object points, image points and control."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block, Frame
from jaxphoto.camera import set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, few, quoted
from jaxphoto.extras.formats.camera_models import ProjectCamera
from jaxphoto.georeferencing.map_frame import MapFrame, Place, map_name, map_system, place_from_geocentric
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.block_folder.settings import frame_section
from jaxphoto.io.block_folder.table_layout import ANGLES, SIGMA_XYZ, coordinate_names
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import ControlCoordinates
from jaxphoto.procedures.control.surveyed import SIGMA_M, system_of
from jaxphoto.procedures.georeference_photographs import utm_of
from jaxphoto.unknowns import FIXED, FREE, Unknowns

_PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".jp2", ".ppm", ".pgm", ".dng")
# Rounded digits leave R R' off from I by no more.
_ROTATION_TOLERANCE = 1e-3
# An orientation needs so many points, the datum of a block so many control points.
_LEAST = 3
# Standard deviation of a fixed coordinate in formats without fixed ones.
_FIXED_M = 1e-4
# Semi-major axis (m) of the ellipsoids of WGS 84 and of GRS 80, which differ by 0.1 mm.
_WGS84_M = 6378137.0
WGS84 = 4326
# Distances (m) of places from the centre of the earth.
_EARTH_M = (6.3e6, 6.5e6)
# Largest distance from the origin of a block's frame.
_NEAR_M = 100e3


class ControlPoints(NamedTuple):
    """Control and check points, in the coordinates of their project.

    A point that is control in some coordinates and a check in others is control in the former alone.
    """

    point: Int[np.ndarray, "known"]
    """Index into the points of the project."""
    xyz: Float[np.ndarray, "known 3"]
    """NaN for a coordinate that is not given."""
    sigma_m: Float[np.ndarray, "known 3"]
    """NaN if there is none; 0.1 mm for a fixed coordinate."""
    check: Bool[np.ndarray, "known"]

    @staticmethod
    def of(block: Block) -> "ControlPoints":
        """Return those of a block, control first."""
        control = _points([(block.control, np.nan), (block.fixed, _FIXED_M)], len(block.points))
        check = _points([(block.check, np.nan)], len(block.points))
        only = ~np.isin(check.point, control.point)
        point, xyz, sigma, _ = (np.concatenate([a, b[only]]) for a, b in zip(control, check, strict=True))
        return ControlPoints(point, xyz, sigma, np.arange(len(point)) >= len(control.point))


def _points(kinds: list[tuple[ControlCoordinates, float]], n_points: int) -> ControlPoints:
    """Rows by point, each kind with the standard deviation that stands for none."""
    xyz, sigma = np.full((n_points, 3), np.nan), np.full((n_points, 3), np.nan)
    for rows, none in kinds:
        at, sigmas = (np.asarray(rows.who), np.asarray(rows.axis)), np.asarray(rows.sigma)
        xyz[at], sigma[at] = np.asarray(rows.value), np.where(sigmas > 0, sigmas, none)
    known = np.flatnonzero(~np.isnan(xyz).all(axis=1))
    return ControlPoints(known, xyz[known], sigma[known], np.zeros(len(known), bool))


class Project(NamedTuple):
    """Oriented images with their tie points; metres, pixels, and the axes of docs/conventions.md."""

    title: str
    cameras: Mapping[str, ProjectCamera]
    images: Sequence[str]
    """Ids; if empty, `tables` makes them of the names of the files."""
    files: Sequence[str]
    image_camera: Sequence[str]
    exterior: ExteriorOrientation
    points: Sequence[str]
    xyz: Float[np.ndarray, "points 3"] | None
    """None if the file has no object points."""
    image: Int[np.ndarray, "n"]
    """Index of the image of every image point."""
    point: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    """In pixels; the centre of the upper left one is (0.5, 0.5)."""
    frame: Frame = Frame("local")
    changes: tuple[str, ...] = ()
    """Corrections of the block that other programs do not have."""
    sigma_px: Float[np.ndarray, "n 2"] | None = None
    """Standard deviations along columns and rows; NaN or None if unknown."""
    control: ControlPoints | None = None
    on_map: bool = False
    """True if coordinates are those of the frame's map and rotations refer to grid east, grid north and up at each
    image; False for the Cartesian frame of the block."""
    file: str = ""
    """The file that was read, for messages."""

    @staticmethod
    def of(adjusted: Adjustment, files: Mapping[str, str] | None = None) -> "Project":
        """Return the values of an adjustment; `files` are names of photographs by ids of images."""
        return Project.of_block(adjusted.block, adjusted.unknowns, files)

    @staticmethod
    def of_block(block: Block, unknowns: Unknowns, files: Mapping[str, str] | None = None) -> "Project":
        """Return the values `unknowns` of `block`. Raise InputError if two photographs have one file name."""
        names = tuple((files or {}).get(name, name) for name in block.images)
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"two images are of the photograph {twice}; give each photograph one name")
        rows = block.image_points
        xy, image = to_numpy(rows.xy), np.asarray(rows.image)
        column_row, sigma_px = np.zeros((len(image), 2)), to_numpy(rows.sigma).copy()
        camera = np.array(block.image_camera, object)[image]
        used = dict.fromkeys(block.image_camera)
        for name in used:
            column_row[camera == name] = block.sensors[name].px_from_mm(xy[camera == name])
            sigma_px[camera == name] /= block.sensors[name].pixel_mm
        exterior = unknowns.exterior
        labels = {"refraction": "refraction", "curvature": "earth curvature"}
        corrections = [label for name, label in labels.items() if getattr(block.corrections, name)]
        bent = [
            kind for kind, owners in unknowns.tables.items() if any(type(p).modifies_interior for p in owners.values())
        ]
        return Project(
            block.title, {name: ProjectCamera(block.sensors[name], unknowns.interior[name]) for name in used},
            block.images, names, block.image_camera,
            ExteriorOrientation(to_numpy(exterior.position), to_numpy(exterior.camera_from_object)), block.points,
            to_numpy(unknowns.points), image, np.asarray(rows.point), column_row, block.frame, (*corrections, *bent),
            sigma_px, ControlPoints.of(block),
        )  # fmt: skip

    @property
    def rows_of_images(self) -> list[np.ndarray]:
        """Indices of the image points of each image."""
        return _groups(self.image, len(self.files))

    @property
    def rows_of_points(self) -> list[np.ndarray]:
        """Indices of the image points of each object point."""
        return _groups(self.point, len(self.points))

    @property
    def number_in_image(self) -> Int[np.ndarray, "n"]:
        """Number of every image point among those of its image, from 0."""
        number = np.zeros(len(self.image), int)
        for rows in self.rows_of_images:
            number[rows] = np.arange(len(rows))
        return number

    @property
    def world_to_camera(self) -> Float[np.ndarray, "n 3 3"]:
        """Rotations into axes x right, y down, z ahead."""
        return flipped(self.exterior.camera_from_object)

    @property
    def place(self) -> tuple[float, float, float] | None:
        """Longitude, latitude (degrees) and ellipsoidal height (m) of the origin; None unless on WGS 84 or GRS 80."""
        if self.frame.kind != "epsg" or self.frame.code is None or self.frame.origin is None:
            return None
        ellipsoid = map_system(self.frame.code).ellipsoid
        if ellipsoid is None or ellipsoid.semi_major_metre != _WGS84_M:
            return None
        longitude, latitude, height = map(float, self.frame.origin)
        return longitude, latitude, height

    @property
    def system(self) -> str:
        """EPSG:code, with the code of the heights unless these are ellipsoidal; "" for a local frame."""
        return map_name(self.frame.code, self.frame.vertical) if self.frame.code is not None else ""

    @property
    def geographic(self) -> bool:
        """True if map coordinates are longitude and latitude."""
        return self.frame.code is not None and map_system(self.frame.code).is_geographic

    def in_map(self, *, ellipsoidal: bool = False) -> "Project":
        """Return the project in map coordinates of its frame; a local frame stays.

        Positions and rotations are exact there; collinearity holds as far as the map is true to scale and the earth
        flat. `ellipsoidal` gives heights above the ellipsoid whatever the frame has.
        """
        if self.on_map or self.frame.kind != "epsg" or self.frame.code is None:
            return self
        assert self.frame.origin is not None
        system = MapFrame(self.frame.code, None, self.frame.origin) if ellipsoidal else self.frame.map
        position = np.asarray(self.exterior.position)
        rotations = np.asarray(self.exterior.camera_from_object) @ system.local_from_grid(position)
        control = self.control
        if control is not None:
            # Adjusted coordinates complete missing ones for the conversion.
            missing = np.isnan(control.xyz)
            points = np.zeros_like(control.xyz) if self.xyz is None else self.xyz[control.point]
            on_map = system.map(np.where(missing, points, control.xyz))
            control = control._replace(xyz=np.where(missing, np.nan, on_map))
        return self._replace(
            exterior=ExteriorOrientation(to_numpy(system.map(position)), to_numpy(rotations)),
            xyz=None if self.xyz is None else system.map(self.xyz),
            control=control,
            on_map=True,
        )

    def tables(self) -> BlockTables:
        """Return the tables of a self-calibration with the values of the project as start.

        An image has its file's name without the ending as id. Image coordinates without standard deviation get one
        pixel. The datum is inner over the points, or that of three complete control points. Repeated measurements,
        points with fewer than two images and images with fewer than three points are skipped (UserWarnings).

        Raises InputError if no image is oriented or tied, two have one name, or a rotation matrix is not orthonormal.
        """
        p = self.in_map()
        if not len(p.files):
            raise InputError(f"{p.file}: no image is oriented; give one that has images")
        _check_rotations(p)
        order = np.argsort(np.array(p.files, object), kind="stable")
        names = np.array(_image_names([p.files[k] for k in order]), object)
        if len(set(names)) < len(names):
            twice = next(name for name in names if list(names).count(name) > 1)
            raise InputError(f"{p.file}: image {twice} is there twice; keep one of them")
        control = p._control_table()
        image, point, column_row, sigma = p._measurements(np.argsort(order)[p.image], control)
        kept = np.flatnonzero(np.bincount(image, minlength=len(names)))
        if not len(kept):
            raise InputError(f"{p.file}: no image shows {_LEAST} points that others show, too")
        if skipped := [quoted(name) for name in np.delete(names, kept).tolist()]:
            _warn(f"{p.file}: {len(skipped)} image(s) with fewer than {_LEAST} points are left out: {few(skipped)}")
        order, names, image = order[kept], names[kept], np.searchsorted(kept, image)
        seen, point_of = np.unique(point, return_inverse=True)
        ids = np.array(p.points, object)[seen]
        exterior = jax.tree.map(lambda leaf: np.asarray(leaf)[order], p.exterior)
        angles = np.rad2deg(np.asarray(exterior.omega_phi_kappa))
        camera = np.array(p.image_camera, object)[order]
        coordinates = coordinate_names(p.frame)
        pose = np.column_stack([exterior.position, angles]).T
        tables: dict[str, dict[str, np.ndarray]] = {
            "images": {"image": names, "camera": camera} | dict(zip((*coordinates, *ANGLES), pose, strict=True)),
            "image_points": {
                "image": names[image], "point": ids[point_of],
                "column_px": column_row[:, 0], "row_px": column_row[:, 1],
            },
        }  # fmt: skip
        if np.isfinite(sigma).any():
            tables["image_points"]["sigma_px"] = _cells(sigma)
        if p.xyz is not None:
            tables["object_points"] = {"point": ids} | dict(zip(coordinates, p.xyz[seen].T, strict=True))
        settings: dict[str, Any] = {"title": p.title, "sigmas": {"image_px": 1.0}}
        if p.frame.kind == "epsg":
            settings["frame"] = frame_section(p.frame)
        if control is None:
            settings["datum"] = {"kind": "inner", "over": "points"}
        else:
            tables["control_points"] = control
            settings["sigmas"] |= dict(zip(("control_X_m", "control_Y_m", "control_Z_m"), SIGMA_M, strict=True))
        used = set(camera)
        settings["cameras"] = {name: _section(of) for name, of in p.cameras.items() if name in used}
        return BlockTables(settings, {key: Table.of(p.file, values) for key, values in tables.items()}, p.file)

    def _control_table(self) -> dict[str, np.ndarray] | None:
        """control_points.csv of the points that images show; None if these do not determine the datum."""
        control = self.control
        if control is None:
            return None
        there = np.isin(control.point, self.point)
        point, xyz, sigma, check = (values[there] for values in control)
        complete = int(np.sum(~check & np.isfinite(xyz).all(axis=1)))
        if complete < _LEAST:
            _warn(
                f"{self.file}: images show {complete} control point(s) with all coordinates, and a block needs "
                f"{_LEAST}; none is used"
            )
            return None
        columns = (*coordinate_names(self.frame), *SIGMA_XYZ)
        values = map(_cells, np.column_stack([xyz, sigma]).T)
        role = np.where(check, "check", "control").astype(object)
        return {"point": np.array(self.points, object)[point], **dict(zip(columns, values, strict=True)), "role": role}

    def _measurements(self, image: np.ndarray, control: dict[str, np.ndarray] | None) -> tuple[np.ndarray, ...]:
        """Image, point, pixels and sigma of valid measurements."""
        point, xy = self.point, self.column_row
        sigma = np.full(len(point), np.nan) if self.sigma_px is None else self.sigma_px[:, 0]
        # One feature is of the point with the smaller number; one point in an image is its first feature.
        order = np.lexsort((point, image))
        image, point, xy, sigma = image[order], point[order], xy[order], sigma[order]
        for by in ("xy", "point"):
            columns = np.column_stack([image, xy if by == "xy" else point])
            kept = np.sort(np.unique(columns, axis=0, return_index=True)[1])
            image, point, xy, sigma = image[kept], point[kept], xy[kept], sigma[kept]
        n_once, n_points = len(point), len(np.unique(point))
        fixed = set() if control is None else set(control["point"][control["role"] == "control"])
        is_control = np.array([name in fixed for name in self.points], bool)
        while True:
            tied = (np.bincount(point, minlength=len(is_control))[point] >= 2) | is_control[point]
            tied &= np.bincount(image[tied], minlength=len(self.files))[image] >= _LEAST
            if tied.all():
                break
            image, point, xy, sigma = image[tied], point[tied], xy[tied], sigma[tied]
        n_skipped = n_points - len(np.unique(point))
        if n_once < len(order) or n_skipped:
            _warn(
                f"{self.file}: {len(order) - n_once} measurement(s) that are there twice are not used, nor are "
                f"{n_skipped} point(s) that fewer than two images show"
            )
        return image, point, xy, sigma


def flipped(rotations: ArrayLike) -> Float[np.ndarray, "n 3 3"]:
    """Return rotations into a camera with y down and z ahead for one with y up and z backwards, or the reverse."""
    return np.array([[1.0], [-1.0], [-1.0]]) * np.asarray(rotations)


def translations(rotations: ArrayLike, positions: ArrayLike) -> np.ndarray:
    """Return t of x = R X + t."""
    return -np.einsum("nij,nj->ni", np.asarray(rotations), np.asarray(positions))


def pose(rotations: Float[np.ndarray, "n 3 3"], positions: Float[np.ndarray, "n 3"]) -> ExteriorOrientation:
    """Return the exterior orientation of rotations from the world to axes x right, y down, z ahead."""
    return ExteriorOrientation(positions, flipped(rotations))  # type: ignore[arg-type]


def numbered(names: Sequence[str]) -> dict[str, int]:
    """Return the names as numbers if all are positive ones, otherwise counted from 1."""
    numbers = [int(name) if name.isascii() and name.isdigit() else 0 for name in names]
    kept = min(numbers, default=1) > 0 and len(set(numbers)) == len(numbers) and max(numbers, default=1) < 2**31
    return dict(zip(names, numbers if kept else range(1, len(names) + 1), strict=True))


def _groups(index: np.ndarray, n: int) -> list[np.ndarray]:
    order = np.argsort(index, kind="stable")
    return np.split(order, np.cumsum(np.bincount(index, minlength=n))[:-1])


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=4)


def _cells(values: Float[np.ndarray, "n"]) -> np.ndarray:
    """Numbers as cells of a table, empty for NaN."""
    return np.array(["" if np.isnan(v) else repr(v) for v in values.tolist()], object)


def _section(camera: ProjectCamera) -> dict[str, Any]:
    """The table [cameras.X]."""
    priors = jax.tree.map(lambda _: FIXED, camera.interior)
    for name in camera.free:
        priors = set_parameter(priors, name, FREE)
    return camera_section(Camera(camera.sensor, camera.interior, priors))


def _check_rotations(p: Project) -> None:
    r = np.asarray(p.exterior.camera_from_object)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.einsum("nij,nkj->nik", r, r) - np.eye(3)).max(axis=(1, 2))
        bad = ~(off < _ROTATION_TOLERANCE) | ~(np.linalg.det(np.where(off[:, None, None] < 1, r, 0.0)) > 0)
    for k in np.flatnonzero(bad).tolist():
        raise InputError(f"{p.file}: the matrix of image {p.files[k]} is no rotation.")


def _image_names(files: list[str]) -> list[str]:
    """Names of the files without endings of photographs, unless two would be the same; absolute folders are removed."""
    paths = [PurePosixPath(PureWindowsPath(file).as_posix()) for file in files]
    if any(path.is_absolute() or PureWindowsPath(str(path)).is_absolute() for path in paths):
        paths = [PurePosixPath(path.name) for path in paths]
    short = [str(path.with_suffix("")) if path.suffix.lower() in _PHOTOGRAPHS else str(path) for path in paths]
    return short if len(set(short)) == len(short) else [str(path) for path in paths]


# Coordinate systems -------------------------------------------------------------------------------------------


def is_geocentric(xyz: Float[np.ndarray, "n 3"]) -> bool:
    """Return True if all positions are as far from the origin as places are from the centre of the earth."""
    with np.errstate(over="ignore"):
        distance = np.linalg.norm(xyz, axis=1)
    return len(xyz) > 0 and bool(((distance > _EARTH_M[0]) & (distance < _EARTH_M[1])).all())


def geocentric(p: Project, code: int, vertical: int | None) -> Project:
    """Return a project in geocentric axes of the datum of the EPSG system `code` in a frame of that system."""
    centres = np.asarray(p.exterior.position)
    if not is_geocentric(centres):
        raise InputError(f"{p.file}: its transform puts photographs not on the earth")
    frame = _frame_amid(code, vertical, place_from_geocentric(code, centres))
    rotation, translation = frame.map.geocentric_from_local()
    exterior = ExteriorOrientation((centres - translation) @ rotation, p.exterior.camera_from_object @ rotation)  # type: ignore[arg-type]
    return p._replace(frame=frame, exterior=exterior)


def about_place(p: Project, place: Place) -> Project:
    """Return a project east, north and up of a `place` on WGS 84 in a frame of the UTM zone there.

    It stays local, with a UserWarning, if it lies farther off than a block does.
    """
    far = float(np.abs(np.asarray(p.exterior.position)).max(initial=0.0))
    if not (far < _NEAR_M and abs(place[0]) <= 180 and abs(place[1]) <= 90):
        return _local(p, f"photographs lie {far / 1000:.0f} km from its origin")
    try:
        return p._replace(frame=Frame("epsg", utm_of(*place[:2]), None, "true", place))
    except InputError as error:
        return _local(p, str(error))


def in_system(p: Project, words: str) -> Project:
    """Return a project in the map coordinates that `words` name; local, with a UserWarning, if they name none."""
    try:
        return with_system(p, words)
    except InputError as error:
        return _local(p, str(error).removeprefix(f"{p.file}: "))


def with_system(p: Project, words: str) -> Project:
    """Return a project in the map coordinates that `words` name: an EPSG code, WKT, a string of PROJ, "local" or "".

    Raises InputError if they name none, or one without EPSG code, or positions are no places of it.
    """
    system = system_of(words or "local", p.file)
    if system.crs is None:
        return p
    if system.code is None:
        raise InputError(f"{p.file}: its system ({system.name}) has no EPSG code; write EPSG:25832, say, in its place")
    places = MapFrame(system.code, system.vertical, (0.0, 0.0, 0.0)).place(np.asarray(p.exterior.position))
    if not np.isfinite(places).all():
        raise InputError(f"{p.file}: positions are no places of {system.name}; correct the system")
    return p._replace(frame=_frame_amid(system.code, system.vertical, places), on_map=True)


def _frame_amid(code: int, vertical: int | None, places: Float[np.ndarray, "n 3"]) -> Frame:
    """A frame with a rounded place amid `places` as its origin."""
    longitude, latitude, _ = np.median(places, axis=0)
    return Frame("epsg", code, vertical, "true", (round(float(longitude), 4), round(float(latitude), 4), 0.0))


def _local(p: Project, why: str) -> Project:
    _warn(f"{p.file}: where the block lies is not read, and its coordinates are taken as Cartesian metres: {why}")
    return p
