"""Search for planes of strips about points, in the cloud as corrected so far."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.errors import few
from jaxphoto.georeferencing import StripErrors
from jaxphoto.lidar.corresponding_planes import StripPatches, fitting, planes_of
from jaxphoto.lidar.points_on_breaklines import faces_about
from jaxphoto.lidar.points_on_planes import PointsOnPlanes, on_planes, returns_about, windows_of_returns
from jaxphoto.lidar.strip_correction import times_of
from jaxphoto.observations import StripPoints
from jaxphoto.procedures.lidar.looks import Look
from jaxphoto.procedures.lidar.strip_rows import side_of
from jaxphoto.procedures.lidar.strip_search import StripSearch


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
        for k, (own, xyz) in enumerate(zip(search.looks, search.corrected, strict=True)):
            about.append(self.about[k] if settled else self._about(xyz, place))
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

    def _about(self, xyz: Float[np.ndarray, "n 3"], place: Float[np.ndarray, "points 3"]) -> tuple[np.ndarray, ...]:
        """Return the returns about each point, or of its face, and the point of each."""
        index, point = returns_about(xyz, place[: self._plain], self.search.settings)
        of_faces, face = faces_about(xyz, place[self._plain :: 2], self.search.settings)
        return np.concatenate([index, of_faces]), np.concatenate([point, self._plain + face])

    def unseen(self, seen: Sequence[PointPlanes], names: Sequence[str]) -> list[str]:
        """Return a message if points on breaklines have no faces in any strip; `names` are those of the block."""
        lines = self.points[self._plain :: 2]
        number = np.concatenate([f.found.point[f.found.point >= self._plain] for f in seen])
        out = np.setdiff1d(np.arange(len(lines)), (number - self._plain) // 2)
        if not len(out):
            return []
        return [
            f"{len(out)} of {len(lines)} points on breaklines have no two smooth faces about them in any strip, and "
            f"nothing is said of them: {few([names[p] for p in lines[out]])}; take cells (--cell-m) half as wide as "
            "the roofs, or leave these points out"
        ]

    def rows(self, seen: Sequence[PointPlanes], errors: StripErrors) -> tuple[StripPoints, ...]:
        """Return the fitting points as observations: one group, if there are any."""
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
