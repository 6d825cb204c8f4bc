"""Checks of the arguments of an adjustment: types, shapes, finite values."""

from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.errors import InputError
from jaxphoto.unknowns import Unknowns, is_prior


def check_arguments(block: Any, start: Any, priors: Any) -> None:
    """Raise InputError for inconsistent arguments; traced values are not examined."""
    if not isinstance(block, Block):
        raise InputError(f"adjust takes a Block first, got {type(block).__name__}")
    for name, tree, cure in (
        ("start", start, "adjusted.unknowns or block.start.unknowns"),
        ("priors", priors, "block.priors, or jaxphoto.default_priors of the start values"),
    ):
        if not isinstance(tree, Unknowns):
            raise InputError(f"{name} is of the type {type(tree).__name__}: give Unknowns, such as {cure}")
    _check_owners("start", start, block.start.unknowns)
    _check_owners("priors", priors, start)
    _check_models(start, priors)
    _check_shapes(block, start)
    for place in _no_numbers(block, start, priors):
        raise InputError(f"{place} is NaN or infinite: give a number, or omit it")


def check_residuals(block: Block, residuals: Mapping[str, Any]) -> None:
    """Raise InputError if a group of observations has NaN or infinite residuals while those of the images are finite.

    Then its own formula is not defined at these unknowns.
    """
    if _bad(residuals[IMAGE_POINTS]) is not None:
        return
    for group, rows in block.named_observations.items():
        bad = _bad(residuals.get(group, 0.0))
        if bad is not None:
            words = np.broadcast_to(rows.words(block.images, block.points), np.shape(residuals[group]))
            raise InputError(
                f"{group}: the residual of {words[bad]} is NaN or infinite: check the formula of "
                f"{type(rows).__name__}.residual, such as a logarithm, root or quotient outside its domain"
            )


def _check_owners(name: str, tree: Unknowns, known: Unknowns) -> None:
    """Raise InputError if an owner of parameters is missing."""
    for camera in known.interior:
        if camera not in tree.interior:
            raise InputError(
                f"{name} lacks camera {camera!r} of the block; it has {', '.join(tree.interior) or 'none'}"
            )
    for kind, owners in known.tables.items():
        for owner in owners:
            if owner not in tree.tables.get(kind, {}):
                raise InputError(f"{name} lacks {kind}[{owner}]: copy it from block.start.unknowns")


def _check_models(start: Unknowns, priors: Unknowns) -> None:
    """Raise InputError if priors and start values belong to different camera models."""
    for camera, interior in start.interior.items():
        for part in ("distortion", "projection"):
            given, wanted = getattr(priors.interior[camera], part), getattr(interior, part)
            # A prior of None is reported later, by parameter.
            structure: Any = jax.tree.structure(given, is_leaf=lambda v: v is None or is_prior(v))
            if structure != jax.tree.structure(wanted):
                found = f"another {type(given).__name__}" if type(given) is type(wanted) else type(given).__name__
                raise InputError(
                    f"interior[{camera}].{part}: priors have {found}, start has {type(wanted).__name__}; replace both "
                    f'together, as block.with_distortion("{camera}", ...) does'
                )


def _check_shapes(block: Block, start: Unknowns) -> None:
    n, m = len(block.images), len(block.points)
    for label, value, shape in (
        ("exterior.position", start.exterior.position, (n, 3)),
        ("exterior.camera_from_object", start.exterior.camera_from_object, (n, 3, 3)),
        ("points", start.points, (m, 3)),
    ):
        if np.shape(value) != shape:
            raise InputError(
                f"start.{label} has the shape {np.shape(value)}, the block needs {shape} for {n} images and {m} points"
            )


def _no_numbers(block: Block, start: Unknowns, priors: Unknowns) -> Iterator[str]:
    """Return the labels of NaN and infinite values."""
    for group, rows in block.named_observations.items():
        for name, values in (("value", rows.observation), ("sigma", rows.sigmas)):
            # An infinite standard deviation means zero weight.
            bad = _bad(values, may_be_infinite=name == "sigma")
            if bad is not None:
                words = np.broadcast_to(rows.words(block.images, block.points), np.shape(np.asarray(values).T))
                yield f"{group}: the {name} of {words.T[bad]}"
    for tree, label in ((start, "start"), (priors, "priors")):
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            bad = _bad(leaf)
            if bad is not None:
                at = "".join(f"[{k}]" for k in bad)
                names = {"position": block.images, "camera_from_object": block.images, "points": block.points}
                owner = names.get(getattr(path[-1], "name", ""))
                of = f" (of {owner[bad[0]]})" if owner and bad else ""
                yield f"{label}{jax.tree_util.keystr(path)}{at}{of}"


def _bad(values: Any, may_be_infinite: bool = False) -> tuple[int, ...] | None:
    """Return the index of the first NaN or infinite value; None if all are finite or traced."""
    array = to_numpy(values)
    if isinstance(array, jax.core.Tracer) or array.dtype.kind != "f":
        return None
    wrong = np.isnan(array) if may_be_infinite else ~np.isfinite(array)
    return tuple(int(k) for k in np.argwhere(wrong)[0]) if wrong.any() else None
