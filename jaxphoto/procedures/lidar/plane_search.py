"""Search for common planes of two strips in the corrected cloud."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import Pattern, StripErrors
from jaxphoto.lidar.correction import ScannerPath, corrected_strip, times_of
from jaxphoto.lidar.strip_planes import (
    PlanePairs,
    PointsOnPlanes,
    StripPatches,
    StripSettings,
    cells_of,
    corresponding,
    fitting,
    on_planes,
    planes_of,
    returns_about,
)
from jaxphoto.observations import StripPlanes, StripPoints
from jaxphoto.procedures.lidar.strip_model import Look, looks_of, plane_rows, side_of, thinned

# Minimum number of common planes of two strips; fewer may match by chance.
_FEWEST = 10
# Maximum distance (m) of two strips due to trajectory errors; larger ones indicate heights in two systems, or in feet.
_APART_M = 10.0


class CommonPlanes(NamedTuple):
    """Planes of two strips, and a mask of accepted ones."""

    one: Look
    other: Look
    patches: tuple[StripPatches, StripPatches]
    pairs: PlanePairs
    fits: Bool[np.ndarray, "n"]


class StripSearch:
    """Repeated search for common planes. Once `settled`, returns stay in their cells.

    Otherwise each correction would move some returns between cells: the results would vary within the standard
    deviations of the unknowns, and not converge.
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
        """Return the planes of every pair of looks, including two looks of one strip."""
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
        """Return the cloud as corrected in the last search, with all other fields unchanged."""
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
        """Return the accepted planes as observations, at most `most`, distributed over the pairs of strips."""
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
            f"strip {alone[0]} has fewer than {_FEWEST} planes in common with any other; check overlap and coordinate "
            "system, increase --cell-m or --roughness-m, or remove the strip"
        )
    for common in apart:
        up = float(np.median(common.pairs.gap / common.pairs.normal[:, 2]))
        if abs(up) > _APART_M:
            raise BlockError(
                f"strip {common.one.name} is {abs(up):.1f} m {'above' if up > 0 else 'below'} strip "
                f"{common.other.name}: check the height unit and vertical datum (ellipsoid or geoid) of all strips "
                "and their trajectory"
            )


class PointPlanes(NamedTuple):
    """Points above planes of one strip, and a mask of accepted ones."""

    look: Look
    patches: StripPatches
    found: PointsOnPlanes
    """Gaps of points and planes; point indices refer to `PointSearch.points`."""
    sigma: Float[np.ndarray, "n"]
    """Standard deviation of the gaps, from plane and point (m)."""
    fits: Bool[np.ndarray, "n"]


class PointSearch:
    """Repeated search for planes at points. Once `settled`, returns stay with their points, as in `StripSearch`.

    `points` contains block indices.
    """

    def __init__(self, search: StripSearch, points: Int[np.ndarray, "n"]) -> None:
        self.search, self.points = search, points
        self.about: list[tuple[np.ndarray, ...]] = []

    def look(
        self, place: Float[np.ndarray, "points 3"], spread: Float[np.ndarray, "points 3 3"], settled: bool
    ) -> list[PointPlanes]:
        """Return the planes at points (m) with covariances `spread`, in the strips last corrected by `StripSearch`."""
        search, about, seen = self.search, [], []
        for k, (strip_look, xyz) in enumerate(zip(search.looks, search.corrected, strict=True)):
            about.append(self.about[k] if settled else returns_about(xyz, place, search.settings))
            index, point = about[-1]
            measured, time = search.cloud.xyz[strip_look.returns], times_of(search.cloud)[strip_look.returns]
            patches = planes_of(xyz[index], measured[index], time[index], point, search.settings)
            found = on_planes(patches, place)
            # Mean number of windows of a return near each point: count returns shared by close points once.
            windows = np.bincount(point, np.bincount(index)[index]) / np.maximum(np.bincount(point), 1)
            found = found._replace(sigma=found.sigma * np.sqrt(windows[found.point]))
            of_points = np.einsum("ni,nij,nj->n", patches.normal, spread[found.point], patches.normal)
            sigma = np.sqrt(found.sigma**2 + of_points)
            seen.append(
                PointPlanes(strip_look, patches, found, sigma, fitting(found.gap, sigma, search.settings.outlier))
            )
        self.about = about
        return seen

    def rows(self, planes: Sequence[PointPlanes], errors: StripErrors) -> tuple[StripPoints, ...]:
        """Return the accepted points as observations: one group, or none."""
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
