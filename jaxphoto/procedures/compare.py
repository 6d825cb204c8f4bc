"""Compare calibrations: two adjustments, or random halves of a block.

`compare` tests for a camera change between two adjustments. `halves` tests if two calibrations agree within
their covariances. The block is repeatedly split in two; units (images, strips, flights) are not split. Both
halves are adjusted, and their bundles of rays compared over the format (`stability`). Differences in excess of the
covariances are due to model error (`stability.band`).

Observations in both halves, such as control, are identical: the covariance of the difference is the sum of both
covariances minus their common effect (`statistics.common_covariance`). Errors common to both halves, such as errors of
fixed points, cancel in every difference.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.adjustment import Adjustment, PaddedSizes, common_sizes
from jaxphoto.arrays import ArrayLike
from jaxphoto.block import Block
from jaxphoto.block_edits import one_camera
from jaxphoto.camera import InteriorOrientation, parameter_names
from jaxphoto.errors import BlockError, DatumError, InputError, RankError
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.weights import estimate_weights
from jaxphoto.short_repr import pretty_repr
from jaxphoto.stability import (
    Change,
    Differences,
    ErrorBand,
    Method,
    bundle_offsets,
    change,
    check_rays,
    concentration,
    error_band,
    image_grid,
    leading_unit,
    overlap,
)
from jaxphoto.statistics import VarianceComponents, common_covariance, covariance
from jaxphoto.tracing import outside_transformations
from jaxphoto.variants import some_images
from jaxphoto.workers import in_parts


@outside_transformations
def compare(
    first: Adjustment,
    second: Adjustment,
    camera: str | None = None,
    camera_b: str | None = None,
    *,
    points: Float[ArrayLike, "points 2"] | None = None,
    method: Method = "rot",
) -> Change:
    """Compare a camera in two adjustments of different photographs: by parameters, and by its bundle of rays.

    `camera` and `camera_b` name it in each adjustment if a block has several. `points` (mm from the centre) are the
    image points where rays are compared, by default 15 x 11 from edge to edge. `method` defines which orientation is
    estimated between the bundles (docs/stability.md). `jaxphoto.report.stability` has tables and messages for the
    result. Raises InputError for adjustments that did not converge, formats that differ, and bundles that cannot be
    compared.
    """
    for adjusted in (first, second):
        if not bool(adjusted.converged):
            raise InputError(f"{adjusted.block.title or 'a block'} did not converge: {adjusted.outcome.value}")
    names = [one_camera(a.block, camera_name) for a, camera_name in ((first, camera), (second, camera_b or camera))]
    sensors = [a.block.sensors[name] for a, name in zip((first, second), names, strict=True)]
    if sensors[0] != sensors[1]:
        raise InputError(f"{names[0]} is a {sensors[0]}, {names[1]} a {sensors[1]}; compare two sets of one camera")
    interiors = [a.unknowns.interior[name] for a, name in zip((first, second), names, strict=True)]
    covariances = [
        covariance(a).of_interior(name, parameter_names(interior))
        for a, name, interior in zip((first, second), names, interiors, strict=True)
    ]
    at = image_grid(sensors[0]) if points is None else np.asarray(points, float)
    return change(interiors[0], interiors[1], at, (covariances[0], covariances[1]), method)


CUTS = 64
_TRIES = 50
# Minimum number of image points to orient an image: three determine it without redundancy.
_LEAST_POINTS = 4


class Cut(NamedTuple):
    """Two halves of a block and their cameras; only `problem` if they cannot be compared."""

    first: Bool[np.ndarray, "images"]
    """True if an image is in the first half."""
    problem: str = ""
    cameras: tuple[InteriorOrientation, ...] = ()
    """Camera of each half."""
    covariance: Float[np.ndarray, "parameters parameters"] = np.zeros((0, 0))
    """Joint a posteriori covariance of both cameras."""
    sigma0: tuple[float, ...] = ()
    offsets_px: Float[np.ndarray, "cells 2"] = np.zeros((0, 2))
    """First minus second bundle in the measured image, aligned."""
    jacobian_px: Float[np.ndarray, "coordinates parameters"] = np.zeros((0, 0))


@pretty_repr
class Halves(NamedTuple):
    """Calibration by the whole block and by its halves, and the reliability of its standard deviations."""

    adjusted: Adjustment
    """Adjustment of the whole block, with estimated weights."""
    camera: str
    by: str
    method: Method
    cells_mm: Float[np.ndarray, "cells 2"]
    """Image points relative to the centre of the format."""
    covariance: Float[np.ndarray, "parameters parameters"]
    """A posteriori covariance of the camera, from the whole block."""
    promised_px: Float[np.ndarray, "cells"]
    """RMS length (both axes) of the error according to the covariance of the whole block."""
    cuts: tuple[Cut, ...]
    """Splits that were compared."""
    failed: tuple[Cut, ...]
    """Splits that could not be compared."""
    band: ErrorBand
    weights: VarianceComponents | None = None
    """Variance components of parts whose residuals contradict their stated standard deviations (`estimate_weights`)."""

    @property
    def widened(self) -> Float[np.ndarray, "parameters parameters"]:
        """Return the covariance with model error: multiplied by the square of the factor, if that exceeds 1."""
        return self.covariance * max(self.band.factor, 1.0) ** 2

    @property
    def leading(self) -> tuple[str, float]:
        """Return the unit that dominates the differences, and the fraction of their sum of squares it explains."""
        names, unit = _units(self.adjusted.block, self.by)
        of_units = [np.flatnonzero(unit == k)[0] for k in range(len(names))]
        first = np.stack([cut.first[of_units] for cut in self.cuts])
        k, share = leading_unit(first, np.stack([cut.offsets_px for cut in self.cuts]))
        return names[k], share

    @property
    def inside(self) -> tuple[float, float]:
        """Return the fraction of cells whose difference is within the band estimated without it, and its standard
        error.
        """
        v = self.band.inside
        return float(v.mean()), float(v.std(ddof=1) / np.sqrt(len(v))) if len(v) > 1 else float("nan")


@outside_transformations
def halves(
    block: Block,
    cells_mm: Float[np.ndarray, "cells 2"],
    *,
    by: str = "image",
    camera: str | None = None,
    n_cuts: int = CUTS,
    seed: int = 0,
    method: Method = "rot",
    report: Callable[[str], None] = lambda said: None,
    client: Any = None,
) -> Halves:
    """Adjust `block` and random halves of it, and compare `camera` at `cells_mm` (`image_grid`).

    Standard deviations that the residuals of the whole block contradict are estimated (`estimate_weights`).

    `by` is the unit that is never split: "image", "strip", or a partition of the block such as "day". `n_cuts` splits
    are drawn with `seed`, or all if fewer exist. `method` defines which systematic effects the orientation of the
    images absorbs (`stability.alignment`). `client`: a `dask.distributed.Client`, whose workers adjust the halves
    (docs/cluster.md).

    Raises InputError if the block cannot be split, no parameter of the camera is estimated or no two halves can be
    compared, and the errors of `adjust` for the whole block.
    """
    name = camera_of(block, camera)
    size, first = _cuts(block, by, name, n_cuts, seed)
    sizes = common_sizes([block])
    report("adjusting the whole block")
    adjusted = adjust(block, sizes=sizes)
    if not bool(adjusted.converged):
        raise InputError(f"the whole block did not converge: {adjusted.outcome.value}")
    weights = estimate_weights(adjusted, report=report)
    adjusted = weights.adjusted if weights else adjusted
    interior = adjusted.unknowns.interior[name]
    camera_covariance = covariance(adjusted).of_interior(name, parameter_names(interior))
    if not camera_covariance.any():
        raise InputError(f"no parameter of camera {name} is estimated; set some free")
    check_rays(interior, cells_mm, f"camera {name}")
    study, unit, found = _Splits(adjusted, name, cells_mm, method, sizes), _units(block, by)[1], dict[int, Cut]()
    report(f"adjusting halves: split 1 of {len(first)}")
    for k, cut in in_parts(study, enumerate(units[unit] for units in first), client):
        found[k] = cut
        report(f"adjusting halves: split {min(len(found) + 1, len(first))} of {len(first)}")
    done = [found[k] for k in range(len(first))]
    good = [k for k, cut in enumerate(done) if not cut.problem]
    if not good:
        raise InputError(f"no two halves of this block can be compared: {done[0].problem}")
    cuts = tuple(done[k] for k in good)
    px = block.sensors[name].pixel_mm
    p = len(camera_covariance)
    jacobian = np.asarray(bundle_offsets(interior, interior, cells_mm, method).measured_jacobian)[:, :p] / px
    whole = _by_cell(jacobian, camera_covariance)
    differences = Differences(
        offsets=np.stack([cut.offsets_px for cut in cuts]),
        covariances=np.stack([_by_cell(cut.jacobian_px, cut.covariance) for cut in cuts]),
        concentration=float(np.mean([concentration(cut.jacobian_px, cut.covariance) for cut in cuts])),
        overlap=overlap(first[good], size),
    )
    return Halves(
        adjusted=adjusted, camera=name, by=by, method=method, cells_mm=cells_mm, covariance=camera_covariance,
        promised_px=np.sqrt(np.trace(whole, axis1=1, axis2=2)), cuts=cuts,
        failed=tuple(cut for cut in done if cut.problem), band=error_band(differences, whole), weights=weights,
    )  # fmt: skip


def camera_of(block: Block, camera: str | None) -> str:
    """Return the camera to compare. Raises InputError if it does not exist or is ambiguous."""
    names = ", ".join(block.sensors)
    if camera is None and len(block.sensors) > 1:
        raise InputError(f"the block has {len(block.sensors)} cameras; choose one of {names}")
    if camera is not None and camera not in block.sensors:
        raise InputError(f"unknown camera {camera}; choose one of {names}")
    return camera if camera is not None else names


def _units(block: Block, by: str) -> tuple[list[str], np.ndarray]:
    """Return the names of the units, and the unit of each image."""
    owners = block.owners(by)
    if "" in owners:
        raise InputError(f"image {block.images[owners.index('')]} has no {by}; add it, or split by image")
    names = list(dict.fromkeys(owners))
    return names, np.array([names.index(owner) for owner in owners])


def _cuts(block: Block, by: str, camera: str, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of image points of each unit, and the units in the first half of each split (cuts, units).

    Both halves of every split contain the camera.
    """
    names, unit = _units(block, by)
    has_camera = np.array([c == camera for c in block.image_camera])
    shows = np.bincount(unit[has_camera], minlength=len(names)) > 0
    if shows.sum() < 2:
        raise InputError(f"all images of camera {camera} are in one {by}; choose another --by")
    rng, divisions = np.random.default_rng(seed), np.zeros((0, len(names)), bool)
    for _ in range(_TRIES):
        more = _balanced(len(names), rng)
        more = more[more[:, shows].any(axis=1) & ~more[:, shows].all(axis=1)]
        # Exchanging the halves gives the same split.
        both = np.concatenate([divisions, more])
        _, at = np.unique(both ^ ~both[:, :1], axis=0, return_index=True)
        divisions = both[np.sort(at)]
        if len(divisions) >= n:
            break
    return np.bincount(unit[block.image_points.image], minlength=len(names)), divisions[:n]


def _balanced(units: int, rng: np.random.Generator) -> Bool[np.ndarray, "cuts units"]:
    """Draw balanced splits: any two units are in the same half in half of the splits.

    Together they estimate the scatter of the halves, to first order, as well as all splits would. The rows are taken
    from a Hadamard matrix with random columns and signs, except rows with less than a third of the units in one half.
    Source: McCarthy (1969), balanced half-samples.
    """
    order = 1 << (units - 1).bit_length()
    rows = scipy.linalg.hadamard(order)[rng.permutation(order)]
    tried = [rows[:, rng.permutation(order)[:units]] * rng.choice([-1, 1], units) for _ in range(_TRIES)]
    return max((cuts[np.abs(cuts.sum(axis=1)) <= units / 3] for cuts in tried), key=len) > 0


class _Splits(NamedTuple):
    """Adjustments of halves of the block of `adjusted`; a study of `in_parts`."""

    adjusted: Adjustment
    camera: str
    cells_mm: np.ndarray
    method: Method
    sizes: PaddedSizes

    def compute(self, part: np.ndarray) -> Cut:
        """Compare the images `part` with the others."""
        return halved(self.adjusted, part, *self[1:])


def halved(
    adjusted: Adjustment, first: np.ndarray, camera: str, cells_mm: np.ndarray, method: Method, sizes: PaddedSizes
) -> Cut:
    """Adjust the images `first` and the others separately, and compare them at `cells_mm`."""
    block = adjusted.block
    start = dataclasses.replace(block.start, unknowns=adjusted.unknowns)
    # The datum of a half is irrelevant for its camera and may be undetermined by its stations and control.
    datum = dataclasses.replace(block.datum, kind="inner") if block.datum.kind == "control" else block.datum
    try:
        both = []
        for half in (first, ~first):
            part = _oriented(dataclasses.replace(block, start=start, datum=datum), half)
            both.append(adjust(part, part.start.unknowns, sizes=sizes))
            if not bool(both[-1].converged):
                return Cut(first, both[-1].outcome.value)
        cameras = tuple(half.unknowns.interior[camera] for half in both)
        for interior in cameras:
            check_rays(interior, cells_mm, f"camera {camera} of a half")
    except (BlockError, DatumError, RankError, InputError) as error:
        return Cut(first, str(error))
    offsets = bundle_offsets(cameras[0], cameras[1], cells_mm, method)
    if not bool(offsets.converged):
        return Cut(first, "the bundles of the two halves cannot be aligned")
    px = block.sensors[camera].pixel_mm
    return Cut(
        first=first,
        cameras=cameras,
        covariance=_joint_covariance(adjusted, both, camera, parameter_names(cameras[0])),
        sigma0=tuple(float(half.sigma0) for half in both),
        offsets_px=np.asarray(offsets.measured) / px,
        jacobian_px=np.asarray(offsets.measured_jacobian) / px,
    )


def _oriented(block: Block, chosen: Bool[np.ndarray, "images"]) -> Block:
    """Select the images `chosen`, except images with too few remaining points for orientation."""
    while True:
        part = some_images(block, chosen)
        few = np.bincount(part.image_points.image, minlength=len(part.images)) < _LEAST_POINTS
        if few.all():
            raise BlockError("the images of a half have too few common points to orient them: use more images")
        if not few.any():
            return part
        chosen = np.isin(np.arange(len(chosen)), np.flatnonzero(chosen)[~few])


def _joint_covariance(adjusted: Adjustment, both: list[Adjustment], camera: str, names: tuple[str, ...]) -> np.ndarray:
    """Return the covariance of the camera in both halves; common observations have the block's variance factor."""
    p = len(names)
    joint = np.zeros((2 * p, 2 * p))
    joint[:p, :p], joint[p:, p:] = (covariance(half).of_interior(camera, names) for half in both)
    joint[:p, p:] = float(adjusted.sigma0) ** 2 * common_covariance(both[0], both[1], camera, names)
    joint[p:, :p] = joint[:p, p:].T
    return joint


def _by_cell(jacobian: np.ndarray, covariance: np.ndarray) -> Float[np.ndarray, "cells 2 2"]:
    """Compute J Q J' of each cell."""
    rows = jacobian.reshape(-1, 2, jacobian.shape[1])
    return np.einsum("cip,pq,cjq->cij", rows, covariance, rows)
