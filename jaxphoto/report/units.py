"""Units of numbers by their names: the end of a name, and of a camera's parameters what its model declares."""

import re
from collections.abc import Mapping

from jaxphoto.camera import InteriorOrientation, parameter_names, parameter_unit

# Names end in their units, the longest first.
_UNITS = {
    "m_per_s": "m/s", "deg_per_s": "deg/s", "rad_per_s": "rad/s", "mm_per_s": "mm/s", "mm_per_h": "mm/h",
    "per_h": "1/h", "mm_per_K": "mm/K", "per_K": "1/K", "deg": "deg", "rad": "rad", "mm": "mm", "ms": "ms",
    "m": "m", "s": "s", "px": "px", "cm": "cm", "ppm": "ppm",
}  # fmt: skip
_UNIT = re.compile(r"_(" + "|".join(_UNITS) + r")$")


def without_unit(name: str) -> tuple[str, str]:
    """A name without the unit that ends it, and that: ("sigma_X", "m") of sigma_X_m; "" where there is none."""
    unit = _UNIT.search(name)
    return (name[: unit.start()], _UNITS[unit[1]]) if unit else (name, "")


def label_unit(label: str, cameras: Mapping[str, InteriorOrientation]) -> str:
    """The unit of `interior[kodak].k1`, as its model has it, or the end of any other label; "" where none is told."""
    owner, _, parameter = label.rpartition("].")
    kind, _, name = owner.partition("[")
    if kind == "points" and not without_unit(parameter)[1]:
        return "m"
    return _unit_of(name if kind == "interior" else "", parameter, cameras)


def column_unit(column: str, cameras: Mapping[str, InteriorOrientation]) -> str:
    """The same of a column of draws: `kodak.k1`, `bias.kodak.k1`, `strips.E1.shift_X_m`."""
    camera, _, parameter = column.removeprefix("bias.").rpartition(".")
    return _unit_of(camera, parameter, cameras)


def _unit_of(camera: str, parameter: str, cameras: Mapping[str, InteriorOrientation]) -> str:
    if camera in cameras and parameter in parameter_names(cameras[camera]):
        return parameter_unit(cameras[camera], parameter)
    return without_unit(parameter)[1]
