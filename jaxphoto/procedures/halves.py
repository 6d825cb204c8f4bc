"""Cross-validation of a calibration in halves: are two calibrations as close as their covariances promise?

The block is cut in two many times over; what belongs together (an image, a strip, a flight) stays together. Both
halves are adjusted, and their bundles of rays compared over the format (`stability`). What the halves differ by more
than their covariances promise is what model error adds (`stability.band`).

Observations that both halves use, such as control, are one and the same in both: the covariance of the difference is
less than the sum of both by what these do to both alike (`statistics.common_covariance`). Errors that both halves share
altogether, such as those of points held fixed, show in no difference.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.adjustment import Adjustment, PaddedSizes, common_sizes
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, parameter_names
from jaxphoto.errors import BlockError, DatumError, InputError, RankError
from jaxphoto.procedures.adjust import adjust
from jaxphoto.short_repr import pretty_repr
from jaxphoto.stability import (
    Differences,
    ErrorBand,
    Method,
    bundle_offsets,
    check_rays,
    concentration,
    error_band,
    leading_unit,
    overlap,
)
from jaxphoto.statistics import common_covariance, covariance
from jaxphoto.tracing import outside_transformations
from jaxphoto.variants import some_images

CUTS = 64
_TRIES = 50
# Three points and six unknowns of an image say nothing of its camera.
_LEAST_POINTS = 4


class Cut(NamedTuple):
    """A block in two halves, and what they say of the camera; no more than `problem` where they cannot be compared."""

    first: Bool[np.ndarray, "images"]
    """Whether an image is in the first half."""
    problem: str = ""
    cameras: tuple[InteriorOrientation, ...] = ()
    """Of both halves,"""
    covariance: Float[np.ndarray, "parameters parameters"] = np.zeros((0, 0))
    """and their a posteriori covariance, of both together."""
    sigma0: tuple[float, ...] = ()
    offsets_px: Float[np.ndarray, "cells 2"] = np.zeros((0, 2))
    """First minus second bundle in the measured image, aligned."""
    jacobian_px: Float[np.ndarray, "coordinates parameters"] = np.zeros((0, 0))


@pretty_repr
class Halves(NamedTuple):
    """A calibration by a whole block, its halves, and how far its standard deviations can be believed."""

    adjusted: Adjustment
    """The whole block."""
    camera: str
    by: str
    method: Method
    cells_mm: Float[np.ndarray, "cells 2"]
    """Of the format, from its centre."""
    covariance: Float[np.ndarray, "parameters parameters"]
    """A posteriori, of the camera by the whole block, as it is."""
    promised_px: Float[np.ndarray, "cells"]
    """Root mean square length of the error that the covariance of the whole block promises, both axes together."""
    cuts: tuple[Cut, ...]
    """Those that could be compared,"""
    failed: tuple[Cut, ...]
    """and the others."""
    band: ErrorBand

    @property
    def widened(self) -> Float[np.ndarray, "parameters parameters"]:
        """The covariance with the model error that halves show: times the square of the factor, where that is above
        1."""
        return self.covariance * max(self.band.factor, 1.0) ** 2

    @property
    def leading(self) -> tuple[str, float]:
        """The unit whose half differs from the other, whatever else is in it, and the part of all differences' squares
        that this is."""
        names, unit = _units(self.adjusted.block, self.by)
        of_units = [np.flatnonzero(unit == k)[0] for k in range(len(names))]
        first = np.stack([cut.first[of_units] for cut in self.cuts])
        k, share = leading_unit(first, np.stack([cut.offsets_px for cut in self.cuts]))
        return names[k], share

    @property
    def inside(self) -> tuple[float, float]:
        """The part of cells whose difference lies within the band made without it; and its standard error."""
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
) -> Halves:
    """Adjust `block` and random halves of it, and compare what they say of `camera` at `cells_mm` (`image_grid`).

    `by` says what is never cut: "image", "strip", or a partition of the block such as "day". `n_cuts` cuts are drawn by
    `seed`, fewer where there are not as many. `method` is what the orientation of the images may take up
    (`stability.alignment`).

    Raises InputError where there is nothing to cut, nothing of the camera is estimated or no two halves can be
    compared, and what `adjust` raises for the whole block.
    """
    name = camera_of(block, camera)
    size, first = _cuts(block, by, name, n_cuts, seed)
    sizes = common_sizes([block])
    report("adjusting the whole block")
    adjusted = adjust(block, sizes=sizes)
    if not bool(adjusted.converged):
        raise InputError(f"the whole block did not converge, so its halves say nothing: {adjusted.outcome.value}")
    interior = adjusted.unknowns.interior[name]
    own = covariance(adjusted).of_interior(name, parameter_names(interior))
    if not own.any():
        raise InputError(f"nothing of camera {name} is estimated in this block; set some of its unknowns free")
    check_rays(interior, cells_mm, f"camera {name}")
    done = []
    for k, units in enumerate(first):
        report(f"adjusting halves: cut {k + 1} of {len(first)}")
        done.append(halved(adjusted, units[_units(block, by)[1]], name, cells_mm, method, sizes))
    good = [k for k, cut in enumerate(done) if not cut.problem]
    if not good:
        raise InputError(f"no two halves of this block can be compared: {done[0].problem}")
    cuts = tuple(done[k] for k in good)
    px = block.sensors[name].pixel_mm
    p = len(own)
    jacobian = np.asarray(bundle_offsets(interior, interior, cells_mm, method).measured_jacobian)[:, :p] / px
    whole = _by_cell(jacobian, own)
    found = Differences(
        offsets=np.stack([cut.offsets_px for cut in cuts]),
        covariances=np.stack([_by_cell(cut.jacobian_px, cut.covariance) for cut in cuts]),
        concentration=float(np.mean([concentration(cut.jacobian_px, cut.covariance) for cut in cuts])),
        overlap=overlap(first[good], size),
    )
    return Halves(
        adjusted=adjusted,
        camera=name,
        by=by,
        method=method,
        cells_mm=cells_mm,
        covariance=own,
        promised_px=np.sqrt(np.trace(whole, axis1=1, axis2=2)),
        cuts=cuts,
        failed=tuple(cut for cut in done if cut.problem),
        band=error_band(found, whole),
    )


def camera_of(block: Block, camera: str | None) -> str:
    """The camera of `block` that is meant. Raises InputError where there is none, or it is not told which."""
    names = ", ".join(block.sensors)
    if camera is None and len(block.sensors) > 1:
        raise InputError(f"this block has {len(block.sensors)} cameras; name one of {names}")
    if camera is not None and camera not in block.sensors:
        raise InputError(f"there is no camera {camera} in this block; name one of {names}")
    return camera if camera is not None else names


def _units(block: Block, by: str) -> tuple[list[str], np.ndarray]:
    """The units that stay together, and that of each image."""
    owners = block.owners(by)
    if "" in owners:
        raise InputError(f"image {block.images[owners.index('')]} is in no {by}; give it one, or cut by image")
    names = list(dict.fromkeys(owners))
    return names, np.array([names.index(owner) for owner in owners])


def _cuts(block: Block, by: str, camera: str, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """How many image points each unit has, and of each cut which units are in its first half (cuts, units).

    Either half of each cut shows the camera.
    """
    names, unit = _units(block, by)
    own = np.array([c == camera for c in block.image_camera])
    shows = np.bincount(unit[own], minlength=len(names)) > 0
    if shows.sum() < 2:
        raise InputError(f"all images of camera {camera} are in one {by}: there is nothing to cut; take another --by")
    rng, found = np.random.default_rng(seed), np.zeros((0, len(names)), bool)
    for _ in range(_TRIES):
        more = _balanced(len(names), rng)
        more = more[more[:, shows].any(axis=1) & ~more[:, shows].all(axis=1)]
        # Which half is called the first makes no other cut.
        both = np.concatenate([found, more])
        _, at = np.unique(both ^ ~both[:, :1], axis=0, return_index=True)
        found = both[np.sort(at)]
        if len(found) >= n:
            break
    return np.bincount(unit[block.image_points.image], minlength=len(names)), found[:n]


def _balanced(units: int, rng: np.random.Generator) -> Bool[np.ndarray, "cuts units"]:
    """Cuts at random that are balanced: in half of them any two units are in one half, in the others apart.

    All together they tell the scatter of halves as all cuts there are would, to first order. Rows of a Hadamard matrix
    whose columns are chosen and turned over at random, but for those whose one half has less than a third.
    Source: McCarthy (1969), balanced half-samples.
    """
    order = 1 << (units - 1).bit_length()
    rows = scipy.linalg.hadamard(order)[rng.permutation(order)]
    tried = [rows[:, rng.permutation(order)[:units]] * rng.choice([-1, 1], units) for _ in range(_TRIES)]
    return max((cuts[np.abs(cuts.sum(axis=1)) <= units / 3] for cuts in tried), key=len) > 0


def halved(
    adjusted: Adjustment, first: np.ndarray, camera: str, cells_mm: np.ndarray, method: Method, sizes: PaddedSizes
) -> Cut:
    """The images `first` of an adjusted block and the others, adjusted for themselves and compared at `cells_mm`."""
    block = adjusted.block
    start = dataclasses.replace(block.start, unknowns=adjusted.unknowns)
    # Where a half lies in space is nothing of its camera: what stations or control of the whole told may be as good as
    # open, or open, in a half.
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
    found = bundle_offsets(cameras[0], cameras[1], cells_mm, method)
    if not bool(found.converged):
        return Cut(first, "the bundles of the two halves cannot be aligned")
    px = block.sensors[camera].pixel_mm
    return Cut(
        first=first,
        cameras=cameras,
        covariance=_joint_covariance(adjusted, both, camera, parameter_names(cameras[0])),
        sigma0=tuple(float(half.sigma0) for half in both),
        offsets_px=np.asarray(found.measured) / px,
        jacobian_px=np.asarray(found.measured_jacobian) / px,
    )


def _oriented(block: Block, chosen: Bool[np.ndarray, "images"]) -> Block:
    """The images `chosen`, without those of which the cut leaves too few points to orient them."""
    while True:
        part = some_images(block, chosen)
        few = np.bincount(part.image_points.image, minlength=len(part.images)) < _LEAST_POINTS
        if few.all():
            raise BlockError("the images of a half have no points in common that could orient them: cut more images")
        if not few.any():
            return part
        chosen = np.isin(np.arange(len(chosen)), np.flatnonzero(chosen)[~few])


def _joint_covariance(adjusted: Adjustment, both: list[Adjustment], camera: str, names: tuple[str, ...]) -> np.ndarray:
    """A posteriori covariance of the camera in both halves; what these share has the variance factor of the whole."""
    p = len(names)
    joint = np.zeros((2 * p, 2 * p))
    joint[:p, :p], joint[p:, p:] = (covariance(half).of_interior(camera, names) for half in both)
    joint[:p, p:] = float(adjusted.sigma0) ** 2 * common_covariance(both[0], both[1], camera, names)
    joint[p:, :p] = joint[:p, p:].T
    return joint


def _by_cell(jacobian: np.ndarray, covariance: np.ndarray) -> Float[np.ndarray, "cells 2 2"]:
    """J Q J' of each cell by itself."""
    rows = jacobian.reshape(-1, 2, jacobian.shape[1])
    return np.einsum("cip,pq,cjq->cij", rows, covariance, rows)
