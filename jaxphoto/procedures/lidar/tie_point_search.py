"""Looking for the planes that strips have about points, in the cloud as it is corrected so far."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.georeferencing import StripErrors
from jaxphoto.lidar.corresponding_planes import StripPatches, fitting, planes_of
from jaxphoto.lidar.points_on_planes import PointsOnPlanes, on_planes, returns_about, windows_of_returns
from jaxphoto.lidar.strip_correction import times_of
from jaxphoto.observations import StripPoints
from jaxphoto.procedures.lidar.looks import Look
from jaxphoto.procedures.lidar.strip_rows import side_of
from jaxphoto.procedures.lidar.strip_search import StripSearch


class PointPlanes(NamedTuple):
    """The points that lie over planes of one strip, and which of them fit."""

    look: Look
    patches: StripPatches
    found: PointsOnPlanes
    """Its points are numbers among `PointSearch.points`."""
    sigma: Float[np.ndarray, "n"]
    """Of the gaps, by plane and point (m)."""
    fits: Bool[np.ndarray, "n"]


class PointSearch:
    """Searches that follow one another: returns stay about their points when `settled`, as those of `StripSearch`.

    `points` are the numbers in the block of the points looked for.
    """

    def __init__(self, search: StripSearch, points: Int[np.ndarray, "points"]) -> None:
        self.search, self.points = search, points
        self.about: list[tuple[np.ndarray, np.ndarray]] = []

    def look(
        self, place: Float[np.ndarray, "points 3"], spread: Float[np.ndarray, "points 3 3"], settled: bool
    ) -> list[PointPlanes]:
        """The planes about points (m) with these covariances, in the strips as the other search corrected them last."""
        search, about, seen = self.search, [], []
        for k, (own, xyz) in enumerate(zip(search.looks, search.corrected, strict=True)):
            about.append(self.about[k] if settled else returns_about(xyz, place, search.settings))
            index, point = about[-1]
            measured, time = search.cloud.xyz[own.returns], times_of(search.cloud)[own.returns]
            patches = planes_of(xyz[index], measured[index], time[index], point, search.settings)
            found = on_planes(patches, place)
            found = found._replace(sigma=found.sigma * np.sqrt(windows_of_returns(index, point)[found.point]))
            of_points = np.einsum("ni,nij,nj->n", patches.normal, spread[found.point], patches.normal)
            sigma = np.sqrt(found.sigma**2 + of_points)
            seen.append(PointPlanes(own, patches, found, sigma, fitting(found.gap, sigma, search.settings.outlier)))
        self.about = about
        return seen

    def rows(self, seen: Sequence[PointPlanes], errors: StripErrors) -> tuple[StripPoints, ...]:
        """The points that fit as observations: one group of them, where there are any."""
        of_strips = []
        for f in (f for f in seen if f.fits.any()):
            found = PointsOnPlanes(*(v[f.fits] for v in f.found))
            side = side_of(f.patches, found.patch, found.foot, f.look.strip, errors, self.search.path)
            normal = f.patches.normal[found.patch]
            of_strips.append(
                StripPoints(
                    self.points[found.point],
                    side.knots,
                    side.weights,
                    side.point,
                    side.scanner,
                    side.roll_pitch_yaw,
                    side.velocity,
                    side.rate,
                    normal,
                    found.sigma,
                    np.zeros(len(normal)),
                )
            )
        return (StripPoints.joined(*of_strips),) if of_strips else ()
