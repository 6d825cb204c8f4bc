"""Search for common planes of two strips, in the cloud as corrected so far."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError, few
from jaxphoto.georeferencing import Pattern, StripErrors
from jaxphoto.lidar.correction import ScannerPath, corrected_strip, times_of
from jaxphoto.lidar.strip_planes import (
    PlanePairs,
    PointsOnPlanes,
    StripPatches,
    StripSettings,
    cells_of,
    corresponding,
    faces_about,
    fitting,
    on_planes,
    planes_of,
    returns_about,
    windows_of_returns,
)
from jaxphoto.observations import StripPlanes, StripPoints
from jaxphoto.procedures.lidar.strip_model import Look, looks_of, plane_rows, side_of, thinned

# Fewer planes of a pair of strips occur by chance.
_FEWEST = 10
# Larger distances between strips (m) are not due to a trajectory; usually heights in two systems, or in feet.
_APART_M = 10.0


class CommonPlanes(NamedTuple):
    """Planes of two strips, and which of them fit."""

    one: Look
    other: Look
    patches: tuple[StripPatches, StripPatches]
    pairs: PlanePairs
    fits: Bool[np.ndarray, "n"]


class StripSearch:
    """Successive searches: once `settled`, returns stay in their cells.

    Otherwise with each correction some return would leave its cell, and another enter: scatter within the unknowns'
    standard deviations, but without convergence.
    """

    def __init__(
        self, cloud: Cloud, path: ScannerPath | None, settings: StripSettings, pattern: Pattern = "line"
    ) -> None:
        self.cloud, self.path, self.settings = cloud, path, settings
        self.looks = looks_of(cloud, path, pattern)
        self.cells: list[np.ndarray] = []
        self.corrected: list[np.ndarray] = []
        """Returns of each look as corrected in the last search."""

    def look(self, errors: StripErrors, settled: bool) -> list[CommonPlanes]:
        """Return the planes of every pair of strips; for a strip with two looks, those of both."""
        patches, cells, corrected = [], [], []
        for k, strip_look in enumerate(self.looks):
            measured, time = self.cloud.xyz[strip_look.returns], times_of(self.cloud)[strip_look.returns]
            xyz = corrected_strip(measured, time, strip_look.strip, errors, self.path)
            corrected.append(xyz)
            cells.append(self.cells[k] if settled else cells_of(xyz, self.settings))
            patches.append(planes_of(xyz, measured, time, cells[-1], self.settings))
        self.cells, self.corrected = cells, corrected
        pairs = itertools.combinations(range(len(self.looks)), 2)
        return [found for one, other in pairs if (found := self._common(one, other, patches)) is not None]

    @property
    def corrected_cloud(self) -> Cloud:
        """Return the cloud as corrected in the last search; all its other fields are kept."""
        xyz = np.empty_like(self.cloud.xyz)
        for look, corrected in zip(self.looks, self.corrected, strict=True):
            xyz[look.returns] = corrected
        return dataclasses.replace(self.cloud, xyz=xyz)

    def _common(self, one: int, other: int, patches: list[StripPatches]) -> CommonPlanes | None:
        pairs = corresponding(patches[one], patches[other], self.settings)
        if len(pairs.gap) < _FEWEST:
            return None
        fits = fitting(pairs.gap, pairs.sigma, self.settings.outlier)
        return CommonPlanes(self.looks[one], self.looks[other], (patches[one], patches[other]), pairs, fits)

    def rows(self, planes: Sequence[CommonPlanes], errors: StripErrors) -> StripPlanes:
        """Return the fitting planes as observations, at most `most`, distributed over the pairs of strips."""
        total, parts = sum(int(f.fits.sum()) for f in planes), []
        for f in planes:
            chosen = np.flatnonzero(f.fits)
            share = max(_FEWEST, self.settings.most * len(chosen) // total)
            chosen = chosen[thinned(f.pairs.normal[chosen], f.pairs.cell[chosen], share)]
            pairs = PlanePairs(*(v[chosen] for v in f.pairs))
            a = side_of(f.patches[0], pairs.a, pairs.foot_a, f.one.strip, errors, self.path)
            b = side_of(f.patches[1], pairs.b, pairs.foot_b, f.other.strip, errors, self.path)
            parts.append(plane_rows(pairs, a, b))
        return StripPlanes.joined(*parts) if parts else StripPlanes.none()


def check_joined(names: Sequence[str], planes: Sequence[CommonPlanes]) -> None:
    """Raise BlockError for a strip without a common plane, or in another coordinate system."""
    apart = [common for common in planes if common.one.strip != common.other.strip]
    joined = {look.strip for common in apart for look in (common.one, common.other)}
    alone = [name for k, name in enumerate(names) if k not in joined]
    if alone and len(names) > 1:
        raise BlockError(
            f"strip {alone[0]} has fewer than {_FEWEST} planes in common with any other: leave it out, take larger "
            "cells (--cell-m) or rougher planes (--roughness-m), or check that all strips overlap and are in one system"
        )
    for common in apart:
        up = float(np.median(common.pairs.gap / common.pairs.normal[:, 2]))
        if abs(up) > _APART_M:
            raise BlockError(
                f"strip {common.one.name} lies {abs(up):.1f} m {'above' if up > 0 else 'below'} strip "
                f"{common.other.name}: heights of one may count in feet or belong to another vertical system, as those "
                "above an ellipsoid and a geoid; bring all strips and their trajectory into one"
            )


class PointPlanes(NamedTuple):
    """Points above planes of one strip, and which of them fit."""

    look: Look
    patches: StripPatches
    found: PointsOnPlanes
    """Its points are indices of `PointSearch.points`."""
    sigma: Float[np.ndarray, "n"]
    """Standard deviation of the gaps, from plane and point (m)."""
    fits: Bool[np.ndarray, "n"]


class PointSearch:
    """Successive searches: once `settled`, returns stay with their points, as in `StripSearch`.

    `points` are block indices: of the points `on_planes`, and twice of those `on_breaklines`, for both faces.
    """

    def __init__(
        self,
        search: StripSearch,
        on_planes: Int[np.ndarray, "plain"],
        on_breaklines: Int[np.ndarray, "lines"] | None = None,
    ) -> None:
        lines = np.zeros(0, int) if on_breaklines is None else on_breaklines
        self.search, self.points = search, np.concatenate([on_planes, np.repeat(lines, 2)])
        self._plain = len(on_planes)
        self.about: list[tuple[np.ndarray, ...]] = []

    def look(
        self, place: Float[np.ndarray, "points 3"], spread: Float[np.ndarray, "points 3 3"], settled: bool
    ) -> list[PointPlanes]:
        """Return the planes about points (m) with these covariances, in the strips as last corrected by the other
        search.
        """
        search, about, seen = self.search, [], []
        for k, (strip_look, xyz) in enumerate(zip(search.looks, search.corrected, strict=True)):
            about.append(self.about[k] if settled else self._about(xyz, place))
            index, point = about[-1]
            measured, time = search.cloud.xyz[strip_look.returns], times_of(search.cloud)[strip_look.returns]
            patches = planes_of(xyz[index], measured[index], time[index], point, search.settings)
            found = on_planes(patches, place)
            found = found._replace(sigma=found.sigma * np.sqrt(windows_of_returns(index, point)[found.point]))
            of_points = np.einsum("ni,nij,nj->n", patches.normal, spread[found.point], patches.normal)
            sigma = np.sqrt(found.sigma**2 + of_points)
            seen.append(
                PointPlanes(strip_look, patches, found, sigma, fitting(found.gap, sigma, search.settings.outlier))
            )
        self.about = about
        return seen

    def _about(self, xyz: Float[np.ndarray, "n 3"], place: Float[np.ndarray, "points 3"]) -> tuple[np.ndarray, ...]:
        """Return the returns about each point, or of its face, and the point of each."""
        index, point = returns_about(xyz, place[: self._plain], self.search.settings)
        of_faces, face = faces_about(xyz, place[self._plain :: 2], self.search.settings)
        return np.concatenate([index, of_faces]), np.concatenate([point, self._plain + face])

    def unseen(self, planes: Sequence[PointPlanes], names: Sequence[str]) -> list[str]:
        """Return a message if points on breaklines have no faces in any strip; `names` are those of the block."""
        lines = self.points[self._plain :: 2]
        number = np.concatenate([f.found.point[f.found.point >= self._plain] for f in planes])
        out = np.setdiff1d(np.arange(len(lines)), (number - self._plain) // 2)
        if not len(out):
            return []
        return [
            f"{len(out)} of {len(lines)} points on breaklines have no two smooth faces about them in any strip, hence "
            f"no observations: {few([names[p] for p in lines[out]])}; take cells (--cell-m) half as wide as "
            "the roofs, or leave these points out"
        ]

    def rows(self, planes: Sequence[PointPlanes], errors: StripErrors) -> tuple[StripPoints, ...]:
        """Return the fitting points as observations: one group, if there are any."""
        of_strips = []
        for f in (f for f in planes if f.fits.any()):
            found = PointsOnPlanes(*(v[f.fits] for v in f.found))
            side = side_of(f.patches, found.patch, found.foot, f.look.strip, errors, self.search.path)
            normal = f.patches.normal[found.patch]
            of_strips.append(
                StripPoints(
                    self.points[found.point], side.knots, side.weights, side.point, side.scanner, side.roll_pitch_yaw,
                    side.velocity, side.rate, normal, found.sigma, np.zeros(len(normal)),
                )
            )  # fmt: skip
        return (StripPoints.joined(*of_strips),) if of_strips else ()
