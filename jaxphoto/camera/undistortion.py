"""Distortion-free pinhole camera derived from a given camera, and the source position of each of its pixels."""

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
# Number of points along each side of the border of the format.
_ALONG = 200
# Maximum ratio of new to given side lengths; exceeded only near the horizon of a fisheye.
_LARGEST = 4.0
# Spacing (px) of exactly computed positions; the error of the spline between them is below the rounding of the result.
_STEP = 16
_NOWHERE = -1e6
# Number of positions per call of the compiled program.
_CHUNK = 1 << 16


class Pinhole(NamedTuple):
    """Camera without distortion: c and pixel size of the given camera, with a different format."""

    sensor: Sensor
    interior: InteriorOrientation


def pinhole(sensor: Sensor, interior: InteriorOrientation, keep: Keep = "crop") -> Pinhole:
    """Return the camera of undistorted photographs.

    `crop`: the largest format inside the given format; `all`: the smallest format that contains it. Raises ValueError
    if the distortion is not invertible at the border of the given format, if the border is 90 degrees or more from the
    axis, and if the new format would be more than four times as wide or high.
    """
    # Shrink the format, because interpolation needs pixel centres on all sides.
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
    """Return column and row in the given photograph for every pixel of the new camera; the first pixel centre is 0.

    Positions are far outside the format where the given camera has no image or its distortion is not invertible.
    """
    rows, columns = (np.arange(n) + 0.5 for n in (new.sensor.height_px, new.sensor.width_px))
    coarse = [np.linspace(v[0], v[-1], max(len(v) // _STEP, 4)) for v in (rows, columns)]
    found = _at(sensor, interior, new, *coarse)
    if np.isfinite(found).all():
        column, row = (scipy.interpolate.RectBivariateSpline(*coarse, found[k])(rows, columns) for k in (0, 1))
    else:
        # Mark pixels without an image, which cannot be interpolated.
        column, row = np.nan_to_num(_at(sensor, interior, new, rows, columns), nan=_NOWHERE)
    return column.astype(np.float32), row.astype(np.float32)


def _at(
    sensor: Sensor, interior: InteriorOrientation, new: Pinhole, rows: np.ndarray, columns: np.ndarray
) -> Float[np.ndarray, "2 rows columns"]:
    """Return column and row (px) in the given photograph of the grid of `rows` and `columns`; NaN without an image."""
    px = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    parts = []
    for begin in range(0, len(px), _CHUNK):
        # Pad all batches to one size, so one compiled program serves all.
        part = px[np.minimum(np.arange(begin, begin + _CHUNK), len(px) - 1)]
        parts.append(call_compiled(_measured, interior, new.interior, new.sensor.mm_from_px(part)))
    xy = np.concatenate([np.asarray(part) for part in parts])[: len(px)]
    return (sensor.px_from_mm(xy) - 0.5).T.reshape(2, len(rows), len(columns))


def _border(sensor: Sensor, interior: InteriorOrientation, less_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y (mm, from the principal point) along the bottom, right, top and left border: (4, points).

    The points are on the perspective plane. The format is reduced by `less_px` in both directions.
    """
    size = np.array([sensor.width_mm, sensor.height_mm]) - less_px * sensor.pixel_mm
    t = np.linspace(-0.5, 0.5, _ALONG)
    half = np.full(_ALONG, 0.5)
    sides = np.stack([np.stack(s, axis=1) for s in ((t, -half), (half, t), (t, half), (-half, t))])
    xy, good = (np.asarray(v) for v in call_compiled(_plane, interior, (sides * size).reshape(-1, 2)))
    if not good.all():
        raise ValueError(
            "at the border of its format this camera sees directions 90 degrees or more from its axis, or its "
            "distortion is not invertible: no pinhole camera can replace it"
        )
    return xy[:, 0].reshape(4, -1), xy[:, 1].reshape(4, -1)


@eqx.filter_jit
def _plane(interior: InteriorOrientation, measured: Float[Array, "n 2"]):
    """Return coordinates on the perspective plane, and True where they have an image in the camera."""

    def of_one(xy):
        ideal = interior.ideal_from_measured(xy)
        u, v, w = interior.direction_from_ideal(ideal)
        back = interior.measured_from_ideal(ideal)
        good = (w < 0) & interior.invertible(ideal) & (jnp.abs(back - xy).max() < 1e-6 * interior.c)
        return -interior.c * jnp.stack([u, v]) / w, good

    return jax.vmap(of_one)(measured)


@eqx.filter_jit
def _measured(interior: InteriorOrientation, new: InteriorOrientation, xy: Float[Array, "n 2"]):
    """Convert coordinates (mm) in the new camera to measured coordinates (mm) in the given camera; NaN if none."""

    def of_one(one):
        x, y = one - new.principal_point
        ray = (x, y, -jnp.asarray(new.c, x.dtype))
        ideal = interior.ideal_from_direction(*ray)
        good = interior.projection.sees(*ray) & interior.invertible(ideal)
        return jnp.where(good, interior.measured_from_ideal(ideal), jnp.nan)

    return jax.vmap(of_one)(xy)
