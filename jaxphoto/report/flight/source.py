"""Where a flight comes from: what its files said, and how it was computed."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from jaxphoto.camera import InteriorOrientation
from jaxphoto.camera.conditions import Conditions
from jaxphoto.procedures.rolling_shutter import Moment
from jaxphoto.writing.inputs import InputFile


class FlightSource(NamedTuple):
    """What is told of a flight besides its adjustment; nothing of it is needed."""

    positions_from: Sequence[str] = ()
    """Sentences that say where positions come from."""
    camera_from: str = ""
    """A sentence that says where the camera began."""
    start: InteriorOrientation | None = None
    """The camera as it began."""
    taken: Mapping[str, Moment] = MappingProxyType({})
    """When photographs were taken, by their names."""
    conditions: Sequence[Conditions] = ()
    inputs: Sequence[InputFile] = ()
    told: Mapping[str, Any] = MappingProxyType({})
    """How the results came about: goes into the summaries as it is."""
    written: str = ""
    """The date of the results."""
    command: str = ""
    """As it is typed."""
