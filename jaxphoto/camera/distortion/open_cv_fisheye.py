"""Fisheye lenses of OpenCV and COLMAP: normalised, from ideal to measured, for the equidistant projection."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Term, decentring, radial, same_terms
from jaxphoto.camera.distortion.open_cv import affine_up


class OpenCvFisheye(AbstractDistortion):
    """k1-k4 of cv2.fisheye, p1, p2, s1, s2 of COLMAP's THIN_PRISM_FISHEYE; `measured = c (u + b1 u + b2 v, v)`.

        u = x q + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2,   v = y q + p1 (r^2 + 2 y^2) + 2 p2 x y + s2 r^2
        q = 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8

    (x, y) is the ideal coordinate divided by c, and in these formulas y points *down*, as in OpenCV and COLMAP;
    `closed_form` converts coordinates with y up, as everywhere in jaxphoto. With the projection `Equidistant`, r is the
    angle from the axis and the radial part is r q = theta (1 + k1 theta^2 + ... + k4 theta^8): the model of Kannala and
    Brandt. c is f_y, with b1 = f_x / f_y - 1 and b2 = alpha f_x / f_y.

    All coefficients have the values of OpenCV and COLMAP, without unit; OPENCV_FISHEYE, RADIAL_FISHEYE and
    SIMPLE_RADIAL_FISHEYE are special cases. Source: OpenCV, calib3d, "Fisheye camera model"; COLMAP,
    src/colmap/sensor/models.h; Kannala and Brandt (2006), equation (6).
    """

    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0
    k3: Float[Array, ""] | float = 0.0
    k4: Float[Array, ""] | float = 0.0
    p1: Float[Array, ""] | float = 0.0
    p2: Float[Array, ""] | float = 0.0
    s1: Float[Array, ""] | float = 0.0
    s2: Float[Array, ""] | float = 0.0
    b1: Float[Array, ""] | float = 0.0
    b2: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "opencv_fisheye"
    domain: ClassVar[Literal["measured", "ideal"]] = "ideal"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4", "p1", "p2", "s1", "s2", "b1", "b2")
    rare: ClassVar[tuple[str, ...]] = ("p1", "p2", "s1", "s2", "b1", "b2")
    # y points down: terms odd in y change sign.
    terms: ClassVar[Mapping[str, Term] | None] = {
        **same_terms("k1", "k2", "k3", "k4", "s1", "b1"),
        **{"p1": Term("p2"), "p2": Term("p1", -1.0), "s2": Term("s2", -1.0), "b2": Term("b2", -1.0)},
    }
    normalised: ClassVar[bool] = True

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map an ideal to the measured coordinate, both reduced to the principal point and divided by c, y up."""
        x, y = xy[0], -xy[1]
        r2 = x * x + y * y
        q = 1 + radial(r2, self.k1, self.k2, self.k3, self.k4)
        dx, dy = decentring(self.p2, self.p1, (x, y))
        return affine_up(x * q + dx + self.s1 * r2, y * q + dy + self.s2 * r2, self.b1, self.b2)
