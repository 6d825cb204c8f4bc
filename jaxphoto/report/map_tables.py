"""Adjusted images and points in the system of the block's files: a map's grid, or longitude and latitude."""

import equinox as eqx
import jax
import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.compiling import call_compiled
from jaxphoto.rotation import omega_phi_kappa_from_matrix


def exterior_map_table(adjusted: Adjustment) -> pd.DataFrame:
    """image, position in the system of the block's files, and omega, phi, kappa against grid east, north and up."""
    exterior, system = adjusted.unknowns.exterior, adjusted.block.frame.map
    position = np.asarray(exterior.position)
    table = map_coordinates(adjusted, position)
    camera_from_grid = np.asarray(exterior.camera_from_object) @ system.local_from_grid(position)
    table[["omega_deg", "phi_deg", "kappa_deg"]] = angles_deg(camera_from_grid)
    table.insert(0, "image", adjusted.block.images)
    return table


def map_coordinates(adjusted: Adjustment, local: Float[np.ndarray, "n 3"]) -> pd.DataFrame:
    """Coordinates (m) of the block's frame, in the system of its files."""
    system = adjusted.block.frame.map
    names = ["longitude_deg", "latitude_deg", "height_m"] if system.geographic else ["E_m", "N_m", "H_m"]
    return pd.DataFrame(system.map(local), columns=names)


def angles_deg(camera_from_object: Float[np.ndarray, "images 3 3"]) -> Float[np.ndarray, "images 3"]:
    """omega, phi, kappa (degrees)."""
    return np.degrees(np.asarray(call_compiled(_angles, camera_from_object)))


@eqx.filter_jit
def _angles(camera_from_object):
    return jax.vmap(omega_phi_kappa_from_matrix)(camera_from_object)
