"""Lens distortion: one final class per model over one abstract base, found by the name a file gives it."""

from jaxphoto.camera.distortion.affine_brown import AffineBrown
from jaxphoto.camera.distortion.agisoft import Agisoft
from jaxphoto.camera.distortion.balanced import Balanced
from jaxphoto.camera.distortion.base import AbstractDistortion, invert
from jaxphoto.camera.distortion.brown import Brown
from jaxphoto.camera.distortion.brown14 import Brown14
from jaxphoto.camera.distortion.bundler_radial import BundlerRadial
from jaxphoto.camera.distortion.ebner import Ebner
from jaxphoto.camera.distortion.gruen import Gruen
from jaxphoto.camera.distortion.open_cv import OpenCv
from jaxphoto.camera.distortion.pps_radial import PpsRadial
from jaxphoto.camera.distortion.radial_polynomial import RadialPolynomial
from jaxphoto.camera.distortion.smac import Smac

DISTORTIONS: dict[str, type[AbstractDistortion]] = {
    "brown": Brown,
    "affine_brown": AffineBrown,
    "smac": Smac,
    "balanced": Balanced,
    "radial": RadialPolynomial,
    "pps_radial": PpsRadial,
    "ebner": Ebner,
    "gruen": Gruen,
    "brown14": Brown14,
    "bundler_radial": BundlerRadial,
    "opencv": OpenCv,
    "agisoft": Agisoft,
}

__all__ = [
    "DISTORTIONS", "AbstractDistortion", "AffineBrown", "Agisoft", "Balanced", "Brown", "Brown14", "BundlerRadial",
    "Ebner", "Gruen", "OpenCv", "PpsRadial", "RadialPolynomial", "Smac", "invert",
]  # fmt: skip
