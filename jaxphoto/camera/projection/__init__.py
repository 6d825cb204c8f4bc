"""Projections: one final class each with a common base, found by its name in files.

A new projection is one file here and its line below.
"""

from typing import TYPE_CHECKING

# Order of tables and messages.
# ruff: isort: off
from jaxphoto.camera.projection.base import AbstractProjection as AbstractProjection
from jaxphoto.camera.projection.perspective import Perspective as Perspective
from jaxphoto.camera.projection.equidistant import Equidistant as Equidistant
from jaxphoto.camera.projection.equisolid import Equisolid as Equisolid
from jaxphoto.camera.projection.stereographic import Stereographic as Stereographic
from jaxphoto.camera.projection.orthographic import Orthographic as Orthographic
# ruff: isort: on

PROJECTIONS = AbstractProjection.known()
"""Projections of jaxphoto by name in files; `AbstractProjection.known()` includes user-defined ones."""

if not TYPE_CHECKING:
    # Type checkers would take a computed list for an empty one; the aliases above serve them.
    __all__ = sorted(["PROJECTIONS", "AbstractProjection", *(model.__name__ for model in PROJECTIONS.values())])
