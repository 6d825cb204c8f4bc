"""Lens distortion: one final class per model over one abstract base, found by the name a file gives it."""

from jaxphoto.camera.distortion.affine_brown import AffineBrown
from jaxphoto.camera.distortion.balanced import Balanced
from jaxphoto.camera.distortion.base import AbstractDistortion, invert
from jaxphoto.camera.distortion.brown import Brown
from jaxphoto.camera.distortion.smac import Smac

DISTORTIONS: dict[str, type[AbstractDistortion]] = {
    "brown": Brown,
    "affine_brown": AffineBrown,
    "smac": Smac,
    "balanced": Balanced,
}

__all__ = ["DISTORTIONS", "AbstractDistortion", "AffineBrown", "Balanced", "Brown", "Smac", "invert"]
