"""Conversion between WGS 84 positions of receivers and the datum of a map system, by PROJ."""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.transformer import TransformerGroup

from jaxphoto.errors import InputError
from jaxphoto.georeferencing.map_frame import map_system

_WGS84_3D = 4979
# Half side length (degrees) of the area in which a transformation must be valid.
_ABOUT = 0.1
# Accuracy (m) above which a transformation is reported even if it has no effect.
_SURE_M = 1.0


class DatumChange(NamedTuple):
    """Best installed PROJ transformation from WGS 84 to the datum of a map system, near a given position."""

    transformer: Transformer
    datum: str
    name: str
    """EPSG name of the operation."""
    accuracy_m: float | None
    """Accuracy (m); None if unknown."""
    meridian_deg: float
    """Longitude (degrees) of the prime meridian of the datum, from Greenwich."""
    better: tuple[str, float] | None
    """Grid of a better transformation that is not installed, and its accuracy (m)."""

    def places(
        self, wgs84: Float[np.ndarray, "n 3"], with_height: bool | Bool[np.ndarray, "n"] = True
    ) -> Float[np.ndarray, "n 3"]:
        """Convert WGS 84 to longitude, latitude (degrees) and height (m) on the datum of the map system.

        Heights that are not ellipsoidal (`with_height` False) are unchanged.
        """
        return self._changed(wgs84, with_height, "FORWARD")

    def wgs84(
        self, places: Float[np.ndarray, "n 3"], with_height: bool | Bool[np.ndarray, "n"] = True
    ) -> Float[np.ndarray, "n 3"]:
        """Invert `places`."""
        return self._changed(places, with_height, "INVERSE")

    def sentences(
        self, wgs84: Float[np.ndarray, "n 3"], with_height: bool | Bool[np.ndarray, "n"] = True
    ) -> tuple[str, ...]:
        """Describe the change and its accuracy; return nothing if it is zero with an accuracy of 1 m or better."""
        known = self.accuracy_m
        if known is None:
            return (
                f"PROJ has no transformation from WGS 84 to the datum {self.datum}: positions are not transformed "
                "and may have errors of hundreds of metres; choose a CRS of another datum",
            )
        moved = self.places(wgs84, with_height) - wgs84
        north, east = np.deg2rad(moved[:, 1]) * 6.371e6, np.deg2rad(moved[:, 0] + self.meridian_deg) * 6.371e6
        plan = float(np.median(np.hypot(north, east * np.cos(np.deg2rad(wgs84[:, 1])))))
        up = float(np.median(moved[:, 2]))
        by = f'by PROJ\'s "{self.name}", accuracy {known:g} m'
        if not moved.any():
            if known <= _SURE_M:
                return ()
            said = f"positions of WGS 84 are used unchanged in the datum {self.datum}, {by}"
        else:
            heights = f"{up:+.2f} m in height" if np.any(with_height) else "heights unchanged"
            said = (
                f"positions are transformed from WGS 84 to the datum {self.datum} {by}: {plan:.2f} m in plan, {heights}"
            )
        if self.better:
            grid, accuracy = self.better
            said += f'; {grid}, which is not installed, gives {accuracy:g} m ("pyproj sync --file {grid}")'
        return (said,)

    def _changed(self, values: np.ndarray, with_height: bool | np.ndarray, direction: str) -> np.ndarray:
        x, y, z = np.asarray(values, float).T
        found = np.stack(self.transformer.transform(x, y, z, direction=direction), axis=1)
        found[:, 2] = np.where(with_height, found[:, 2], values[:, 2])
        return found


def datum_change(code: int, longitude_deg: float, latitude_deg: float) -> DatumChange:
    """Return the transformation from WGS 84 to the datum of the EPSG system `code` near a position.

    Raises InputError if PROJ has none.
    """
    system = map_system(code)
    geodetic = system.geodetic_crs
    assert geodetic is not None
    group = ways(CRS.from_epsg(_WGS84_3D), geodetic.to_3d(), longitude_deg, latitude_deg)
    if not group.transformers:
        raise InputError(
            f"PROJ has no transformation from WGS 84 to the datum of EPSG:{code} ({system.name}) at "
            f"{longitude_deg:.3f}, {latitude_deg:.3f} degrees; give a CRS that covers this position"
        )
    best = group.transformers[0]
    accuracy = None if "Ballpark" in best.description or best.accuracy < 0 else float(best.accuracy)
    better = [
        (grid.short_name, float(operation.accuracy))
        for operation in group.unavailable_operations
        if operation.accuracy >= 0 and (accuracy is None or operation.accuracy < accuracy)
        for grid in operation.grids
        if not grid.available
    ]
    steps = [step for step in best.description.split(" + ") if not step.startswith("axis order change")]
    # Remove the axis order that PROJ 9.6 and later append to the name of each step.
    name = " + ".join(step.removeprefix("Inverse of ").split(" (with axis order")[0] for step in steps)
    better_one = min(better, key=lambda b: b[1], default=None)
    return DatumChange(best, geodetic.name, name, accuracy, _meridian_deg(geodetic), better_one)


def wgs84_places(
    code: int, places: Float[np.ndarray, "n 3"], with_height: bool | Bool[np.ndarray, "n"] = True
) -> Float[np.ndarray, "n 3"]:
    """Convert `places` on the datum of the EPSG system `code` to WGS 84: longitude, latitude (degrees), height (m).

    Raises InputError like `datum_change`.
    """
    geodetic = map_system(code).geodetic_crs
    assert geodetic is not None
    longitude, latitude, _ = np.median(places, axis=0).tolist()
    return datum_change(code, longitude + _meridian_deg(geodetic), latitude).wgs84(places, with_height)


def ways(source: CRS, target: CRS, longitude_deg: float, latitude_deg: float) -> TransformerGroup:
    """Return the PROJ transformations between two systems near a position, the best installed one first."""
    longitude = (longitude_deg + 180) % 360 - 180
    here = AreaOfInterest(longitude - _ABOUT, latitude_deg - _ABOUT, longitude + _ABOUT, latitude_deg + _ABOUT)
    # Suppress pyproj's warning about missing grids: better transformations are reported separately.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return TransformerGroup(source, target, always_xy=True, area_of_interest=here)  # type: ignore[arg-type]


def _meridian_deg(geodetic: CRS) -> float:
    meridian = geodetic.prime_meridian
    return 0.0 if meridian is None else float(meridian.longitude * np.rad2deg(meridian.unit_conversion_factor))
