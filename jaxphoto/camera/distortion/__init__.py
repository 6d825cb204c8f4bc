"""Lens distortion: one final class per model over one abstract base, found by the name a file gives it.

A new model is one file here and its line below.
"""

from typing import TYPE_CHECKING

# In the order of tables and messages.
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
"""The models of jaxphoto by the names that files give them; `AbstractDistortion.known()` has users' own, too."""

if not TYPE_CHECKING:
    # Checkers of types would take a list that is computed for an empty one; the aliases above tell them the same.
    __all__ = sorted(
        ["DISTORTIONS", "AbstractDistortion", "invert", *(model.__name__ for model in DISTORTIONS.values())]
    )
