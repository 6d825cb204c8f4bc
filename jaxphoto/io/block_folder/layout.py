"""The tables of a block folder: which files there are, which columns each has, which of them are needed."""

from typing import NamedTuple

TOML = "block.toml"
XYZ = ("X_m", "Y_m", "Z_m")
SIGMA_XYZ = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
ATTITUDE = ("roll_deg", "pitch_deg", "yaw_deg")
SIGMA_ATTITUDE = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg")


class Layout(NamedTuple):
    """One CSV of the folder."""

    needed: bool
    columns: tuple[str, ...]
    optional: tuple[str, ...] = ()


LAYOUTS = {
    "images": Layout(True, ("image", "camera"), ("strip", "time_s", *XYZ, *ANGLES)),
    "image_points": Layout(
        True,
        ("image", "point"),
        ("x_mm", "y_mm", "column_px", "row_px", "sigma_x_mm", "sigma_y_mm", "sigma_px"),
    ),
    "control_points": Layout(False, ("point",), (*XYZ, *SIGMA_XYZ, "role")),
    "stations": Layout(False, ("image", *XYZ), SIGMA_XYZ),
    "attitudes": Layout(False, ("image", *ATTITUDE), SIGMA_ATTITUDE),
    "object_points": Layout(False, ("point", *XYZ)),
    "distances": Layout(False, ("point_a", "point_b", "distance_m"), ("sigma_m",)),
}
