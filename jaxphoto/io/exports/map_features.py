"""Photographs as features of a geographic information system: stations with their angles, and footprints."""

from typing import Any, NamedTuple

import numpy as np

from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs
from jaxphoto.io.exports.angles_text import angles_deg
from jaxphoto.io.exports.footprints import footprints
from jaxphoto.io.exports.map_photographs import in_map


class MapFeatures(NamedTuple):
    """One entry a photograph; positions and rings in the block's own frame (m)."""

    positions: np.ndarray
    rings: list[np.ndarray | None]
    """Closed: the last point is the first; None where a photograph looks at the horizon."""
    attributes: list[dict[str, Any]]
    """image, file, camera, omega_deg, phi_deg, kappa_deg against the grid of the map, n_image_points."""


def map_features(photographs: AdjustedPhotographs) -> MapFeatures:
    """Stations, footprints and their attributes."""
    p = photographs
    angles = angles_deg(in_map(p).exterior).tolist()
    attributes = [
        {"image": name, "file": file, "camera": camera}
        | dict(zip(("omega_deg", "phi_deg", "kappa_deg"), values, strict=True))
        | {"n_image_points": len(rows)}
        for name, file, camera, values, rows in zip(
            p.images, p.files, p.image_camera, angles, p.rows_of_images, strict=True
        )
    ]
    rings = [None if ring is None else np.vstack([ring, ring[:1]]) for ring in footprints(p)]
    return MapFeatures(np.asarray(p.exterior.position), rings, attributes)
