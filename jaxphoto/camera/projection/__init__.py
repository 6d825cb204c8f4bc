"""Projections: one final class per projection, selected by its name in files.

To add a projection, add its file to this folder and its import below.
"""

from typing import TYPE_CHECKING

# The order of imports is the order in tables and messages.
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
    # Type checkers read a computed list as empty; the aliases above export the names.
    __all__ = sorted(["PROJECTIONS", "AbstractProjection", *(model.__name__ for model in PROJECTIONS.values())])
