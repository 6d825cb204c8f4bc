"""Search for common planes of two strips, in the cloud as corrected so far."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import Pattern, StripErrors
from jaxphoto.lidar.cell_returns import cells_of
from jaxphoto.lidar.correction import ScannerPath
from jaxphoto.lidar.corresponding_planes import PlanePairs, StripPatches, corresponding, fitting, planes_of
from jaxphoto.lidar.strip_correction import corrected_strip, times_of
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.observations import StripPlanes
from jaxphoto.procedures.lidar.looks import Look, looks_of
from jaxphoto.procedures.lidar.strip_rows import plane_rows, side_of, thinned

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
        for k, own in enumerate(self.looks):
            measured, time = self.cloud.xyz[own.returns], times_of(self.cloud)[own.returns]
            xyz = corrected_strip(measured, time, own.strip, errors, self.path)
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
        for own, corrected in zip(self.looks, self.corrected, strict=True):
            xyz[own.returns] = corrected
        return dataclasses.replace(self.cloud, xyz=xyz)

    def _common(self, one: int, other: int, patches: list[StripPatches]) -> CommonPlanes | None:
        pairs = corresponding(patches[one], patches[other], self.settings)
        if len(pairs.gap) < _FEWEST:
            return None
        fits = fitting(pairs.gap, pairs.sigma, self.settings.outlier)
        return CommonPlanes(self.looks[one], self.looks[other], (patches[one], patches[other]), pairs, fits)

    def rows(self, seen: Sequence[CommonPlanes], errors: StripErrors) -> StripPlanes:
        """Return the fitting planes as observations, at most `most`, distributed over the pairs of strips."""
        total, parts = sum(int(f.fits.sum()) for f in seen), []
        for f in seen:
            own = np.flatnonzero(f.fits)
            share = max(_FEWEST, self.settings.most * len(own) // total)
            own = own[thinned(f.pairs.normal[own], f.pairs.cell[own], share)]
            pairs = PlanePairs(*(v[own] for v in f.pairs))
            a = side_of(f.patches[0], pairs.a, pairs.foot_a, f.one.strip, errors, self.path)
            b = side_of(f.patches[1], pairs.b, pairs.foot_b, f.other.strip, errors, self.path)
            parts.append(plane_rows(pairs, a, b))
        return StripPlanes.joined(*parts) if parts else StripPlanes.none()


def check_joined(names: Sequence[str], seen: Sequence[CommonPlanes]) -> None:
    """Raise BlockError for a strip without a common plane, or in another coordinate system."""
    apart = [found for found in seen if found.one.strip != found.other.strip]
    joined = {look.strip for found in apart for look in (found.one, found.other)}
    alone = [name for k, name in enumerate(names) if k not in joined]
    if alone and len(names) > 1:
        raise BlockError(
            f"strip {alone[0]} has fewer than {_FEWEST} planes in common with any other: leave it out, take larger "
            "cells (--cell-m) or rougher planes (--roughness-m), or check that all strips overlap and are in one system"
        )
    for found in apart:
        up = float(np.median(found.pairs.gap / found.pairs.normal[:, 2]))
        if abs(up) > _APART_M:
            raise BlockError(
                f"strip {found.one.name} lies {abs(up):.1f} m {'above' if up > 0 else 'below'} strip "
                f"{found.other.name}: heights of one may count in feet or belong to another vertical system, as those "
                "above an ellipsoid and a geoid; bring all strips and their trajectory into one"
            )
