"""Which model of the lens a calibration estimates, and which of its parameters."""

from collections.abc import Sequence

from jaxphoto.camera import AbstractDistortion, InteriorOrientation, Sensor, Smac, parameter_names
from jaxphoto.errors import InputError

_CENTRAL = ("c_mm", "xp_mm", "yp_mm")


def distortion_model(name: str, sensor: Sensor, r0_mm: float = 0.0) -> AbstractDistortion:
    """The model called `name` in block.toml, without distortion, with constants that fit the sensor (`plain`).

    Raises InputError for an unknown name, and for an R0 of another model than SMAC or one beyond the format.
    """
    kind, longer = AbstractDistortion.called(name), max(sensor.width_mm, sensor.height_mm)
    if kind is Smac:
        if not 0 <= r0_mm <= longer:
            raise InputError(f"R0 = {r0_mm:g} mm does not lie on an image of {longer:.4g} mm; give 0 to {longer:.4g}")
        return Smac(r0=r0_mm)
    if r0_mm:
        raise InputError(f"R0 belongs to the model smac; leave it out with {name}, or choose smac")
    return kind.plain(sensor)


def free_parameters(name: str, distortion: AbstractDistortion, wanted: Sequence[str] | None = None) -> tuple[str, ...]:
    """The parameters to estimate, in the order of the model: `wanted` (c, xp, yp stand for c_mm, ...), or the usual.

    The usual are c, the principal point, and the coefficients that a board tells (`AbstractDistortion.usual`): for SMAC
    and Brown K1-K3, P1, P2; affinity, rational and highest terms only where they are wanted. Raises
    InputError for names that the model has not, and for a scale coefficient beside c.
    """
    names = parameter_names(InteriorOrientation(1.0, distortion=distortion))
    if wanted is None:
        usual = distortion.usual()
        return tuple(n for n in names if n in (*_CENTRAL, *usual))
    asked = [f"{n}_mm" if n in ("c", "xp", "yp") else n for n in wanted]
    for parameter in asked:
        if parameter not in names:
            raise InputError(f"the model {name} has no parameter {parameter!r}; it has {', '.join(names)}")
    if both := [scale for scale in distortion.scales if scale in asked and "c_mm" in asked]:
        raise InputError(f"{both[0]} changes the scale as c does: leave {both[0]} or c out of what is free")
    return tuple(n for n in names if n in asked)
