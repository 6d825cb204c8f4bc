"""A small block folder with every file, to read and to modify."""

from collections.abc import Callable
from pathlib import Path

import pytest

from jaxphoto import Tables, adjust
from jaxphoto.report import summary_of, verdict_of
from jaxphoto.report.results import write_summary

FILES = {
    "block.toml": """\
title = "small"
[frame]
kind = "local"
[sigmas]
image_mm = 0.004
control_m = 0.03
station_m = 0.10
attitude_deg = 0.01
distance_m = 0.002
[cameras.kodak]
width_px = 400
height_px = 300
pixel_mm = 0.01
distortion = "brown"
[cameras.kodak.interior]
c_mm = 5.0
k1 = -1e-4
[cameras.kodak.unknowns]
c_mm = "free"
k1 = { sigma = 2e-5 }
[mounts.default]
lever_arm_m = [0.1, 0.2, -0.3]
lever_arm = { sigma_m = 0.01 }
boresight_deg = [0.5, 0.0, -0.25]
boresight = "free"
[strips.default]
shift = "free"
drift = "free"
[datum]
kind = "inner"
over = ["p1", "p2", "p3"]
scale = false
""",
    "images.csv": """\
image,camera,strip,time_s,X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg
a,kodak,one,10.0,0.0,0.0,100.0,0.5,-0.25,90.0
b,kodak,one,12.0,10.0,0.0,100.0,0.0,0.0,0.0
c,kodak,two,20.0,,,,,,
""",
    "image_points.csv": """\
# measured by hand
image,point,x_mm,y_mm,sigma_x_mm,sigma_y_mm
a,p1,0.1,0.2,0.003,0.002
a,p2,1.1,0.2,,
a,p3,0.1,1.2,,
a,p4,-1.1,-0.2,,
b,p1,0.15,0.2,,
b,p2,1.15,0.2,,
b,p3,0.15,1.2,,
b,p4,-1.05,-0.2,,
c,p1,0.2,0.2,,
c,p2,1.2,0.2,,
c,p4,-1.0,-0.2,,
""",
    "control_points.csv": """\
point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role
p1,1.0,2.0,3.0,0.01,0.01,0.02,control
p2,,,4.0,,,,control
p3,5.0,6.0,7.0,,,,fixed
p4,8.0,9.0,10.0,,,,check
""",
    "stations.csv": """\
image,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m
a,0.0,0.0,100.0,0.05,0.05,0.1
b,10.0,0.0,100.0,,,
""",
    "attitudes.csv": """\
image,roll_deg,pitch_deg,yaw_deg,sigma_roll_deg,sigma_pitch_deg,sigma_yaw_deg
a,1.0,-2.0,45.0,0.005,0.005,0.01
b,0.0,0.0,0.0,,,
""",
    "object_points.csv": """\
point,X_m,Y_m,Z_m
p1,1.1,2.1,3.1
p2,2.5,2.5,4.5
""",
    "distances.csv": """\
point_a,point_b,distance_m,sigma_m
p1,p2,1.5,0.001
p2,p3,2.5,
""",
}


@pytest.fixture
def write_folder(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes the small block; `changes` (file, old, new) spoil it, old "" replaces the whole file."""

    def write(*changes: tuple[str, str, str | None]) -> Path:
        files: dict[str, str | None] = dict(FILES)
        for file, old, new in changes:
            text = files[file]
            assert text is not None and old in text, f"{old!r} is not in {file}"
            files[file] = text.replace(old, new, 1) if old and new is not None else new
        folder = tmp_path / "block"
        folder.mkdir()
        for file, text in files.items():
            if text is not None:
                (folder / file).write_text(text, encoding="utf-8")
        return folder

    return write


def write_calibration(block, folder: Path) -> None:
    """Adjust a block, and write those files of results that later calibrations read."""
    tables = Tables(adjust(block))
    folder.mkdir()
    for name in ("interior", "correlation"):
        getattr(tables, name).to_csv(folder / f"{name}.csv", index=False)
    write_summary(summary_of(tables, verdict_of(tables), {}), folder)
