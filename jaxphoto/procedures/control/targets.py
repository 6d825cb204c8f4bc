"""Targets of surveyed points: predict them in photographs, search, verify, and adjust, iteratively.

    C = J_i C_i J_i' + J_X C_X J_X'

is the covariance of a predicted image point. J_i: derivatives by exterior and interior orientation, whose joint
covariance C_i comes from the adjustment. J_X: derivatives by the point; C_X: covariance of the survey and its offset.

A search returns candidates. Candidates of a point in several photographs belong to one target if their rays meet, near
enough to the point. Among positions with similar numbers of photographs, the one with the sharpest edges is the target.
If that is ambiguous none is accepted, and neither are candidates far less sharp than the targets of other points
(stones).

The first search covers the uncertainty of the given block. Later searches use the block adjusted with the accepted
targets, which resolves similar targets. Targets far from the position that the other points predict are re-searched.
"""

from collections.abc import Callable, Collection
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.camera import parameter_names
from jaxphoto.collinearity import ExteriorOrientation, in_field, project
from jaxphoto.compiling import jit_quickly
from jaxphoto.errors import InputError, counted
from jaxphoto.georeferencing import apparent_point
from jaxphoto.georeferencing.ground import moved_exterior, moved_interior
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.initial.rays import padded_length, turn_to_object
from jaxphoto.procedures.adjust import adjust_for_tables
from jaxphoto.procedures.control.control_block import CRITICAL, ControlledBlock, control_block
from jaxphoto.procedures.control.frame import MIN_POINTS, in_frame
from jaxphoto.procedures.control.marks import Marked, marked, misses, rays_of
from jaxphoto.procedures.control.surveyed import SIGMA_M, GivenControl, Marks
from jaxphoto.statistics import covariance
from jaxphoto.statistics.covariance import rotation_jacobians


class Predicted(NamedTuple):
    """Surveyed points in images; px from the upper-left corner, whose pixel has its centre at (0.5, 0.5)."""

    image: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    covariance: Float[np.ndarray, "n 2 2"]
    """Covariance of the image coordinates (px^2)."""
    px_per_m: Float[np.ndarray, "n 2 3"]
    """Derivatives of the image coordinates by X, Y, Z of the point."""

    def take(self, chosen: np.ndarray) -> "Predicted":
        """Select rows by mask or index."""
        return Predicted(*(v[chosen] for v in self))


def predicted(
    adjusted: Adjustment, xyz: Float[np.ndarray, "points 3"], of_points: Float[np.ndarray, "points 3 3"]
) -> Predicted:
    """Predict `xyz` (m, in the frame of the block, with covariance `of_points`) in all photographs containing them."""
    block, unknowns = adjusted.block, adjusted.unknowns
    joint = covariance(adjusted)
    n, factor = len(block.images), float(joint.variance_factor)
    matrix, labels = np.asarray(joint.matrix) * factor, list(joint.labels)
    position, turn = to_numpy(unknowns.exterior.position), to_numpy(unknowns.exterior.camera_from_object)
    to_angles = np.asarray(rotation_jacobians(jnp.asarray(np.moveaxis(turn, 0, -1)), joint.rotations))
    rows: list[tuple] = []
    image = np.arange(n).repeat(len(xyz))
    point = np.tile(np.arange(len(xyz)), n)
    camera = np.array(block.image_camera, object)[image]
    for name, interior in unknowns.interior.items():
        of_camera = np.flatnonzero(camera == name)
        if not len(of_camera):
            continue
        i, p = image[of_camera], point[of_camera]
        pad = np.resize(np.arange(len(of_camera)), padded_length(len(of_camera)))
        numbers = jax.tree.map(partial(np.asarray, dtype=float), interior)
        exterior = ExteriorOrientation(position[i[pad]], turn[i[pad]])  # type: ignore[arg-type]
        projections = _projected(numbers, exterior, xyz[p[pad]], block.corrections)
        xy, seen, by_point, by_exterior, by_interior = (np.asarray(v)[: len(of_camera)] for v in projections)
        free = [k for k, q in enumerate(parameter_names(interior)) if f"interior[{name}].{q}" in labels]
        place = [labels.index(f"interior[{name}].{parameter_names(interior)[k]}") for k in free]
        sensor = block.sensors[name]
        half, pixel = np.array([sensor.width_mm, sensor.height_mm]) / 2, np.array([1, -1]) / sensor.pixel_mm
        column_row = sensor.px_from_mm(xy)
        for k in np.flatnonzero(seen & (np.abs(xy) < half).all(axis=1)):
            where = [*range(6 * i[k], 6 * i[k] + 6), *place]
            by_angles = by_exterior[k, :, 3:] @ np.linalg.inv(to_angles[i[k]])
            by = np.column_stack([by_exterior[k, :, :3], by_angles, by_interior[k][:, free]])
            c = by @ matrix[np.ix_(where, where)] @ by.T + by_point[k] @ of_points[p[k]] @ by_point[k].T
            rows.append((i[k], p[k], column_row[k], c * np.outer(pixel, pixel), by_point[k] * pixel[:, None]))
    columns = zip(*rows, strict=True) if rows else [[]] * 5
    shapes = (), (), (2,), (2, 2), (2, 3)
    return Predicted(*(np.array(v, float if s else int).reshape(-1, *s) for v, s in zip(columns, shapes, strict=True)))


@partial(jit_quickly, static_argnum=3)
def _projected(interior, exterior, points, corrections):
    def one(exterior, point):
        def place(d_point, d_exterior, d_interior):
            image = moved_exterior(exterior, d_exterior)
            aim = apparent_point(image.position, point + d_point, corrections)
            value = project(moved_interior(interior, d_interior), image, aim)
            return value, value

        zeros = jnp.zeros(3), jnp.zeros(6), jnp.zeros(len(parameter_names(interior)))
        by, value = jax.jacfwd(place, argnums=(0, 1, 2), has_aux=True)(*zeros)
        return value, in_field(interior, exterior, point), *by

    return jax.vmap(one)(exterior, points)


# Search radius: number of standard deviations, and minimum in pixels.
_WITHIN, _MIN_PX = 3.5, 5.0
# Standard deviation (m, plan) of the common offset of a block without control: receivers without corrections.
COMMON_M = 3.0
# Number of tie points for the estimate of the ground height at a point.
_NEAR_TIES = 8
# Maximum distance (px) of a candidate from the intersection of the rays of its point.
_MISS_PX = 2.0
_MIN_IMAGES, _MIN_UNNAMED = 2, 3
# Minimum ratio of photographs (another position / target) at which the target is ambiguous.
_ALIKE = 0.6
_PARALLEL = np.deg2rad(0.5)
# Ratio of fits above which a target is sharper than another candidate; ratio above which it is duller than other
# targets.
_SHARPER, _DULL = 1.5, 3.0
_MAX_PAIRS = 2000


class Candidates(NamedTuple):
    """Candidates for targets, by row of the predictions."""

    row: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    sigma_px: Float[np.ndarray, "n"]
    fit_px: Float[np.ndarray, "n"]
    """Standard deviation of the fit to the grey values alone: small for sharp edges."""


class TargetSearch(NamedTuple):
    """Function that searches for targets in photographs."""

    look: Callable[[Predicted, Float[np.ndarray, "n"], tuple[str, ...], tuple[str, ...]], Candidates]
    """Function that returns candidates within the radius (px) of each prediction; arguments include the names of all
    images and points.
    """
    named: bool
    """True if a target identifies its point."""


class FoundTargets(NamedTuple):
    """Marks of accepted targets, and the result of every point by name."""

    marks: Marks
    looked: dict[str, tuple[str, ...]]
    """Photographs that were searched."""
    why_not: dict[str, str]
    """Reasons for points without a target."""


def found_marks(
    adjusted: Adjustment,
    ids: tuple[str, ...],
    xyz: Float[np.ndarray, "points 3"],
    sigma: Float[np.ndarray, "points 3"],
    known: Collection[tuple[int, int]],
    target_search: TargetSearch,
    placed: bool,
) -> FoundTargets:
    """Find targets of the points `ids` at `xyz` (m, +- `sigma`) in the images of `adjusted`, except (image, point)
    `known`.

    `placed`: control determines the frame of the block. Otherwise its plan is determined by receivers, and the ground
    determines the heights of the points.
    """
    of_points = np.einsum("ni,ij->nij", sigma**2, np.eye(3))
    if not placed:
        xyz, scatter = _on_own_ground(adjusted, xyz)
        of_points = of_points + np.diag([COMMON_M**2, COMMON_M**2, scatter**2])
    at = predicted(adjusted, xyz, of_points)
    pairs = zip(at.image.tolist(), at.point.tolist(), strict=True)
    at = at.take(np.array([pair not in known for pair in pairs], bool))
    spread = np.sqrt(np.linalg.eigvalsh(at.covariance)[:, 1]) if len(at.image) else np.zeros(0)
    radius = np.maximum(_WITHIN * spread, _MIN_PX)
    candidates = target_search.look(at, radius, adjusted.block.images, ids)
    return _believed(adjusted, ids, xyz, of_points, at, candidates, target_search.named, radius)


def _on_own_ground(adjusted: Adjustment, xyz) -> tuple[Float[np.ndarray, "points 3"], float]:
    """Shift the heights of `xyz` to the ground of the block, and estimate the scatter of single heights."""
    ties = np.asarray(adjusted.unknowns.points, float)
    above = []
    for point in xyz:
        near = np.argsort(np.linalg.norm(ties[:, :2] - point[:2], axis=1))[:_NEAR_TIES]
        above.append(point[2] - np.median(ties[near, 2]))
    shift = float(np.median(above))
    scatter = 1.4826 * float(np.median(np.abs(np.array(above) - shift)))
    return xyz - [0.0, 0.0, shift], max(scatter, 1.0)


def _believed(adjusted, ids, xyz, of_points, at: Predicted, seen: Candidates, named: bool, radius) -> FoundTargets:
    block, unknowns = adjusted.block, adjusted.unknowns
    image, point = at.image[seen.row], at.point[seen.row]
    sensors = [block.sensors[block.image_camera[i]] for i in image]
    xy = [s.mm_from_px(place[None])[0] for s, place in zip(sensors, seen.column_row, strict=True)]
    pixel = np.array([s.pixel_mm for s in sensors])
    rows = Marked(image, point, np.array(xy).reshape(-1, 2), seen.sigma_px * pixel)
    positions, matrices = (
        np.asarray(v, float) for v in (unknowns.exterior.position, unknowns.exterior.camera_from_object)
    )
    directions = turn_to_object(matrices, image, rays_of(block, unknowns, rows)) if len(image) else np.zeros((0, 3))
    c = np.array([float(unknowns.interior[block.image_camera[i]].c) for i in image])
    limit = _MISS_PX * pixel / np.maximum(c, 1e-300)
    taken: dict[int, list[int]] = {}
    looked: dict[str, tuple[str, ...]] = {}
    why_not: dict[str, str] = {}
    for p in np.unique(at.point).tolist():
        group = np.flatnonzero(point == p)
        looked[ids[p]] = tuple(block.images[i] for i in at.image[at.point == p])
        near = xyz[p], of_points[p]
        chosen, why = _meeting(
            positions[image[group]],
            directions[group],
            image[group],
            limit[group],
            seen.fit_px[group],
            *near,
        )
        sure = named or radius[at.point == p].max() < 3 * _MIN_PX
        least = _MIN_IMAGES if sure else _MIN_UNNAMED
        if not why and len(chosen) < least:
            why = f"it was seen in {len(chosen)}, and {least} are needed" if len(group) else "it was not seen"
        if why:
            where = counted(len(looked[ids[p]]), "photograph")
            why_not[ids[p]] = f"the target of {ids[p]} was looked for in {where}: {why}"
            continue
        taken[p] = group[chosen].tolist()
    usual = _fit_of_others(taken, seen.fit_px)
    for p, rows_of in list(taken.items()):
        if not named and np.median(seen.fit_px[rows_of]) > _DULL * usual[p]:
            del taken[p]
            why_not[ids[p]] = (
                f"the target of {ids[p]} was searched for: detections in {len(rows_of)} photographs are far less "
                "sharp than the other targets; mark it by hand"
            )
    kept = [k for rows_of in taken.values() for k in rows_of]
    marks = Marks(
        tuple(block.images[i] for i in image[kept]),
        tuple(ids[p] for p in point[kept]),
        seen.column_row[kept],
        seen.sigma_px[kept],
        tuple(f"found in {block.images[i]}" for i in image[kept]),
    )
    return FoundTargets(marks, looked, why_not)


def _fit_of_others(taken: dict[int, list[int]], fit_px: Float[np.ndarray, "n"]) -> dict[int, float]:
    """Return the median fit of the targets of the other points; infinite for too few."""
    fits_of = {p: float(np.median(fit_px[rows])) for p, rows in taken.items()}
    others = {p: [fit for q, fit in fits_of.items() if q != p] for p in fits_of}
    return {p: float(np.median(fits)) if len(fits) >= _MIN_IMAGES else np.inf for p, fits in others.items()}


def _meeting(origins, directions, image, limit, fit, near, of_point) -> tuple[np.ndarray, str]:
    """Return the candidates, one per image, whose rays meet near a point; or the reason for failure."""
    one, other = np.triu_indices(len(image), 1)
    apart = image[one] != image[other]
    one, other = one[apart], other[apart]
    if len(one) > _MAX_PAIRS:
        pick = np.linspace(0, len(one) - 1, _MAX_PAIRS).astype(int)
        one, other = one[pick], other[pick]
    none = np.zeros(0, int)
    if not len(one):
        return (np.arange(len(image)) if len(image) == 1 else none), ""
    ray = np.stack([one, other], axis=1).ravel()
    met, sure = intersect_points(
        origins[ray], directions[ray], np.arange(len(one)).repeat(2), len(one), min_angle=_PARALLEL
    )
    off = met - near
    # Two rays may differ by more than the survey: include their accuracy in the limit.
    room = np.linalg.norm(near - origins[one], axis=1) * limit[one] * 5
    distance = np.sqrt(np.einsum("ni,ij,nj->n", off, np.linalg.inv(of_point + 1e-12 * np.eye(3)), off))
    sure &= (distance < _WITHIN * 1.5) | (np.linalg.norm(off, axis=1) < room)
    if not sure.any():
        return none, "no detection is at the expected position"
    inside = misses(met[sure], origins, directions) < limit
    images = np.unique(image)
    score = np.stack([(inside & (image == i)).any(axis=1) for i in images]).sum(axis=0)
    likely = np.flatnonzero(score >= min(score.max(), max(_MIN_UNNAMED, _ALIKE * score.max())))
    sharp = np.array([np.median(fit[inside[k]]) for k in likely])
    # Among positions nearly as sharp as the sharpest, take the one in most photographs.
    miss = misses(met[sure], origins, directions).min(axis=1)
    alike = likely[sharp <= _SHARPER * sharp.min()]
    best = int(alike[np.argmax(score[alike] - 1e-3 * miss[alike])])
    chosen = inside[best]
    if not (inside[alike] & chosen).any(axis=1).all():
        return none, f"two or more candidates, one in {score[best]} photographs: mark it by hand"
    miss = misses(met[sure][best][None], origins, directions)[0]
    kept = [
        int(np.flatnonzero(chosen & (image == i))[np.argmin(miss[chosen & (image == i)])])
        for i in images
        if (chosen & (image == i)).any()
    ]
    return np.array(kept, int), ""


_ROUNDS = 3
# Ratio of a distance to the median of the other points above which a target may be another object.
_FAR = 10.0


def control_block_with_targets(
    block: Block,
    control: GivenControl,
    target_search: TargetSearch,
    *,
    system: str | None = None,
    code: int | None = None,
    vertical: int | None = None,
    elsewhere: Collection[str] = (),
    adjust: Callable[[Block], Adjustment] = adjust_for_tables,
    report: Callable[[str], object] = lambda text: None,
) -> ControlledBlock:
    """Adjust with the marks of `control` and with targets that `target_search` finds; see `control_block`.

    Raises the same InputErrors, and InputError for a block in an arbitrary frame without marks of three control points.
    """
    points, ids = control.points, control.points.ids
    sigma = np.where(np.isnan(points.sigma_m), SIGMA_M, points.sigma_m)
    by_hand, _ = marked(block, points, control.marks, elsewhere)
    now: ControlledBlock | None = None
    how: dict[str, Any] = {"system": system, "code": code, "vertical": vertical, "elsewhere": elsewhere}
    how |= {"adjust": adjust, "report": report}
    if len(by_hand.image):
        now = control_block(block, control, **how)
    elif block.frame.kind != "epsg":
        raise InputError(
            f"{points.file}: the block is not georeferenced, so the image positions of the points are unknown; mark "
            "three control points by hand, each in two photographs or more"
        )
    adjusted = now.adjusted if now else adjust(block)
    looked: dict[str, set[str]] = {name: set() for name in ids}
    seen: dict[str, set[str]] = {name: set() for name in ids}
    why_not: dict[str, str] = {}
    replaced: dict[int, float] = {}
    every = control.marks
    for _ in range(_ROUNDS):
        report("looking for targets")
        frame = in_frame(adjusted.block, points, system, code, vertical)
        # The frame is determined by marks, by targets of an earlier iteration, or by control of the block.
        placed = len(adjusted.block.control) > 0
        # Replace the target of each point at most once.
        far = {p: off for p, off in _far(now, by_hand).items() if p not in replaced} if now else {}
        rows = (by_hand, now.marks.take(~np.isin(now.marks.point, list(far)))) if now else (by_hand,)
        known = {pair for of in rows for pair in zip(of.image.tolist(), of.point.tolist(), strict=True)}
        found = found_marks(adjusted, ids, frame.xyz, sigma, known, target_search, placed)
        for name, images in found.looked.items():
            looked[name] |= set(images)
        distant_points = {p: off for p, off in far.items() if ids[p] in found.marks.point}
        replaced |= distant_points
        seen |= {ids[p]: set() for p in distant_points}
        for name, image in zip(found.marks.point, found.marks.image, strict=True):
            seen[name].add(image)
        why_not |= found.why_not
        if not len(found.marks.image):
            break
        # Replace re-detected marks, and all marks of distant targets.
        again = set(zip(found.marks.image, found.marks.point, strict=True))
        names = {ids[p] for p in distant_points}
        kept = [(i, p) not in again and p not in names for i, p in zip(every.image, every.point, strict=True)]
        every = Marks.joined(every.take(np.array(kept, bool)), found.marks)
        now = control_block(block, control._replace(marks=every), **how)
        adjusted = now.adjusted
    texts = _told(ids, seen, looked, why_not)
    if now is None:
        raise InputError(f"{points.file}: no target was found; {'; '.join(texts)}")
    distant = _far(now, by_hand)
    texts += [
        f"the target of {ids[p]} was found again, {off:.2g} m from its first detection"
        for p, off in replaced.items()
        if p not in distant
    ]
    texts += [
        f"the detection of check point {ids[p]} is {off:.2g} m from its position: check that it is its target, or mark "
        "it by hand"
        for p, off in distant.items()
        if points.check[p]
    ]
    return now._replace(sentences=(*texts, *now.sentences))


def _far(now: ControlledBlock, by_hand: Marked) -> dict[int, float]:
    """Return the distance (m) of found targets far from their points, except marks and targets used in the adjustment.

    They are retained unless another target is found: the block may be deformed there, as check points would show.
    """
    state, off = np.array(now.state, object), np.linalg.norm(np.nan_to_num(now.off_m), axis=1)
    if (state == "control").sum() < MIN_POINTS:
        return {}
    usual = np.median(off[np.isin(state, ["control", "check"])])
    far = np.isin(state, ["check", "left out"]) & (np.nan_to_num(now.w).max(axis=1) > CRITICAL) & (off > _FAR * usual)
    return {p: float(off[p]) for p in np.flatnonzero(far).tolist() if p not in by_hand.point}


def _told(
    ids: tuple[str, ...], seen: dict[str, set[str]], looked: dict[str, set[str]], why_not: dict[str, str]
) -> list[str]:
    """Return one message about the targets of all iterations, and one for each point without any."""
    counts = [f"{name} in {len(seen[name])} of {len(looked[name])}" for name in ids if seen[name]]
    count = f"{counted(len(counts), 'target')} found in the photographs that should show them"
    return [f"{count}: {', '.join(counts)}"] * bool(counts) + [why_not[p] for p in ids if p in why_not and not seen[p]]
