"""Datum: position, orientation and scale that the observations leave undetermined, and the constraints that fix them.

The seven parameters of a similarity transformation (3 shifts, 3 rotations, scale) move images and points together
without changing any image coordinate. Only other observations (control, stations, distances ...) and fixed unknowns
determine them, possibly only in combination with a free shift or lever arm. The undetermined combinations are the datum
defect, removed by inner or minimal constraints.
"""

from typing import TYPE_CHECKING

import equinox as eqx
import jax
import numpy as np

from jaxphoto.adjustment.datum_messages import datum_sentence
from jaxphoto.adjustment.model.numbers import Values
from jaxphoto.adjustment.model.row_functions import rows_of
from jaxphoto.adjustment.model.structure import Structure
from jaxphoto.adjustment.solver.similarity import DatumRows, motions
from jaxphoto.arrays import is_traced, to_numpy
from jaxphoto.block import Block
from jaxphoto.camera import RollingShutter
from jaxphoto.errors import DatumError
from jaxphoto.observations import PRIORS, ControlCoordinates

if TYPE_CHECKING:
    from jaxphoto.adjustment.datum_sensitivity import SeenMotions

# A rotation (rad) or scale with a larger standard deviation is treated as undetermined: linearisation is not valid at
# this size.
_VAGUE = 0.05


def close_datum(block: Block, values: Values, structure: Structure) -> DatumRows:
    """Return the constraints that remove the datum defect (leading axis: the defect).

    Raises DatumError if the datum is undetermined and its kind is "control", or if the requested constraints cannot
    remove the defect.
    """
    judged = block.datum.kind == "control" and not is_traced((values, block))
    without_place = is_traced((values.points, values.position)) and is_traced(block.start.unknowns)
    values = _concrete(values, block)
    if judged:
        # Use observed positions: approximate values of collinear control scatter about its line, which hides the
        # defect.
        values = _as_observed(block, values)
    if _plainly_closed(block, values, structure, _VAGUE if judged else np.inf):
        return DatumRows(np.zeros((0, 6, structure.n_images)), np.zeros((0, 3, structure.n_points)))
    motions = _motions(values)
    sensitivity, named = _datum_sensitivity(block, values, structure, motions)
    null_motions = sensitivity.null_motions()
    null = _combine(motions, null_motions)
    scale_open = bool(len(null_motions)) and bool(np.abs(null_motions[:, 6]).max() > 1e-6)
    if scale_open and any(t.kind == RollingShutter.kind for t in structure.tables):
        raise DatumError(
            "a rolling shutter needs the scale of the block, which is undetermined: add stations, control or a "
            "distance, or remove the shutter"
        )
    kind, over = block.datum.kind, block.datum.over
    if kind == "control":
        if len(null_motions):
            raise DatumError(datum_sentence(null_motions, block, named))
        if judged:
            _check_vague(block, sensitivity, named)
        return null
    if block.datum.scale is not None and scale_open != block.datum.scale:
        raise DatumError(
            "[datum] scale = false, but the scale of the block is undetermined: add a distance, stations or "
            "control, or set scale = true"
            if scale_open
            else "[datum] scale = true, but distances, stations or control determine it: set scale = false"
        )
    if not len(null_motions):
        return null
    if without_place:
        raise DatumError(
            "a JAX transformation traces the start values, but the constraints of a free network need concrete "
            "ones: define the block outside the transformed function, and pass only what changes"
        )
    constraints = _minimal(null, structure) if kind == "minimal" else _inner(null, block, over)
    product = np.einsum("kci,jci->kj", constraints.eop, null.eop) + np.einsum(
        "kcp,jcp->kj", constraints.points, null.points
    )
    if np.linalg.svd(product, compute_uv=False)[-1] < 1e-9 * np.abs(product).max():
        raise DatumError(
            f'[datum] over = "{over}" cannot fix the datum (they lie on a line or in a point): use all points'
        )
    return _orthonormal(constraints)


def _concrete(values: Values, block: Block) -> Values:
    """Replace traced values: the datum depends only weakly on positions.

    Unknown positions are drawn at random. Whether observations determine the datum depends, except for coincidences,
    only on the unknowns that each observation involves.
    """
    known = block.start.unknowns
    place = {"position": known.exterior.position, "points": known.points}
    near = {k: np.asarray(v, float).T for k, v in place.items() if not isinstance(v, jax.core.Tracer)}
    anywhere = np.random.default_rng(0)

    def number(path, v):
        # Derivatives require only the primal value.
        v = jax.lax.stop_gradient(v)
        if not isinstance(v, jax.core.Tracer):
            return np.asarray(v)
        name = getattr(path[-1], "name", "")
        if name in near:
            return near[name]
        if name in ("rotation", "nominal", "whitener"):
            return np.broadcast_to(np.eye(v.shape[0])[..., None], v.shape)
        # All standard deviations are one.
        return np.ones(v.shape) if name in ("sigma", "sigma_xy") else anywhere.normal(size=v.shape)

    return jax.tree_util.tree_map_with_path(number, values)


def _as_observed(block: Block, values: Values) -> Values:
    """Move control points and images to their observed positions."""
    position, points = np.array(values.position), np.array(values.points)
    position[block.stations.axis, block.stations.who] = to_numpy(block.stations.value)
    points[block.control.axis, block.control.who] = to_numpy(block.control.value)
    return eqx.tree_at(lambda v: (v.position, v.points), values, (position, points))


def _plainly_closed(block: Block, values: Values, structure: Structure, vague: float) -> bool:
    """Return True for three full control points (or stations without free mounts and strips) that are not collinear.

    They suffice if the rotation about their line of best fit is determined better than `vague` (rad). Without images
    only points can move; if all of them are control, the datum is determined.
    """
    seen = np.zeros((3, structure.n_points))
    seen[block.control.axis, block.control.who] = 1
    seen[structure.point_free == 0] = 1
    if not structure.n_images and seen.all():
        return True
    sets = [(np.asarray(values.points)[:, seen.all(0)], block.control.sigma)]
    if not (structure.free >= structure.n_cameras).any():
        stations = np.zeros((3, structure.n_images))
        stations[block.stations.axis, block.stations.who] = 1
        sets.append((np.asarray(values.position)[:, stations.all(0)], block.stations.sigma))
    for places, sigma in sets:
        if places.shape[1] >= 3:
            spread = np.linalg.svd(places - places.mean(1, keepdims=True), compute_uv=False)
            known = vague == np.inf or np.max(to_numpy(sigma), initial=0.0) < vague * spread[1]
            if spread[1] > 1e-6 * spread[0] and known:
                return True
    return False


def _check_vague(block: Block, sensitivity: "SeenMotions", named: list[str]) -> None:
    """Raise DatumError if the datum is determined only by noise, as for control on a line."""
    weak, sigma = sensitivity.weak_motions(_VAGUE)
    if len(weak):
        raise DatumError(datum_sentence(weak, block, named, sigma))


def _motions(values: Values) -> DatumRows:
    position, rotation, points = (np.asarray(v) for v in (values.position, values.rotation, values.points))
    centre = points.mean(axis=1)
    size = float(np.sqrt(((points - centre[:, None]) ** 2).sum(0).mean())) or 1.0
    return motions(position, rotation, points, centre, size)


def _datum_sensitivity(
    block: Block, values: Values, s: Structure, motions: DatumRows
) -> tuple["SeenMotions", list[str]]:
    """Return the sensitivity of rows to the motions, and names of free declared unknowns that may compensate them."""
    from jaxphoto.adjustment.datum_sensitivity import SeenMotions, row_sensitivity

    own = [j for j, k in enumerate(s.free) if k >= s.n_cameras]
    weighted = {int(j) for g in s.observed if g.name.startswith(PRIORS) for j in g.column.ravel()}
    placed = {g.name for g in s.observed if len(g.image) or len(g.point)}
    if placed <= {ControlCoordinates.group}:
        # With control only, no differentiation is needed: its rows are the motions of its points.
        control = block.control
        rows = motions.points[:, control.axis, control.who].T / _control_sigma(values, s)[:, None]
        sensitivity = SeenMotions.of_motions(rows)
    else:
        sensitivity = row_sensitivity(values, s, motions, np.array(own, int))
    fixed_p = np.argwhere(s.point_free.T == 0)
    fixed_e = np.argwhere(s.eop_free.T == 0)
    held = np.concatenate(
        [motions.points[:, fixed_p[:, 1], fixed_p[:, 0]].T, motions.eop[:, fixed_e[:, 1], fixed_e[:, 0]].T]
    )
    weight = 1 / _control_sigma(values, s).min(initial=0.01)
    return sensitivity.with_motions(held * weight), [s.labels[j] for j in own if j not in weighted]


def _control_sigma(values: Values, s: Structure) -> np.ndarray:
    """Return the standard deviations of the control (m)."""
    groups = zip(s.observed, values.groups, strict=True)
    return np.concatenate(
        [np.zeros(0), *(np.asarray(rows_of(g, n).sigmas) for g, n in groups if g.name == ControlCoordinates.group)]
    )


def _combine(motions: DatumRows, combinations: np.ndarray) -> DatumRows:
    return DatumRows(
        np.einsum("km,mci->kci", combinations, motions.eop), np.einsum("km,mcp->kcp", combinations, motions.points)
    )


def _inner(null: DatumRows, block: Block, over) -> DatumRows:
    """Return inner constraints: the undetermined motions, restricted to the positions or points of the datum."""
    if over == "images":
        eop = null.eop.copy()
        eop[:, 3:] = 0.0
        return DatumRows(eop, np.zeros_like(null.points))
    chosen = np.ones(len(block.points)) if over == "points" else np.isin(block.points, over).astype(float)
    return DatumRows(np.zeros_like(null.eop), null.points * chosen)


def _orthonormal(rows: DatumRows) -> DatumRows:
    k = len(rows.eop)
    flat = np.concatenate([rows.eop.reshape(k, -1), rows.points.reshape(k, -1)], axis=1)
    q = np.linalg.qr(flat.T)[0].T
    split = rows.eop[0].size if k else 0
    return DatumRows(q[:, :split].reshape(rows.eop.shape), q[:, split:].reshape(rows.points.shape))


def _minimal(null: DatumRows, structure: Structure) -> DatumRows:
    """Return the minimal constraints: fixed point coordinates, one per defect, chosen by pivoting for best
    conditioning.
    """
    k = len(null.points)
    flat = null.points.transpose(0, 2, 1).reshape(k, -1) * structure.point_free.T.reshape(-1)
    rows = np.zeros_like(flat)
    left = flat.copy()
    for row in rows:
        best = int(np.argmax((left**2).sum(0)))
        row[best] = 1.0
        direction = left[:, best] / max(np.sqrt((left[:, best] ** 2).sum()), 1e-300)
        left -= np.outer(direction, direction @ left)
    points = rows.reshape(k, structure.n_points, 3).transpose(0, 2, 1)
    return DatumRows(np.zeros_like(null.eop), points)
