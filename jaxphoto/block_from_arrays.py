"""Blocks from arrays or tables in memory, with the column names of a block folder.

    block = Block.of(
        {"image": ["a", "b"], "point": ["1", "1"], "x_mm": [0.1, -4.2], "y_mm": [2.0, 2.1]},
        {"kodak": (Sensor(4500, 3000, 0.008), InteriorOrientation(35.0))},
        sigma_mm=0.004,
    )

A table is a mapping of columns, such as a pandas DataFrame. Units are in the names (docs/block_folder.md).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxphoto.arrays import as_jax_array
from jaxphoto.block_parts import Datum, Start
from jaxphoto.camera import InteriorOrientation, Sensor, parameter_names, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.columns import CheckedColumns, TableLike
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import Mount, StripBias
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints
from jaxphoto.unknowns import FREE, Unknowns, default_priors

_XYZ, _SIGMA_XYZ = ("X_m", "Y_m", "Z_m"), ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
_ANGLES, _ATTITUDE = ("omega_deg", "phi_deg", "kappa_deg"), ("roll_deg", "pitch_deg", "yaw_deg")
_SIGMA_ATTITUDE = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg")
_ROLES = ("control", "fixed", "check")


def block_fields(
    image_points: TableLike,
    cameras: Mapping[str, tuple[Sensor, InteriorOrientation]],
    *,
    sigma_mm: float | None = None,
    images: TableLike | None = None,
    control: TableLike | None = None,
    stations: TableLike | None = None,
    attitudes: TableLike | None = None,
    distances: TableLike | None = None,
    points: TableLike | None = None,
    mounts: Mapping[str, Mount] | None = None,
    free: Sequence[str] = (),
    datum: Datum | None = None,
    title: str = "block",
) -> dict[str, Any]:
    """Return the fields of a block from `image_points` (image, point, x_mm, y_mm), `cameras`, and optional tables.

    `sigma_mm` applies to image points without the columns sigma_x_mm, sigma_y_mm. `images` (image) sets the order of
    the images. Its other columns are `camera`, required if there are several, `strip`, `time_s` and start values: X_m
    to Z_m and omega_deg to kappa_deg. Observations are `control` (point, X_m to Z_m, NaN if unknown; sigma_X_m to
    sigma_Z_m; role control, fixed or check), `stations` (image, X_m to Z_m and their sigmas), `attitudes` (image,
    roll_deg to yaw_deg, sigma_roll_deg to sigma_yaw_deg) and `distances` (point_a, point_b, distance_m, sigma_m); a
    column sigma_m or sigma_deg applies to all three coordinates or angles. `points` (point, X_m to Z_m) are approximate
    values, `mounts` is by camera, `free` are the parameters estimated for every camera. `adjust` computes missing
    approximate values. `datum` is minimal if only images and distances are given.

    Raises InputError for a missing or invalid column, name or value, BlockError if they do not form a block.
    """
    if not cameras:
        raise InputError('cameras: empty; give {"name": (Sensor(...), InteriorOrientation(...))}')
    seen = CheckedColumns("image_points", image_points)
    listed = CheckedColumns("images", {"image": list(dict.fromkeys(seen.ids("image")))} if images is None else images)
    listed.refuse_twice("image")
    names, of_camera = tuple(listed.ids("image")), _cameras(listed, tuple(cameras))
    ids, rows = _image_rows(seen, names, sigma_mm)

    given = CheckedColumns("control", control, "point", *_XYZ)
    of_point = given.index("point", ids, "point {name} is measured in no image; measure it or remove it")
    role = np.array(given.ids("role") if "role" in given else ["control"] * given.n, object)
    given.find(list(role), _ROLES, "unknown role {name!r}; use control, fixed or check")
    coordinates, entry = _scalars(given, of_point, role == "control")
    by_role = {r: coordinates.take(role[entry] == r) for r in _ROLES}
    flown, turned = (
        CheckedColumns("stations", stations, "image", *_XYZ),
        CheckedColumns("attitudes", attitudes, "image", *_ATTITUDE),
    )
    for table in (flown, turned):
        table.refuse_twice("image")
    of_station, of_attitude = (t.index("image", names, "unknown image {name}") for t in (flown, turned))
    bars = CheckedColumns("distances", distances, "point_a", "point_b", "distance_m")
    ends = [bars.index(end, ids, "point {name} is measured in no image") for end in ("point_a", "point_b")]

    attitude_sigma = turned.sigmas(_SIGMA_ATTITUDE, "sigma_deg")
    turned.warn_of_32_bits(_ATTITUDE, attitude_sigma)
    distance_sigma = bars.sigmas(("sigma_m",), "sigma_m")
    bars.warn_of_32_bits(("distance_m",), distance_sigma)
    start, known = _start(ids, CheckedColumns("points", points, "point", *_XYZ), by_role["control"], by_role["fixed"])
    placed = set(_XYZ + _ANGLES) <= set(listed.columns)
    position, angles = (listed.numbers(*c) if placed else np.zeros((len(names), 3)) for c in (_XYZ, _ANGLES))
    strips = tuple(listed.ids("strip", empty=True)) if "strip" in listed else ("",) * len(names)
    used, zero = dict(mounts or {}), jnp.zeros(3)
    unknowns = Unknowns(
        {name: interior for name, (_, interior) in cameras.items()},
        ExteriorOrientation.from_angles(as_jax_array(position), as_jax_array(np.deg2rad(angles))),
        as_jax_array(start),
        used,
        {strip: StripBias(zero, zero) for strip in dict.fromkeys(strips) if strip},
    )
    return {
        "title": title,
        "images": names,
        "points": ids,
        "sensors": {name: sensor for name, (sensor, _) in cameras.items()},
        "image_camera": of_camera,
        "image_mount": tuple(camera if camera in used else "" for camera in of_camera),
        "image_strip": strips,
        "image_time": as_jax_array(listed.numbers("time_s")[:, 0] if "time_s" in listed else np.zeros(len(names))),
        "image_points": rows,
        "control": by_role["control"],
        "fixed": by_role["fixed"],
        "check": by_role["check"],
        "stations": _scalars(flown, of_station, kind=CameraPositions)[0],
        "attitudes": Attitudes(
            of_attitude,
            as_jax_array(np.deg2rad(turned.numbers(*_ATTITUDE))),
            as_jax_array(np.deg2rad(attitude_sigma)),
        ),
        "distances": Distances(
            np.stack(ends, axis=1),
            as_jax_array(bars.numbers("distance_m")[:, 0]),
            as_jax_array(distance_sigma[:, 0]),
        ),
        "datum": datum or Datum("control" if given.n or flown.n else "minimal"),
        "start": Start(unknowns, np.full(len(names), placed), known),
        "priors": _priors(unknowns, free),
    }


def _cameras(images: CheckedColumns, cameras: tuple[str, ...]) -> tuple[str, ...]:
    """Return the camera of every image."""
    if "camera" not in images:
        if len(cameras) > 1:
            raise InputError(f"images: no column camera for {len(cameras)} cameras; add it ({', '.join(cameras)})")
        return cameras * images.n
    images.index("camera", cameras, f"unknown camera {{name}} ({', '.join(cameras)})")
    return tuple(images.ids("camera"))


def _image_rows(
    seen: CheckedColumns, images: tuple[str, ...], sigma_mm: float | None
) -> tuple[tuple[str, ...], ImagePoints]:
    """Return the points in order of first appearance, and their measurements sorted by point and image."""
    if not seen.n:
        raise BlockError("image_points: empty; give the measured image coordinates")
    image, ids = seen.index("image", images, "image {name} is not listed under images"), seen.ids("point")
    points = tuple(dict.fromkeys(ids))
    point = seen.index("point", points, "")
    xy, sigma = seen.numbers("x_mm", "y_mm"), seen.sigmas(("sigma_x_mm", "sigma_y_mm"), "sigma_mm", sigma_mm)
    seen.warn_of_32_bits(("x_mm", "y_mm"), sigma)
    order = np.lexsort((image, point))
    for k in np.flatnonzero((np.diff(image[order]) == 0) & (np.diff(point[order]) == 0)):
        again = max(order[k], order[k + 1])
        raise seen.wrong(again, f"point {ids[again]} is measured twice in image {images[image[again]]}")
    return points, ImagePoints(image[order], point[order], as_jax_array(xy[order]), as_jax_array(sigma[order]))


def _priors(unknowns: Unknowns, free: Sequence[str]) -> Unknowns:
    """Return priors: exterior orientation, points, and the camera parameters `free` are free."""
    priors = default_priors(unknowns)
    for camera, interior in unknowns.interior.items():
        for name in free:
            if name not in parameter_names(interior):
                there = ", ".join(parameter_names(interior))
                raise InputError(f"free: camera {camera} has no parameter {name!r}; it has {there}")
            priors.interior[camera] = set_parameter(priors.interior[camera], name, FREE)
    return priors


def _scalars(
    table: CheckedColumns, who: np.ndarray, observed: np.ndarray | None = None, kind: Any = ControlCoordinates
) -> tuple[Any, np.ndarray]:
    """Return one row per coordinate, and its entry in the table; entries not `observed` need no sigma."""
    value = table.numbers(*_XYZ, empty=True)
    there = ~np.isnan(value)
    needed = there if observed is None else there & observed[:, None]
    sigma = table.sigmas(_SIGMA_XYZ, "sigma_m", needed=needed)
    table.warn_of_32_bits(_XYZ, sigma)
    entry, axis = np.nonzero(there)
    return kind(who[entry], axis, as_jax_array(value[there]), as_jax_array(sigma[there])), entry


def _start(ids: tuple[str, ...], near: CheckedColumns, *held: ControlCoordinates) -> tuple[np.ndarray, np.ndarray]:
    """Return approximate coordinates of all points, control first, and a mask of points with all three coordinates."""
    start = np.full((len(ids), 3), np.nan)
    start[near.index("point", ids, "point {name} is measured in no image")] = near.numbers(*_XYZ)
    for rows in held:
        start[rows.who, rows.axis] = rows.value
    known = ~np.isnan(start).any(axis=1)
    return np.where(known[:, None], start, 0.0), known
