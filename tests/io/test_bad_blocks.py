"""Every kind of invalid block: one message with file, row or key, and cure."""

import pytest

from jaxphoto.errors import BlockError, InputError, JaxphotoError
from jaxphoto.io import read_block

T, I, P, C = "block.toml", "images.csv", "image_points.csv", "control_points.csv"  # noqa: E741
S, A, O, D = "stations.csv", "attitudes.csv", "object_points.csv", "distances.csv"  # noqa: E741

# name: (changes (file, old, new), words of the message, the last of them a word of the mend)
CASES = {
    # files and columns
    "no settings": ([(T, "", None)], ["block.toml", "add it"]),
    "no images file": ([(I, "", None)], ["images.csv", "add it"]),
    "no image points file": ([(P, "", None)], ["image_points.csv", "add it"]),
    "empty file": ([(S, "", "# nothing\n")], ["stations.csv", "empty", "header"]),
    "missing column": ([(I, "image,camera", "image,kamera")], ["images.csv, row 1", "camera", "add it"]),
    "missing control column": ([(C, "point,X_m", "name,X_m")], ["control_points.csv, row 1", "point", "add it"]),
    "one coordinate column": ([(P, "x_mm,y_mm", "x_mm,y")], ["image_points.csv", "y_mm", "use either"]),
    "two coordinate pairs": ([(P, "sigma_x_mm,sigma_y_mm", "column_px,row_px")], ["image_points.csv", "use either"]),
    "column twice": ([(S, "Y_m,Z_m", "X_m,Z_m")], ["stations.csv, row 1", "X_m", "keep one"]),
    "decimal commas": ([(S, "10.0,0.0,100.0,", "10,0,0,0,100,0,")], ["stations.csv, row 3", "remove", "semicolons"]),
    "open quotation": ([(S, "b,10.0", '"b,10.0')], ["stations.csv, row 3", "quotation", "close"]),
    "not text": ([(S, "b,10.0", "\0,10.0")], ["stations.csv", "not a text file", "save"]),
    "workbook": ([(S, "", "PK\x03\x04\n")], ["stations.csv", "workbook", "save the sheet"]),
    # numbers
    "no number": ([(P, "1.15,0.2", "l.15,0.2")], ["image_points.csv, row 8", "l.15", "write it like"]),
    "underscore": ([(P, "1.15,0.2", "1_15,0.2")], ["image_points.csv, row 8", "1_15", "write it like"]),
    "NaN": ([(P, "1.15,0.2", "nan,0.2")], ["image_points.csv, row 8", "nan", "finite"]),
    "infinity": ([(C, "p1,1.0", "p1,-inf")], ["control_points.csv, row 2", "-inf", "finite"]),
    "empty number": ([(P, "1.15,0.2", ",0.2")], ["image_points.csv, row 8", "x_mm", "give a number"]),
    "empty id": ([(P, "b,p2", "b,")], ["image_points.csv, row 8", "point", "give its id"]),
    "bad number of an unseen point": (
        [(O, "p2,2.5", "p9,x")], ["object_points.csv, row 3", "'x'", "write it like"],
    ),
    "negative sigma": ([(P, "0.003,0.002", "-0.003,0.002")], ["image_points.csv, row 3", "sigma_x_mm", "is positive"]),
    "zero sigma": ([(C, "0.01,0.01,0.02", "0.01,0.0,0.02")], ["control_points.csv, row 2", "sigma_Y_m", "is positive"]),
    "zero station sigma": ([(S, "0.05,0.05,0.1", "0.05,0.05,0")], ["stations.csv, row 2", "sigma_Z_m", "positive"]),
    "zero attitude sigma": ([(A, "0.005,0.005", "0,0.005")], ["attitudes.csv, row 2", "sigma_roll_deg", "positive"]),
    "zero distance sigma": ([(D, "1.5,0.001", "1.5,0")], ["distances.csv, row 2", "sigma_m", "positive"]),
    # sigmas nobody gave
    "no image sigma": ([(T, "image_mm = 0.004\n", "")], ["image_points.csv, row 4", "sigma_px", "image_mm"]),
    "no control sigma": ([(T, "control_m = 0.03\n", "")], ["control_points.csv, row 3", "sigma_Z_m", "control_m"]),
    "no station sigma": ([(T, "station_m = 0.10\n", "")], ["stations.csv, row 3", "sigma_X_m", "station_m"]),
    "no attitude sigma": ([(T, "attitude_deg = 0.01\n", "")], ["attitudes.csv, row 3", "attitude_deg"]),
    "no distance sigma": ([(T, "distance_m = 0.002\n", "")], ["distances.csv, row 3", "distance_m"]),
    # the same thing twice
    "image twice": ([(I, "b,kodak", "a,kodak")], ["images.csv, row 3", "image a", "row 2", "delete"]),
    "measurement twice": ([(P, "b,p2", "b,p1")], ["image_points.csv, row 8", "p1", "row 7", "delete"]),
    "control twice": ([(C, "p4,", "p3,")], ["control_points.csv, row 5", "p3", "row 4", "delete"]),
    "object point twice": ([(O, "p2,", "p1,")], ["object_points.csv, row 3", "p1", "row 2", "delete"]),
    "station twice": ([(S, "b,", "a,")], ["stations.csv, row 3", "image a", "row 2", "delete"]),
    "attitude twice": ([(A, "b,", "a,")], ["attitudes.csv, row 3", "image a", "row 2", "delete"]),
    "distance twice": ([(D, "p2,p3", "p2,p1")], ["distances.csv, row 3", "row 2", "delete"]),
    # ids nobody knows
    "unknown image": ([(P, "b,p2", "B,p2")], ["image_points.csv, row 8", "image B", "add it"]),
    "unknown station": ([(S, "b,", "x,")], ["stations.csv, row 3", "image x", "add it"]),
    "unknown attitude": ([(A, "b,", "x,")], ["attitudes.csv, row 3", "image x", "add it"]),
    "unknown distance point": ([(D, "p2,p3", "p2,p9")], ["distances.csv, row 3", "p9", "delete"]),
    "unknown camera": ([(I, "b,kodak", "b,leica")], ["images.csv, row 3", "[cameras.leica]", "kodak"]),
    "unknown datum point": ([(T, '"p3"]', '"p9"]')], ["block.toml", "over", "p9", "remove"]),
    "unknown role": ([(C, "fixed", "firm")], ["control_points.csv, row 4", "firm", "control, fixed or check"]),
    "unknown mount": ([(T, "[mounts.default]", "[mounts.leica]")], ["block.toml", "leica", "kodak"]),
    "unknown strip": ([(T, "[strips.default]", "[strips.three]")], ["block.toml", "three", "one, two"]),
    # too little
    "no images": ([(I, "", "image,camera\n")], ["images.csv", "no images", "list"]),
    "no image points": ([(P, "", "image,point,x_mm,y_mm\n")], ["image_points.csv", "no image points", "add"]),
    "two points in an image": ([(P, "c,p1,0.2,0.2,,\n", "")], ["images.csv, row 4", "image c", "measure more"]),
    "image never observed": ([(I, "c,kodak", "d,kodak,,1,,,,,,\nc,kodak")], ["images.csv, row 4", "image d has 0"]),
    "tie point seen once": (
        [(P, "a,p4", "a,p7"), (C, "p4,8.0,9.0,10.0,,,,check\n", "")],
        ["image_points.csv, row 6", "p7", "delete the row"],
    ),
    "check point seen once": (
        [(P, "a,p4", "a,p7"), (C, "p4,", "p7,")], ["image_points.csv, row 6", "p7", "measure it in another"],
    ),
    "control without coordinates": ([(C, "p2,,,4.0", "p2,,,")], ["control_points.csv, row 3", "at least one"]),
    "station without coordinates": ([(S, "b,10.0,0.0,100.0", "b,,,")], ["stations.csv, row 3", "at least one"]),
    "no time": ([(I, "one,12.0", "one,")], ["images.csv, row 3", "time_s", '"fixed"']),
    "no strips": ([(I, "strip,time_s", "note,time_s")], ["block.toml", "strips", "no column strip"]),
    # units that cannot be
    "c negative": ([(T, "c_mm = 5.0", "c_mm = -5.0")], ["block.toml", "c_mm", "positive"]),
    "c in pixels": ([(T, "c_mm = 5.0", "c_mm = 500.0")], ["block.toml", "[cameras.kodak.interior] c_mm", "pixels"]),
    "c in metres": ([(T, "c_mm = 5.0", "c_mm = 0.005")], ["block.toml", "[cameras.kodak.interior] c_mm", "metres"]),
    "principal point": ([(T, "k1 = -1e-4", "xp_mm = 200.0")], ["block.toml", "xp_mm", "image centre"]),
    "pixel in micrometres": ([(T, "pixel_mm = 0.01", "pixel_mm = 10")], ["block.toml", "pixel_mm", "in millimetres"]),
    "pixel in metres": ([(T, "pixel_mm = 0.01", "pixel_mm = 1e-5")], ["block.toml", "pixel_mm", "in millimetres"]),
    "pixels as mm": ([(P, "1.15,0.2", "315.0,0.2")], ["image_points.csv, row 8", "x_mm = 315", "column_px"]),
    "pixels outside": (
        [(P, "x_mm,y_mm,sigma_x_mm,sigma_y_mm", "column_px,row_px,sigma_px,n"), (P, "1.15,0.2", "1.15,900.0")],
        ["image_points.csv, row 8", "row_px = 900", "height_px"],
    ),
    "pixels of turned pictures": (
        [(P, "", "image,point,column_px,row_px\na,p1,10,20\nb,p1,250,390\n")],
        ["image_points.csv, row 3", "row_px = 390", "turned by 90 degrees"],
    ),
    "angle in gon": ([(I, "-0.25,90.0", "-0.25,399.0")], ["images.csv, row 2", "kappa_deg = 399", "degrees"]),
    "attitude in gon": ([(A, "45.0", "390.0")], ["attitudes.csv, row 2", "yaw_deg = 390", "degrees"]),
    "distance to itself": ([(D, "p2,p3", "p2,p2")], ["distances.csv, row 3", "correct"]),
    "negative distance": ([(D, "p2,p3,2.5", "p2,p3,-2.5")], ["distances.csv, row 3", "-2.5", "a distance is positive"]),
    "lever arm in mm": ([(T, "[0.1, 0.2, -0.3]", "[100.5, 200, 300]")], ["block.toml", "lever_arm_m", "metres"]),
    "both kinds of sigma": (
        [(P, "sigma_x_mm,sigma_y_mm", "sigma_x_mm,sigma_px")], ["image_points.csv, row 3", "sigma_px", "keep one"],
    ),
    # block.toml
    "TOML syntax": ([(T, "image_mm = 0.004", "image_mm = 0,004")], ["block.toml", "line 5", "correct"]),
    "unknown key": ([(T, "image_mm", "image_nm")], ["block.toml", "[sigmas] image_nm", "image_mm"]),
    "unknown table": ([(T, "[datum]", "[datums]")], ["block.toml", "datums", "datum"]),
    "number as text": ([(T, "c_mm = 5.0", 'c_mm = "5.0"')], ["block.toml", "c_mm", "quotation marks"]),
    "number as truth": ([(T, "c_mm = 5.0", "c_mm = true")], ["block.toml", "c_mm", "write it like"]),
    "TOML nan": ([(T, "k1 = -1e-4", "k1 = nan")], ["block.toml", "k1", "finite"]),
    "default sigma": ([(T, "image_mm = 0.004", "image_mm = 0")], ["block.toml", "[sigmas] image_mm", "correct it"]),
    "part of a pixel": ([(T, "width_px = 400", "width_px = 400.5")], ["block.toml", "width_px", "whole number"]),
    "no c": ([(T, "c_mm = 5.0\n", "")], ["block.toml", "[cameras.kodak.interior] c_mm", "add it"]),
    "no format": ([(T, "width_px = 400\n", "")], ["block.toml", "[cameras.kodak] width_px", "add it"]),
    "unknown distortion": ([(T, '"brown"', '"braun"')], ["block.toml", "braun", "brown, smac"]),
    "unknown coefficient": ([(T, "k1 = -1e-4", "k9 = -1e-4")], ["block.toml", "interior] k9", "k1, k2, k3"]),
    "unknown unknown": ([(T, 'c_mm = "free"', 'f_mm = "free"')], ["block.toml", "unknowns] f_mm", "c_mm, xp_mm"]),
    "constant as unknown": ([(T, 'c_mm = "free"', 'r0_mm = "free"')], ["block.toml", "unknowns] r0_mm", "c_mm"]),
    "unknown status": ([(T, 'c_mm = "free"', 'c_mm = "loose"')], ["block.toml", "unknowns] c_mm", '"free"']),
    "zero weight": ([(T, "sigma = 2e-5", "sigma = 0.0")], ["block.toml", "unknowns] k1", '"fixed"']),
    "weight without sigma": ([(T, "sigma = 2e-5", "value = 2e-5")], ["block.toml", "unknowns] k1", "sigma"]),
    "sign of brown": ([(T, '"brown"', '"brown"\nsign = "add"')], ["block.toml", "sign", "remove"]),
    "residuals of nothing": ([(T, '"brown"', '"brown"\nresiduals = "x"')], ["block.toml", "residuals", '"measured"']),
    "sign of smac": ([(T, '"brown"', '"smac"\nsign = "plus"')], ["block.toml", "sign", '"subtract"']),
    "no grid of Ebner": ([(T, '"brown"', '"ebner"')], ["block.toml", "[cameras.kodak.interior] b_mm", "add it"]),
    "grid of Gruen": (
        [(T, '"brown"', '"gruen"'), (T, "k1 = -1e-4", "b_mm = 0.0")], ["block.toml", "b_mm", "0 is not positive"],
    ),
    "scale of Brown's fourteen": (
        [(T, '"brown"', '"brown14"'), (T, "k1 = -1e-4", "f_mm = -5.0")], ["block.toml", "f_mm", "not positive"],
    ),
    "constant of another model": (
        [(T, '"brown"', '"radial"'), (T, "k1 = -1e-4", "b_mm = 2.0")], ["block.toml", "b_mm", "remove"],
    ),
    "a vector of two": ([(T, "[0.1, 0.2, -0.3]", "[0.1, 0.2]")], ["block.toml", "lever_arm_m", "give 3"]),
    "sigma of two": ([(T, "sigma_m = 0.01", "sigma_m = [0.1, 0.2]")], ["block.toml", "lever_arm", "one per axis"]),
    "no camera": ([(T, "", 'title = "x"\n')], ["block.toml", "no camera", "add"]),
    "camera default": ([(T, "[mounts.default]", "[cameras.default]")], ["block.toml", "default", "another"]),
    "strip default": ([(I, "kodak,two", "kodak,default")], ["images.csv, row 4", "default", "another name"]),
    "unknown frame": ([(T, '"local"', '"utm"')], ["block.toml", "utm", '"enu"']),
    "unknown datum": ([(T, '"inner"', '"outer"')], ["block.toml", "[datum] kind", '"minimal"']),
    "over without inner": ([(T, '"inner"', '"control"')], ["block.toml", "[datum] over", "remove"]),
    "datum ids as numbers": ([(T, '["p1", "p2", "p3"]', "[1, 2, 3]")], ["block.toml", "over", "as text"]),
    "datum scale": ([(T, "scale = false", 'scale = "no"')], ["block.toml", "scale", "true nor false"]),
    "table as text": ([(T, '[frame]\nkind = "local"', 'frame = "local"')], ["block.toml", "frame", "[frame]"]),
    "title as number": ([(T, '"small"', "7")], ["block.toml", "title", "quotation marks"]),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", CASES)
def test_bad_input_is_refused(write_folder, name):
    changes, words = CASES[name]
    spoilt = any("\udcff" in (new or "") for _, _, new in changes)
    if spoilt:
        folder = write_folder()
        for file, old, new in changes:
            data = (folder / file).read_bytes().replace(old.encode(), new.encode("utf-8", "surrogateescape"))
            (folder / file).write_bytes(data)
    else:
        folder = write_folder(*changes)

    with pytest.raises(JaxphotoError) as caught:
        read_block(folder)

    message = str(caught.value)
    for word in words:
        assert word in message, message
    assert "\n" not in message
    assert not message.endswith("."), "the sentence is ended where it is printed"


def test_no_folder(tmp_path):
    with pytest.raises(InputError, match=r"folder not found: .*nowhere; give the folder"):
        read_block(tmp_path / "nowhere")


def test_content_and_fit_are_different_errors(write_folder):
    with pytest.raises(BlockError):
        read_block(write_folder((P, "c,p1,0.2,0.2,,\n", "")))


def test_control_holds_a_point_seen_once(write_folder):
    """One ray and a height give a point, so this is no error."""
    block = read_block(write_folder((P, "a,p4", "a,p7"), (C, "p4,8.0,9.0,10.0,,,,check", "p7,,,10.0,,,,control")))
    assert "p7" in block.points


def test_a_point_may_have_a_role_per_axis(write_folder):
    block = read_block(write_folder((C, "p2,,,4.0,,,,control", "p2,,,4.0,,,,control\np2,1.0,1.0,,,,,check")))
    assert (block.check.who == 1).sum() == 2
    assert (block.control.who == 1).sum() == 1
