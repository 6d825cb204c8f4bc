"""Edits of a block: another camera, shifted stations. Numbers may be traced by JAX; names may not."""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

import jax
import numpy as np

from jaxphoto.arrays import namespace
from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names, set_parameter
from jaxphoto.errors import InputError
from jaxphoto.unknowns import FIXED, FREE

# `block` is a `jaxphoto.Block`, which has these functions as methods.


def with_interior(block: Any, camera: str, interior: InteriorOrientation, priors: InteriorOrientation) -> Any:
    """`block` with another interior orientation of `camera`, and its priors."""
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
    """Priors of a camera: `free` parameters are FREE, `others` have the prior that `known` has, the rest is FIXED.

    Raises InputError for a parameter that the camera does not have.
    """
    names, priors = parameter_names(interior), jax.tree.map(lambda _: FIXED, interior)
    for name in others:
        if name in names and name in parameter_names(known):
            priors = set_parameter(priors, name, get_parameter(known, name))
    for name in free:
        if name not in names:
            raise InputError(f"free: the camera has no parameter {name!r}; it has {', '.join(names)}")
        priors = set_parameter(priors, name, FREE)
    return priors


def shifted_stations(block: Any, shift: Any, per: str) -> Any:
    """`block` with stations shifted by `shift`: (3,), or a row for each owner `per` strip, image or partition.

    Raises InputError for a shift of another shape, and for a name that owns no image.
    """
    rows, owners = block.stations, block.owners(per)
    names = [name for name in dict.fromkeys(owners) if name or per == "block"]
    if isinstance(shift, Mapping):
        if unknown := [name for name in shift if name not in names]:
            raise InputError(f"shift_stations: there is no {per} {unknown[0]!r}; there are {', '.join(names)}")
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
