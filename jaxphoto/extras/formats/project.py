"""Format-independent project: cameras, oriented images, object points, image points and control points.

Computer vision uses camera axes x right, y down, z forward; we use x right, y up, z backward. Pixel coordinates follow
docs/conventions.md: the centre of the upper left pixel is (0.5, 0.5).
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import as_jax_array, to_numpy
from jaxphoto.block import Block, Frame
from jaxphoto.camera import (
    AbstractDistortion,
    AbstractProjection,
    Agisoft,
    Equidistant,
    InteriorOrientation,
    OpenCv,
    OpenCvFisheye,
    Perspective,
    Sensor,
    get_parameter,
    parameter_names,
    set_parameter,
)
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, few, quoted
from jaxphoto.georeferencing.map_frame import MapFrame, Place, map_system, place_from_geocentric
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.block_folder.settings import frame_section
from jaxphoto.io.block_folder.table_layout import ANGLES, SIGMA_XYZ, coordinate_names
from jaxphoto.io.camera_files import CameraSource
from jaxphoto.io.text_tables import Table
from jaxphoto.procedures.control.surveyed import SIGMA_M, system_of
from jaxphoto.procedures.georeference_photographs import utm_of
from jaxphoto.unknowns import FIXED, FREE, Unknowns

_PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".jp2", ".ppm", ".pgm", ".dng")
# Maximum element of R R' - I; rounded digits stay below it.
_ROTATION_TOLERANCE = 1e-3
# Minimum number of points per image orientation, and of control points per datum.
_LEAST = 3
# Standard deviation (m) of fixed coordinates in formats without fixed coordinates.
_FIXED_M = 1e-4
# Radius of the earth (m), and its relative range with heights of flights.
_EARTH_M, _ROUGHLY = 6.37e6, 0.02
# Semi-major axis (m) of WGS 84 and GRS 80.
_WGS84_M = 6378137.0


# Cameras -----------------------------------------------------------------------------------------------------


class CameraModel(NamedTuple):
    """Distortion and projection; the distortion coefficients `lacks` are zero."""

    distortion: type[AbstractDistortion]
    lacks: tuple[str, ...]
    projection: AbstractProjection

    def only(self, *terms: str) -> "CameraModel":
        """Return the model restricted to the coefficients `terms`."""
        return self._replace(lacks=tuple(name for name in self.distortion.coefficients if name not in terms))


OPENCV = CameraModel(OpenCv, ("b2",), Perspective())
"""OpenCV's rational model with fx and fy."""
OPENCV_FISHEYE = CameraModel(OpenCvFisheye, ("p1", "p2", "s1", "s2", "b2"), Equidistant())
"""OpenCV's fisheye model with fx and fy."""
BROWN = CameraModel(OpenCv, ("k4", "k5", "k6", "b2"), Perspective())
"""OpenCV's model with k1 to k3, p1, p2, fx and fy."""
AGISOFT = CameraModel(Agisoft, ("p3", "p4"), Perspective())
AGISOFT_FISHEYE = CameraModel(Agisoft, ("p3", "p4"), Equidistant())
BROWN_TERMS, FISHEYE_TERMS = ("k1", "k2", "k3", "p1", "p2"), ("k1", "k2", "k3", "k4")
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""OpenCV's coefficients in the order of its files."""


class ProjectCamera(NamedTuple):
    """Camera of a project, and the names of its free parameters."""

    sensor: Sensor
    interior: InteriorOrientation
    free: tuple[str, ...] = ()

    @staticmethod
    def estimated(sensor: Sensor, interior: InteriorOrientation) -> "ProjectCamera":
        """Return a camera with free c, xp, yp and all nonzero coefficients."""
        first = ("c_mm", "xp_mm", "yp_mm")
        names = (n for n in parameter_names(interior) if n in first or float(get_parameter(interior, n)) != 0)
        return ProjectCamera(sensor, interior, tuple(names))

    def terms(self, names: tuple[str, ...]) -> dict[str, float]:
        """Return distortion coefficients by name."""
        return {name: float(getattr(self.interior.distortion, name)) for name in names}


def in_pixels(
    source: CameraSource, sensor: Sensor, fx: float, fy: float, centre: tuple[float, float], model: CameraModel, **terms
) -> InteriorOrientation:
    """Convert focal lengths and principal point in pixels to an interior orientation: c is fy, b1 is fx / fy - 1."""
    if not (fx > 0 and fy > 0):
        raise source.error(f"focal lengths {fx:g} and {fy:g} px are not positive; give positive values")
    if fx != fy:
        terms["b1"] = fx / fy - 1
    x_p, y_p = sensor.mm_from_px(np.array([centre], float))[0]
    distortion = model.distortion(**terms)
    interior = InteriorOrientation(fy * sensor.pixel_mm, x_p, y_p, distortion, projection=model.projection)
    return jax.tree.map(as_jax_array, interior)


def pixels_of(interior: InteriorOrientation, sensor: Sensor) -> tuple[float, float, float, float]:
    """Return fx, fy and the principal point (column, row) in pixels: the inverse of `in_pixels`."""
    fy = float(interior.c / sensor.pixel_mm)
    column, row = sensor.px_from_mm(np.array([[float(interior.xp), float(interior.yp)]]))[0]
    return fy * (1 + float(getattr(interior.distortion, "b1", 0.0))), fy, float(column), float(row)


# Projects ----------------------------------------------------------------------------------------------------


class ControlPoints(NamedTuple):
    """Control and check points, in the coordinate system of their project.

    A point with both control and check coordinates has its control coordinates only.
    """

    point: Int[np.ndarray, "known"]
    """Index into the project's points."""
    xyz: Float[np.ndarray, "known 3"]
    """Coordinates (m, or degrees in a geographic system); NaN if not given."""
    sigma_m: Float[np.ndarray, "known 3"]
    """Standard deviations; NaN if unknown, 0.1 mm for fixed coordinates."""
    check: Bool[np.ndarray, "known"]

    @staticmethod
    def of(block: Block) -> "ControlPoints":
        """Return the control and check points of a block, control points first."""
        n_points, parts = len(block.points), list[ControlPoints]()
        for kinds in (((block.control, np.nan), (block.fixed, _FIXED_M)), ((block.check, np.nan),)):
            xyz, sigma = np.full((2, n_points, 3), np.nan)
            for rows, missing in kinds:
                at, sigmas = (np.asarray(rows.who), np.asarray(rows.axis)), np.asarray(rows.sigma)
                xyz[at], sigma[at] = np.asarray(rows.value), np.where(sigmas > 0, sigmas, missing)
            known = np.flatnonzero(~np.isnan(xyz).all(axis=1))
            if parts:
                known = known[~np.isin(known, parts[0].point)]
            parts.append(ControlPoints(known, xyz[known], sigma[known], np.full(len(known), bool(parts))))
        return ControlPoints(*(np.concatenate(values) for values in zip(*parts, strict=True)))


class Project(NamedTuple):
    """Oriented images with image points and object points, in metres and pixels; axes are defined in
    docs/conventions.md.
    """

    title: str
    cameras: Mapping[str, ProjectCamera]
    images: Sequence[str]
    """Image ids; if empty, `tables` derives them from the file names."""
    files: Sequence[str]
    image_camera: Sequence[str]
    exterior: ExteriorOrientation
    points: Sequence[str]
    xyz: Float[np.ndarray, "points 3"] | None
    """None if the file has no object points."""
    image: Int[np.ndarray, "n"]
    """Index of each image point's image."""
    point: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    """Pixel coordinates; the centre of the upper left pixel is (0.5, 0.5)."""
    frame: Frame = Frame("local")
    changes: tuple[str, ...] = ()
    """Corrections of the block that other programs cannot represent."""
    sigma_px: Float[np.ndarray, "n 2"] | None = None
    """Standard deviations of column and row; NaN or None if unknown."""
    control: ControlPoints | None = None
    on_map: bool = False
    """True if positions are in the frame's map system and rotations refer to grid east, grid north and up at each
    image; False in the block's Cartesian frame.
    """
    file: str = ""
    """Name of the source file, for messages."""

    @staticmethod
    def of(adjusted: Adjustment, files: Mapping[str, str] | None = None) -> "Project":
        """Return the results of an adjustment; `files` are photograph names by image id."""
        return Project.of_block(adjusted.block, adjusted.unknowns, files)

    @staticmethod
    def of_block(block: Block, unknowns: Unknowns, files: Mapping[str, str] | None = None) -> "Project":
        """Convert `block` with the values `unknowns`. Raise InputError if two images have one file name."""
        names = tuple((files or {}).get(name, name) for name in block.images)
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"two images have the photograph {twice}; give each photograph one name")
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
        """Row indices of each image's image points."""
        return _groups(self.image, len(self.files))

    @property
    def rows_of_points(self) -> list[np.ndarray]:
        """Row indices of each object point's image points."""
        return _groups(self.point, len(self.points))

    @property
    def number_in_image(self) -> Int[np.ndarray, "n"]:
        """Index of each image point within its image, from 0."""
        number = np.zeros(len(self.image), int)
        for rows in self.rows_of_images:
            number[rows] = np.arange(len(rows))
        return number

    @property
    def world_to_camera(self) -> Float[np.ndarray, "n 3 3"]:
        """Rotations from the world to camera axes x right, y down, z forward."""
        return flipped(self.exterior.camera_from_object)

    @property
    def place(self) -> tuple[float, float, float] | None:
        """Longitude, latitude (degrees) and ellipsoidal height (m) of the origin; None except on WGS 84 or GRS 80."""
        code = self.frame.code
        ellipsoid = None if code is None else map_system(code).ellipsoid
        if self.frame.origin is None or ellipsoid is None or ellipsoid.semi_major_metre != _WGS84_M:
            return None
        longitude, latitude, height = map(float, self.frame.origin)
        return longitude, latitude, height

    def in_map(self) -> "Project":
        """Convert the project to map coordinates of its frame; a local frame is unchanged.

        Positions and rotations are exact. Collinearity is approximate because of map scale and earth curvature.
        """
        if self.on_map or self.frame.kind != "epsg" or self.frame.code is None:
            return self
        system = self.frame.map
        position = np.asarray(self.exterior.position)
        rotations = np.asarray(self.exterior.camera_from_object) @ system.local_from_grid(position)
        control = self.control
        if control is not None:
            # Use adjusted coordinates in place of missing ones for the conversion.
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
        """Return the tables of a self-calibrating block with the project's values as initial values.

        Image ids are the file names without suffix. The default standard deviation of image coordinates is one pixel.
        The datum is defined by at least three complete control points, otherwise by inner constraints over the points.
        Repeated measurements, points in fewer than two images and images with fewer than three points are skipped
        (UserWarnings).

        Raises InputError if no image is oriented or has tie points, two images have one name, or a rotation matrix is
        not orthonormal.
        """
        p = self.in_map()
        if not len(p.files):
            raise InputError(f"{p.file}: no image is oriented; give a file with oriented images")
        _check_rotations(p)
        order = np.argsort(np.array(p.files, object), kind="stable")
        names = np.array(_image_names([p.files[k] for k in order]), object)
        if len(set(names)) < len(names):
            twice = next(name for name in names if list(names).count(name) > 1)
            raise InputError(f"{p.file}: duplicate image {twice}; keep one of them")
        control = p._control_table()
        image, point, column_row, sigma = p._measurements(np.argsort(order)[p.image], control)
        kept = np.flatnonzero(np.bincount(image, minlength=len(names)))
        if not len(kept):
            raise InputError(f"{p.file}: no image shares {_LEAST} points with others; add image points")
        if skipped := [quoted(name) for name in np.delete(names, kept).tolist()]:
            _warn(f"{p.file}: skipped {len(skipped)} image(s) with fewer than {_LEAST} points: {few(skipped)}")
        order, names, image = order[kept], names[kept], np.searchsorted(kept, image)
        seen, point_of = np.unique(point, return_inverse=True)
        ids, camera = np.array(p.points, object)[seen], np.array(p.image_camera, object)[order]
        exterior = jax.tree.map(lambda leaf: np.asarray(leaf)[order], p.exterior)
        coordinates = coordinate_names(p.frame)
        pose = np.column_stack([exterior.position, np.rad2deg(np.asarray(exterior.omega_phi_kappa))]).T
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
        settings["cameras"] = {}
        for name in dict.fromkeys(camera):
            sensor, interior, free = p.cameras[name]
            priors = jax.tree.map(lambda _: FIXED, interior)
            for parameter in free:
                priors = set_parameter(priors, parameter, FREE)
            settings["cameras"][name] = camera_section(Camera(sensor, interior, priors))
        return BlockTables(settings, {key: Table.of(p.file, values) for key, values in tables.items()}, p.file)

    def _control_table(self) -> dict[str, np.ndarray] | None:
        """Return control_points.csv with the measured points; None if they do not determine the datum."""
        control = self.control
        if control is None:
            return None
        there = np.isin(control.point, self.point)
        point, xyz, sigma, check = (values[there] for values in control)
        complete = int(np.sum(~check & np.isfinite(xyz).all(axis=1)))
        if complete < _LEAST:
            _warn(
                f"{self.file}: skipped control: images show {complete} control point(s) with all coordinates; "
                f"a block needs {_LEAST}"
            )
            return None
        columns = (*coordinate_names(self.frame), *SIGMA_XYZ)
        values = map(_cells, np.column_stack([xyz, sigma]).T)
        role = np.where(check, "check", "control").astype(object)
        return {"point": np.array(self.points, object)[point], **dict(zip(columns, values, strict=True)), "role": role}

    def _measurements(self, image: np.ndarray, control: dict[str, np.ndarray] | None) -> tuple[np.ndarray, ...]:
        """Return image, point, pixel coordinates and sigma of valid measurements."""
        (x, y), sigma = self.column_row.T, np.nan if self.sigma_px is None else self.sigma_px[:, 0]
        rows = pd.DataFrame({"image": image, "point": self.point, "x": x, "y": y, "sigma": sigma})
        # A feature of several points belongs to the lowest index; a point measured twice in an image takes the first
        # feature.
        rows = rows.sort_values(["image", "point"], kind="stable")
        rows = rows.drop_duplicates(["image", "x", "y"]).drop_duplicates(["image", "point"])
        n_once, n_points = len(rows), rows.point.nunique()
        fixed = set() if control is None else set(control["point"][control["role"] == "control"])
        is_control = np.array([name in fixed for name in self.points], bool)
        tied = np.zeros(0, bool)
        while not tied.all() or len(tied) != len(rows):
            image, point = rows.image.to_numpy(), rows.point.to_numpy()
            tied = (np.bincount(point, minlength=len(is_control))[point] >= 2) | is_control[point]
            tied &= np.bincount(image[tied], minlength=len(self.files))[image] >= _LEAST
            rows = rows[tied]
        n_skipped = n_points - rows.point.nunique()
        if n_once < len(self.point) or n_skipped:
            _warn(
                f"{self.file}: skipped {len(self.point) - n_once} duplicate measurement(s) and {n_skipped} point(s) "
                "in fewer than two images"
            )
        return (
            *(rows[name].to_numpy() for name in ("image", "point")),
            rows[["x", "y"]].to_numpy(),
            rows.sigma.to_numpy(),
        )


def flipped(rotations: ArrayLike) -> Float[np.ndarray, "n 3 3"]:
    """Convert rotations between camera axes with y up, z backward and with y down, z forward."""
    return np.array([[1.0], [-1.0], [-1.0]]) * np.asarray(rotations)


def translations(rotations: ArrayLike, positions: ArrayLike) -> np.ndarray:
    """Return t of x = R (X - position) = R X + t."""
    return -np.einsum("nij,nj->ni", np.asarray(rotations), np.asarray(positions))


def pose(rotations: Float[np.ndarray, "n 3 3"], positions: Float[np.ndarray, "n 3"]) -> ExteriorOrientation:
    """Return the exterior orientation for rotations from the world to camera axes x right, y down, z forward."""
    return ExteriorOrientation(positions, flipped(rotations))  # type: ignore[arg-type]


def numbered(names: Sequence[str]) -> dict[str, int]:
    """Return integer ids: the names if all are positive integers and distinct, otherwise counted from 1."""
    numbers = [int(name) if name.isascii() and name.isdigit() else 0 for name in names]
    kept = min(numbers, default=1) > 0 and len(set(numbers)) == len(numbers) and max(numbers, default=1) < 2**31
    return dict(zip(names, numbers if kept else range(1, len(names) + 1), strict=True))


def _groups(index: np.ndarray, n: int) -> list[np.ndarray]:
    order = np.argsort(index, kind="stable")
    return np.split(order, np.cumsum(np.bincount(index, minlength=n))[:-1])


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=4)


def _cells(values: Float[np.ndarray, "n"]) -> np.ndarray:
    """Format values as table cells; NaN is an empty cell."""
    return np.array(["" if np.isnan(v) else repr(v) for v in values.tolist()], object)


def _check_rotations(p: Project) -> None:
    r = np.asarray(p.exterior.camera_from_object)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.einsum("nij,nkj->nik", r, r) - np.eye(3)).max(axis=(1, 2))
        bad = ~(off < _ROTATION_TOLERANCE) | ~(np.linalg.det(np.where(off[:, None, None] < 1, r, 0.0)) > 0)
    for k in np.flatnonzero(bad).tolist():
        raise InputError(f"{p.file}: the matrix of image {p.files[k]} is not a rotation. Export it again")


def _image_names(files: list[str]) -> list[str]:
    """Return file names without photograph suffix, unless two would be equal; absolute folders are removed."""
    paths = [PurePosixPath(PureWindowsPath(file).as_posix()) for file in files]
    if any(path.is_absolute() or PureWindowsPath(str(path)).is_absolute() for path in paths):
        paths = [PurePosixPath(path.name) for path in paths]
    short = [str(path.with_suffix("")) if path.suffix.lower() in _PHOTOGRAPHS else str(path) for path in paths]
    return short if len(set(short)) == len(short) else [str(path) for path in paths]


# Coordinate systems -------------------------------------------------------------------------------------------


def is_geocentric(xyz: Float[np.ndarray, "n 3"]) -> bool:
    """Return True if the distance of all positions from the origin is near the radius of the earth."""
    return len(xyz) > 0 and bool((np.abs(np.linalg.norm(xyz / _EARTH_M, axis=1) - 1) < _ROUGHLY).all())


def geocentric(p: Project, code: int, vertical: int | None) -> Project:
    """Convert geocentric coordinates on the datum of the EPSG system `code` to a frame of this system."""
    centres = np.asarray(p.exterior.position)
    if not is_geocentric(centres):
        raise InputError(f"{p.file}: its transform places photographs off the Earth's surface; export it again")
    frame = _frame_amid(code, vertical, place_from_geocentric(code, centres))
    rotation, translation = frame.map.geocentric_from_local()
    exterior = ExteriorOrientation((centres - translation) @ rotation, p.exterior.camera_from_object @ rotation)  # type: ignore[arg-type]
    return p._replace(frame=frame, exterior=exterior)


def about_place(p: Project, place: Place) -> Project:
    """Place a project in east-north-up axes at `place` (WGS 84) into a frame of the UTM zone there."""
    return p._replace(frame=Frame("epsg", utm_of(*place[:2]), None, "true", place))


def with_system(p: Project, words: str) -> Project:
    """Set the map system of a project in map coordinates; `words` is an EPSG code, WKT, a PROJ string, "local" or "".

    Raises InputError for an unknown system, a system without EPSG code, and positions outside its domain.
    """
    system = system_of(words or "local", p.file)
    if system.crs is None:
        return p
    if system.code is None:
        raise InputError(f"{p.file}: its system ({system.name}) has no EPSG code; write an EPSG code, e.g. EPSG:25832")
    places = MapFrame(system.code, system.vertical, (0.0, 0.0, 0.0)).place(np.asarray(p.exterior.position))
    if not np.isfinite(places).all():
        raise InputError(f"{p.file}: positions are outside {system.name}; correct the system")
    return p._replace(frame=_frame_amid(system.code, system.vertical, places), on_map=True)


def _frame_amid(code: int, vertical: int | None, places: Float[np.ndarray, "n 3"]) -> Frame:
    """Return a frame whose origin is the rounded median of `places`."""
    longitude, latitude, _ = np.median(places, axis=0)
    return Frame("epsg", code, vertical, "true", (round(float(longitude), 4), round(float(latitude), 4), 0.0))
