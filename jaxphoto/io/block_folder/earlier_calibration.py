"""An earlier calibration of a camera as what is known of it beforehand: `calibration = "../last_year"` in its table.

It stands for format, models, interior orientation and, with its full covariance, what it knows of the parameters
([cameras.X.known]). What it held is held here, too, unless [cameras.X.unknowns] says otherwise.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxphoto.camera import get_parameter

# The module, not its function: a camera file may be a block.toml, which it reads by modules of this package.
from jaxphoto.io import camera_files
from jaxphoto.io.block_folder.camera_section import Camera, camera_section, known_together
from jaxphoto.io.block_folder.section import Section
from jaxphoto.observations import KnownParameters
from jaxphoto.unknowns import FIXED

_KEY = "calibration"
# What else a table with an earlier calibration may have.
_BESIDE = (_KEY, "residuals", "unknowns")


def with_earlier_calibrations(settings: dict[str, Any], file: str, folder: Path) -> dict[str, Any]:
    """The content of block.toml in `folder` with what earlier calibrations say in the tables of their cameras.

    Raises InputError for calibrations that cannot be read, are without covariance, or stand beside what they say.
    """
    cameras = settings.get("cameras", {})
    if not isinstance(cameras, dict) or not any(isinstance(own, dict) and _KEY in own for own in cameras.values()):
        return settings
    found = {}
    for name, own in cameras.items():
        section = Section(file, f"cameras.{name}", own if isinstance(own, dict) else {})
        if _KEY not in section:
            found[name] = own
            continue
        for key in section:
            if key not in _BESIDE:
                beside = ", ".join(_BESIDE[1:])
                raise section.error(key, f"the calibration says it; only {beside} stand beside it: remove it")
        given = own[_KEY] if isinstance(own[_KEY], dict) else {"file": own[_KEY]}
        named = Section(file, f"cameras.{name}.{_KEY}", given)
        named.known("file", "camera")
        camera = named.text("camera") if "camera" in named else None
        read = camera_files.read_camera_file(folder / named.text("file"), camera=camera)
        if read.covariance is None:
            raise section.error(
                _KEY, f"{named.text('file')} has no covariance; name results of jaxphoto adjust, or a camera file of it"
            )
        priors = jax.tree.map(lambda _: FIXED, read.interior)
        known = known_together(read.interior, read.covariance)
        table = camera_section(Camera(read.sensor, read.interior, priors, known, read.note))
        fixed = {key: value for key, value in table["unknowns"].items() if key not in known.parameters}
        found[name] = table | own | {"unknowns": fixed | own.get("unknowns", {})}
        del found[name][_KEY]
    return settings | {"cameras": found}


def known_cameras(cameras: Mapping[str, Camera]) -> tuple[KnownParameters, ...]:
    """What is known beforehand of the parameters of each camera together."""
    found = []
    for name, camera in cameras.items():
        if camera.known is not None:
            parameters, covariance = camera.known
            values = np.array([float(get_parameter(camera.interior, parameter)) for parameter in parameters])
            labels = [f"interior[{name}].{p}" for p in parameters]
            found.append(KnownParameters(labels, values, covariance, camera.reservation))
    return tuple(found)
