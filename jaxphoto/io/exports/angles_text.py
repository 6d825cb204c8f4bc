"""Adjusted photographs -> a table of positions and omega, phi, kappa, and cameras and image points as blocks have them.

`camera_from_object = R3(kappa) R2(phi) R1(omega)` of docs/conventions.md, as in Inpho and Pix4D, which write the
transpose Rx(omega) Ry(phi) Rz(kappa) from the camera to the object; the axes of the object are grid east, grid north
and up at the place of the photograph.
"""

import csv
from pathlib import Path

import jax
import numpy as np
import pandas as pd

from jaxphoto.arrays import still
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs
from jaxphoto.io.exports.image_points import write_image_points
from jaxphoto.io.exports.map_photographs import in_map
from jaxphoto.io.reconstructions.text_project import IMAGES
from jaxphoto.io.toml import toml_text
from jaxphoto.unknowns import FIXED

FILE, CAMERAS = "exterior.txt", "camera.toml"


def write_angles_text(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write exterior.txt, tabs between its columns and # before its comments, camera.toml and image_points.csv, and of
    several cameras images.csv, which says which photograph has which."""
    p, on_map = photographs, in_map(photographs)
    place = "longitude and latitude (degrees) and height (m)" if on_map.geographic else "X Y Z (m)"
    heights = "above the ellipsoid" if p.frame.vertical is None else f"of EPSG:{p.frame.vertical}"
    system = f"of {on_map.system}, heights {heights}" if on_map.system else "of the block's local frame"
    head = [
        f"# {place} {system}",
        "# omega phi kappa in degrees: camera = Rz(kappa) Ry(phi) Rx(omega) object, camera x right, y up, z backwards",
        "imageName\tX\tY\tZ\tOmega\tPhi\tKappa",
    ]
    values = np.hstack([np.asarray(on_map.exterior.position), angles_deg(on_map.exterior)])
    lines = ["\t".join([file, *map(repr, row)]) for file, row in zip(p.files, values.tolist(), strict=True)]
    (folder / FILE).write_text("\n".join([*head, *lines]) + "\n", encoding="utf-8")
    held = {name: Camera(*c, jax.tree.map(lambda _: FIXED, c.interior)) for name, c in p.cameras.items()}
    sections = {name: camera_section(camera) for name, camera in held.items()}
    (folder / CAMERAS).write_text(toml_text({"cameras": sections}), encoding="utf-8")
    if len(p.cameras) > 1:
        table = pd.DataFrame({"image": p.files, "camera": p.image_camera})
        table.to_csv(folder / IMAGES, index=False, quoting=csv.QUOTE_NONNUMERIC)
    write_image_points(p, folder)


def angles_deg(exterior: ExteriorOrientation) -> np.ndarray:
    """omega, phi, kappa (n, 3) in degrees."""
    return np.rad2deg(still(exterior.omega_phi_kappa))
