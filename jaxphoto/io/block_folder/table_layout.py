"""The tables of a block folder: which files there are, which columns each has, which of them are needed."""

from typing import NamedTuple

from jaxphoto.block import Frame
from jaxphoto.georeferencing.map_frame import map_system

TOML = "block.toml"
XYZ = ("X_m", "Y_m", "Z_m")
PLACE = ("longitude_deg", "latitude_deg", "height_m")
SIGMA_XYZ = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
ATTITUDE = ("roll_deg", "pitch_deg", "yaw_deg")
SIGMA_ATTITUDE = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg")
VELOCITY = ("vX_m_per_s", "vY_m_per_s", "vZ_m_per_s")
FOOT = ("foot_X_m", "foot_Y_m", "foot_Z_m")
NORMAL = ("normal_X", "normal_Y", "normal_Z")
TURN = ("turn_right_m", "turn_forward_m", "turn_up_m")
RATE = ("rate_right_deg_per_s", "rate_forward_deg_per_s", "rate_up_deg_per_s")


class TableLayout(NamedTuple):
    """One CSV of the folder."""

    needed: bool
    columns: tuple[str, ...]
    optional: tuple[str, ...] = ()
    text: tuple[str, ...] = ()
    """Columns of ids besides those that all tables share."""


LAYOUTS = {
    "images": TableLayout(True, ("image", "camera"), ("strip", "time_s", "temperature_c", *XYZ, *ANGLES)),
    "image_points": TableLayout(
        True,
        ("image", "point"),
        ("x_mm", "y_mm", "column_px", "row_px", "sigma_x_mm", "sigma_y_mm", "sigma_px"),
    ),
    "control_points": TableLayout(False, ("point",), (*XYZ, *SIGMA_XYZ, "role")),
    "stations": TableLayout(False, ("image", *XYZ), (*SIGMA_XYZ, *VELOCITY)),
    "attitudes": TableLayout(False, ("image", *ATTITUDE), (*SIGMA_ATTITUDE, *RATE)),
    "object_points": TableLayout(False, ("point", *XYZ)),
    "surfaces": TableLayout(False, ("point", *FOOT, *NORMAL, *TURN, "sigma_m"), ("strip",)),
}
"""The tables that have readers of their own; those of other observations follow from their classes (`observed`)."""


def coordinate_names(frame: Frame) -> tuple[str, ...]:
    """The columns in which the files of a block in `frame` give coordinates."""
    geographic = frame.code is not None and map_system(frame.code).is_geographic
    return PLACE if geographic else XYZ


def layout_in(frame: Frame, layout: TableLayout) -> TableLayout:
    """The layout of a table of a block in `frame`."""
    names = dict(zip(XYZ, coordinate_names(frame), strict=True))
    needed, optional = (tuple(names.get(c, c) for c in columns) for columns in (layout.columns, layout.optional))
    return TableLayout(layout.needed, needed, optional, layout.text)
