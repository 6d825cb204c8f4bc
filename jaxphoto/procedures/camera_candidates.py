"""Candidate distortion models of a block: a model with some coefficients estimated, others fixed at 0."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Block
from jaxphoto.camera import AbstractDistortion, InteriorOrientation, Sensor, exact, get_parameter, set_parameter
from jaxphoto.camera.conversion import fitted
from jaxphoto.errors import InputError
from jaxphoto.unknowns import FIXED, FREE, Unknowns, Weighted


class Candidate(NamedTuple):
    """Distortion model of which only `free` is estimated; its other coefficients are fixed at 0."""

    name: str
    distortion: type[AbstractDistortion]
    free: tuple[str, ...]

    def within(self, other: "Candidate") -> bool:
        """Return True if `other` is this candidate with more coefficients."""
        return self.distortion is other.distortion and set(self.free) < set(other.free)


def candidate_of(text: str) -> Candidate:
    """Parse `brown` (its usual coefficients), `brown:all`, `brown:none` or `brown:k1+k2`.

    Raises InputError for an unknown model or coefficient.
    """
    model, _, listed = text.strip().partition(":")
    kind = AbstractDistortion.called(model)
    estimable = tuple(name for name in kind.coefficients if name not in kind.scales)
    if listed in ("", "all"):
        return Candidate(text.strip(), kind, estimable if listed else kind.usual())
    names = () if listed == "none" else tuple(name.strip() for name in listed.split("+"))
    for name in names:
        if name not in estimable:
            raise InputError(f"{text}: {model} has no coefficient {name!r} to estimate; it has {', '.join(estimable)}")
    return Candidate(text.strip(), kind, tuple(name for name in estimable if name in names))


def with_candidate(block: Block, candidate: Candidate, known: Unknowns | None) -> Block:
    """Return the block with the candidate for all cameras, starting at `known` orientations and points if given.

    c, x_p and y_p keep their priors: a weighted value is transformed if the conversion to another model changes it, as
    SMAC's c with R0. All coefficients of the candidate are free, even weighted ones: otherwise models with a prior
    would explain an additional observation. They start from the block's distortion, converted if its model differs.
    Residuals are of measured coordinates, for every model.
    """
    interior, priors = {}, {}
    for name, given in block.start.unknowns.interior.items():
        interior[name] = _start(given, candidate, block.sensors[name])
        priors[name] = _priors(given, block.priors.interior[name], interior[name], candidate.free)
    block = eqx.tree_at(lambda b: (b.start.unknowns.interior, b.priors.interior), block, (interior, priors))
    if known is None:
        return block
    places = lambda b: (b.start.unknowns.exterior, b.start.unknowns.points)  # noqa: E731
    block = eqx.tree_at(places, block, (known.exterior, known.points))
    everything = (np.ones(len(block.images), bool), np.ones(len(block.points), bool))
    return eqx.tree_at(lambda b: (b.start.image_known, b.start.point_known), block, everything)


def _start(given: InteriorOrientation, candidate: Candidate, sensor: Sensor) -> InteriorOrientation:
    kind = candidate.distortion
    held = tuple(name for name in kind.coefficients if name not in candidate.free)
    try:
        same = exact(given, kind)
        # A fit must know the fixed coefficients: rational terms are meaningless without each other.
        interior = same if same is not None else fitted(given, kind, sensor, held).interior
    except ValueError:
        # A candidate that does not fit the given distortion starts without distortion.
        interior = dataclasses.replace(given, distortion=kind.plain(sensor))
    interior = dataclasses.replace(interior, residuals="measured")
    for name in held:
        interior = set_parameter(interior, name, 0.0)
    return jax.tree.map(as_jax_array, interior)


def _priors(given: InteriorOrientation, priors, interior: InteriorOrientation, free: tuple[str, ...]):
    """Return priors of the candidate, whose camera `interior` was converted from the `given` one."""
    own = jax.tree.map(lambda _: FIXED, interior)
    scale = float(interior.c) / float(given.c)
    for name, factor in (("c_mm", scale), ("xp_mm", 1.0), ("yp_mm", 1.0)):
        prior = get_parameter(priors, name)
        if isinstance(prior, Weighted):
            # At the same distance from the start, in the unit that c now has.
            start, before = (float(get_parameter(camera, name)) for camera in (interior, given))
            prior = Weighted(start + factor * (float(prior.value) - before), factor * float(prior.sigma))
        own = set_parameter(own, name, prior)
    for name in free:
        own = set_parameter(own, name, FREE)
    return own
