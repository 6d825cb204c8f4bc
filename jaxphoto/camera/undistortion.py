"""The pinhole camera in the place of one with distortion, and where each of its pixels is in the given photograph."""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxphoto.camera.distortion import Brown
from jaxphoto.camera.interior import InteriorOrientation
from jaxphoto.camera.sensor import Sensor
from jaxphoto.compiling import call_compiled

Keep = Literal["crop", "all"]
# Points along each side of the border.
_ALONG = 200
# Of the given sides: what is larger is the horizon of a fisheye.
_LARGEST = 4.0
# So far apart (px) are the places that are computed; between them a spline is truer than the rounding of the result.
_STEP = 16
_NOWHERE = -1e6
# Places that go through the compiled program at once.
_CHUNK = 1 << 16


class Pinhole(NamedTuple):
    """A camera without distortion: c and the size of a pixel are those of the given one, the format is another."""

    sensor: Sensor
    interior: InteriorOrientation


def pinhole(sensor: Sensor, interior: InteriorOrientation, keep: Keep = "crop") -> Pinhole:
    """The camera of undistorted photographs.

    `crop`: the largest format that the given one fills within its four sides, `all`: the smallest that holds it. Raises
    ValueError where the distortion folds at the border of the given format, where that looks at 90 degrees from the
    axis or more, and where the new format would be more than four times as wide or high.
    """
    # What fills the new format is interpolated between centres of pixels.
    x, y = _border(sensor, interior, 1.0 if keep == "crop" else 0.0)
    if keep == "crop":
        low = np.array([x[3].max(), y[0].max()])
        high = np.array([x[1].min(), y[2].min()])
    else:
        low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    whole = (high - low) / sensor.pixel_mm
    size = np.floor(whole + 1e-9) if keep == "crop" else np.ceil(whole - 1e-9)
    if not (size >= 1).all() or (size > _LARGEST * np.array([sensor.width_px, sensor.height_px])).any():
        raise ValueError(
            f"the photographs would have {size[0]:.0f} x {size[1]:.0f} pixels without distortion: "
            + ("keep only what fills them (crop)" if keep == "all" else "this lens is too wide for a pinhole camera")
        )
    x_p, y_p = -(low + high) / 2
    return Pinhole(
        Sensor(int(size[0]), int(size[1]), sensor.pixel_mm, sensor.pixel_assumed),
        InteriorOrientation(interior.c, x_p, y_p, Brown()),
    )


def source_pixels(
    sensor: Sensor, interior: InteriorOrientation, new: Pinhole
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """Of every pixel of the new camera its column and row in the given photograph, the centre of the first being 0.

    Far outside the format where the given camera has no image, or its distortion folds.
    """
    rows, columns = (np.arange(n) + 0.5 for n in (new.sensor.height_px, new.sensor.width_px))
    coarse = [np.linspace(v[0], v[-1], max(len(v) // _STEP, 4)) for v in (rows, columns)]
    found = _at(sensor, interior, new, *coarse)
    if np.isfinite(found).all():
        column, row = (scipy.interpolate.RectBivariateSpline(*coarse, found[k])(rows, columns) for k in (0, 1))
    else:
        # Where nothing is to be seen, nothing can be interpolated.
        column, row = np.nan_to_num(_at(sensor, interior, new, rows, columns), nan=_NOWHERE)
    return column.astype(np.float32), row.astype(np.float32)


def _at(
    sensor: Sensor, interior: InteriorOrientation, new: Pinhole, rows: np.ndarray, columns: np.ndarray
) -> Float[np.ndarray, "2 rows columns"]:
    """Column and row in the given photograph of the places on the lines `rows` and `columns` (px); NaN for none."""
    px = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    parts = []
    for begin in range(0, len(px), _CHUNK):
        # Of one size, for one program.
        part = px[np.minimum(np.arange(begin, begin + _CHUNK), len(px) - 1)]
        parts.append(call_compiled(_measured, interior, new.interior, new.sensor.mm_from_px(part)))
    xy = np.concatenate([np.asarray(part) for part in parts])[: len(px)]
    return (sensor.px_from_mm(xy) - 0.5).T.reshape(2, len(rows), len(columns))


def _border(sensor: Sensor, interior: InteriorOrientation, less_px: float) -> tuple[np.ndarray, np.ndarray]:
    """x and y (mm, from the principal point) on the perspective plane of bottom, right, top and left: (4, points).

    Of the border of a format that is `less_px` smaller both ways.
    """
    size = np.array([sensor.width_mm, sensor.height_mm]) - less_px * sensor.pixel_mm
    t = np.linspace(-0.5, 0.5, _ALONG)
    half = np.full(_ALONG, 0.5)
    sides = np.stack([np.stack(s, axis=1) for s in ((t, -half), (half, t), (t, half), (-half, t))])
    xy, good = (np.asarray(v) for v in call_compiled(_plane, interior, (sides * size).reshape(-1, 2)))
    if not good.all():
        raise ValueError(
            "at the border of its format this camera looks at 90 degrees from its axis or more, or its distortion "
            "folds: there is no pinhole camera in its place"
        )
    return xy[:, 0].reshape(4, -1), xy[:, 1].reshape(4, -1)


@eqx.filter_jit
def _plane(interior: InteriorOrientation, measured: Float[Array, "n 2"]):
    """Coordinates on the perspective plane, and whether the camera sees them there."""

    def of_one(xy):
        ideal = interior.ideal_from_measured(xy)
        u, v, w = interior.direction_from_ideal(ideal)
        back = interior.measured_from_ideal(ideal)
        good = (w < 0) & interior.invertible(ideal) & (jnp.abs(back - xy).max() < 1e-6 * interior.c)
        return -interior.c * jnp.stack([u, v]) / w, good

    return jax.vmap(of_one)(measured)


@eqx.filter_jit
def _measured(interior: InteriorOrientation, new: InteriorOrientation, xy: Float[Array, "n 2"]):
    """Measured coordinates (mm) in the given camera of those (mm) in the new one; NaN where there are none."""

    def of_one(one):
        x, y = one - new.principal_point
        ray = (x, y, -jnp.asarray(new.c, x.dtype))
        ideal = interior.ideal_from_direction(*ray)
        good = interior.projection.sees(*ray) & interior.invertible(ideal)
        return jnp.where(good, interior.measured_from_ideal(ideal), jnp.nan)

    return jax.vmap(of_one)(xy)
