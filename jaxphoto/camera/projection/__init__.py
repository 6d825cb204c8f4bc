"""Projections: one final class each over one abstract base, found by the name a file gives it.

A new projection is one file here and its line below.
"""

from typing import TYPE_CHECKING

# In the order of tables and messages.
# ruff: isort: off
from jaxphoto.camera.projection.base import AbstractProjection as AbstractProjection
from jaxphoto.camera.projection.perspective import Perspective as Perspective
from jaxphoto.camera.projection.equidistant import Equidistant as Equidistant
from jaxphoto.camera.projection.equisolid import Equisolid as Equisolid
from jaxphoto.camera.projection.stereographic import Stereographic as Stereographic
from jaxphoto.camera.projection.orthographic import Orthographic as Orthographic
# ruff: isort: on

PROJECTIONS = AbstractProjection.known()
"""The projections of jaxphoto by the names that files give them; `AbstractProjection.known()` has users' own, too."""

if not TYPE_CHECKING:
    # Checkers of types would take a list that is computed for an empty one; the aliases above tell them the same.
    __all__ = sorted(["PROJECTIONS", "AbstractProjection", *(model.__name__ for model in PROJECTIONS.values())])
