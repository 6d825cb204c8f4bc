"""Lens distortion: one final class per model, selected by its name in files.

To add a model, add its file to this folder and its import below.
"""

from typing import TYPE_CHECKING

# The order of imports is the order in tables and messages.
# ruff: isort: off
from jaxphoto.camera.distortion.base import AbstractDistortion as AbstractDistortion
from jaxphoto.camera.distortion.base import invert as invert
from jaxphoto.camera.distortion.brown import Brown as Brown
from jaxphoto.camera.distortion.affine_brown import AffineBrown as AffineBrown
from jaxphoto.camera.distortion.brown_affine import BrownAffine as BrownAffine
from jaxphoto.camera.distortion.stretched_brown import StretchedBrown as StretchedBrown
from jaxphoto.camera.distortion.smac import Smac as Smac
from jaxphoto.camera.distortion.balanced import Balanced as Balanced
from jaxphoto.camera.distortion.radial_polynomial import RadialPolynomial as RadialPolynomial
from jaxphoto.camera.distortion.pps_radial import PpsRadial as PpsRadial
from jaxphoto.camera.distortion.ebner import Ebner as Ebner
from jaxphoto.camera.distortion.gruen import Gruen as Gruen
from jaxphoto.camera.distortion.brown14 import Brown14 as Brown14
from jaxphoto.camera.distortion.bundler_radial import BundlerRadial as BundlerRadial
from jaxphoto.camera.distortion.open_cv import OpenCv as OpenCv
from jaxphoto.camera.distortion.agisoft import Agisoft as Agisoft
from jaxphoto.camera.distortion.open_cv_fisheye import OpenCvFisheye as OpenCvFisheye
# ruff: isort: on

DISTORTIONS = AbstractDistortion.known()
"""Models of jaxphoto by name in files; `AbstractDistortion.known()` includes user-defined ones."""

if not TYPE_CHECKING:
    # Type checkers read a computed list as empty; the aliases above export the names.
    __all__ = sorted(
        ["DISTORTIONS", "AbstractDistortion", "invert", *(model.__name__ for model in DISTORTIONS.values())]
    )
