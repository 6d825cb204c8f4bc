"""Edits of a block: priors, cameras, control, stations. Values may be traced by JAX; names may not."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any, Self

import equinox as eqx
import jax
import numpy as np

from jaxphoto.argument_checks import require
from jaxphoto.arrays import is_traced, namespace
from jaxphoto.camera import (
    AbstractDistortion,
    InteriorOrientation,
    Sensor,
    get_parameter,
    parameter_names,
    set_parameter,
    table_name,
)
from jaxphoto.errors import InputError
from jaxphoto.short_repr import from_upstairs
from jaxphoto.unknowns import FIXED, FREE, weighted, with_prior


class BlockEdits(eqx.Module):
    """Methods of `Block` that return an edited copy."""

    def fix(self, *names: str, value: Any = None, of: str | None = None) -> Self:
        """Return a copy with parameters fixed at their start values, or one parameter fixed at `value` (mm, m, rad).

        `block.fix("k2", "k3")`, `block.fix("lever_arm", value=[0.0, 0.0, 0.8])`. Names are `c` (or `c_mm`, as in
        tables), `xp`, `yp`, `k1`; fields of mounts and strips (`lever_arm`, `shift`); `position`, `rotation` (all
        images) and `points`. `of` names the camera, mount or strip; by default all owners of the parameter. `value` may
        be traced. Raises InputError for a parameter that the block does not have, without a name, and for a value of
        several parameters or of another shape.
        """
        fixed: Any = self._with_priors(names, lambda start: FIXED, of)
        if value is None:
            return fixed
        if len(names) != 1:
            raise InputError(f"fix: one value for {len(names)} parameters: fix each of them with its own value")
        (name,), unknowns = names, fixed.start.unknowns

        def valid(start: Any) -> Any:
            return namespace(value).broadcast_to(weighted(name, start, value, 1.0).value, np.shape(start))

        changed = with_prior(unknowns, name, valid, unknowns, of)
        return dataclasses.replace(fixed, start=dataclasses.replace(fixed.start, unknowns=changed))

    def free(self, *names: str, of: str | None = None) -> Self:
        """Return a copy with free parameters; names as in `fix`."""
        return self._with_priors(names, lambda start: FREE, of)

    def weigh(self, name: str, sigma: Any, value: Any = None, of: str | None = None) -> Self:
        """Return a copy with a parameter observed with `sigma`, in its own unit (mm, m, rad); names as in `fix`.

        The observed `value` defaults to the start value; for all positions, rotations or points it is required. Raises
        InputError for a sigma that is not positive, and for values that are not numbers or have a different shape.
        """
        if value is None and name in ("position", "rotation", "points"):
            raise InputError(f"weigh({name!r}) needs a value with its sigma: its start value is not an observation")
        return self._with_priors(
            (name,), lambda start: weighted(name, start, start if value is None else value, sigma), of
        )

    def with_camera(
        self,
        camera: str,
        interior: InteriorOrientation,
        free: Collection[str] | None = None,
        sensor: Sensor | None = None,
    ) -> Self:
        """Return a copy with a new interior orientation of `camera`, and its priors.

        `free` names the estimated parameters; all others are FIXED. Without `free`, parameters retain the priors of the
        block for their names, and new ones are FIXED. Raises InputError for a camera that the block does not have, and
        for a parameter that `interior` does not have.
        """
        block: Any = self
        name, others = one_camera(block, camera), parameter_names(interior) if free is None else ()
        priors = priors_of_camera(interior, block.priors.interior[name], free or (), others)
        changed = with_interior(block, name, interior, priors)
        return changed if sensor is None else dataclasses.replace(changed, sensors={**block.sensors, name: sensor})

    def with_distortion(self, camera: str, distortion: AbstractDistortion, free: Collection[str] = ()) -> Self:
        """Return a copy with a new distortion of `camera`: `block.with_distortion("kodak", Smac(), free=("k1", "k2"))`.

        `free` names the estimated coefficients; the others are FIXED, and c, xp and yp retain their priors.
        Raises InputError as `with_camera` does, and for a distortion without derivative on the optical axis.
        """
        block: Any = self
        name = one_camera(block, camera)
        require(distortion, AbstractDistortion, "give a model with its coefficients, such as jaxphoto.Brown()")
        interior = dataclasses.replace(block.start.unknowns.interior[name], distortion=distortion)
        if not is_traced(interior):
            half = np.array([block.sensors[name].width_mm, block.sensors[name].height_mm]) / 2
            places = half * np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 2), axis=-1).reshape(-1, 2)
            distortion.check(places / float(interior.c) if distortion.normalised else places)
        others = set(parameter_names(interior)) - set(distortion.coefficients)
        return with_interior(
            block, name, interior, priors_of_camera(interior, block.priors.interior[name], free, others)
        )

    def shift_stations(self, shift: Any, per: str = "block") -> Self:
        """Return a copy with stations shifted by (X, Y, Z) in metres: `block.shift_stations([0, 0, 0.1])`.

        With `per` ("strip", "image", "camera" or a partition) each owner has its own shift: rows in order of first
        appearance of the owners in `images`, or a dictionary by owner name.
        """
        return shifted_stations(self, shift, per)

    def with_control(self, *points: str, sigma: Any = None) -> Self:
        """Return a copy in which the named `points` are control points; all other surveyed points become check points.

        `sigma` (m, one or one per axis) applies to check coordinates without one. Raises InputError for a point without
        surveyed coordinates.
        """
        return from_upstairs("with_control", "variants")(self, points, sigma)

    def without_images(self, *images: str) -> Self:
        """Return a copy without these images, and without points that then appear in fewer than two images.

        Raises InputError for an image that the block does not have.
        """
        return from_upstairs("without_images", "variants")(self, images)

    def _with_priors(self, names: tuple[str, ...], prior_of: Callable[[Any], Any], of: str | None) -> Self:
        block: Any = self
        priors = block.priors
        for name in names or ("",):
            if not isinstance(name, str) or not name:
                asked = f"{name!r} is not a parameter name" if names else "no parameter given"
                raise InputError(f"{asked}: give names separated by commas, such as c, k1, lever_arm, position")
        for name in names:
            priors = with_prior(priors, name, prior_of, block.start.unknowns, of)
        return dataclasses.replace(block, priors=priors)


def one_camera(block: Any, camera: str | None) -> str:
    """Return the camera of that name, or the only one if None. Raises InputError if there is none."""
    if camera is None and len(block.sensors) == 1:
        return next(iter(block.sensors))
    if camera is None or camera not in block.sensors:
        asked = "name the camera" if camera is None else f"unknown camera {camera}"
        raise InputError(f"{asked}: the block has {', '.join(block.sensors) or 'none'}")
    return camera


# `block` is a `jaxphoto.Block`.


def with_interior(block: Any, camera: str, interior: InteriorOrientation, priors: InteriorOrientation) -> Any:
    """Replace the interior orientation of `camera`, and its priors."""
    start = block.start.unknowns
    changed = dataclasses.replace(start, interior={**start.interior, camera: interior})
    return dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=changed),
        priors=dataclasses.replace(block.priors, interior={**block.priors.interior, camera: priors}),
    )


def priors_of_camera(
    interior: InteriorOrientation, known: InteriorOrientation, free: Collection[str], others: Collection[str]
) -> InteriorOrientation:
    """Return priors of a camera: `free` are FREE, `others` retain their prior in `known`, the rest are FIXED.

    Raises InputError for a parameter that the camera does not have.
    """
    names, priors = parameter_names(interior), jax.tree.map(lambda _: FIXED, interior)
    for name in others:
        if name in names and name in parameter_names(known):
            priors = set_parameter(priors, name, get_parameter(known, name))
    for name in map(table_name, free):
        if name not in names:
            raise InputError(f"free: the camera has no parameter {name!r}; it has {', '.join(names)}")
        priors = set_parameter(priors, name, FREE)
    return priors


def shifted_stations(block: Any, shift: Any, per: str) -> Any:
    """Shift the stations of `block` by `shift`: (3,), or one row for each owner `per` strip, image or partition.

    Raises InputError for a shift of another shape, and for a name that owns no image.
    """
    rows, owners = block.stations, block.owners(per)
    names = [name for name in dict.fromkeys(owners) if name or per == "block"]
    if isinstance(shift, Mapping):
        if unknown := [name for name in shift if name not in names]:
            raise InputError(f"shift_stations: unknown {per} {unknown[0]!r}; choose among {', '.join(names)}")
        shift = [shift.get(name, np.zeros(3)) for name in names]
    xp = namespace(shift, rows.value)
    own, expected = xp.asarray(shift, float), (3,) if per == "block" else (len(names), 3)
    if own.shape not in (expected, (3,)):
        words = f"{len(names)} rows, one for each {per}, of X, Y, Z" if len(expected) == 2 else "X, Y, Z"
        raise InputError(f"shift_stations: the shift has the shape {own.shape}; give {words} in metres")
    of_name = xp.concatenate([xp.broadcast_to(own, (len(names), 3)), xp.zeros((1, 3))])
    place = {name: k for k, name in enumerate(names)}
    of_image = np.array([place.get(name, len(names)) for name in owners], int)
    value = xp.asarray(rows.value) + of_name[of_image[rows.who], rows.axis]
    return dataclasses.replace(block, stations=rows.with_observation(value))
