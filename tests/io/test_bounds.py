"""What has no end, or is larger than anything that is measured, is refused soon and in a short sentence."""

import os
import time
import tomllib

import numpy as np
import pandas as pd
import pytest

from jaxphoto.errors import InputError, JaxphotoError, quoted, shown
from jaxphoto.io import read_block, recipe_from
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.io.draws_folder import DrawsFolder
from jaxphoto.io.json_file import read_json
from jaxphoto.io.names import harm_in
from jaxphoto.io.trajectory import read_records
from jaxphoto.io.whole_text import read_text, read_whole
from jaxphoto.simulation import visibility
from jaxphoto.simulation.flight_plan import Footprint, Strip, Swaths
from tests.io import test_cameras as cameras
from tests.io.test_map_block import to_utm
from tests.mutations import SUMMARY
from tests.simulation.small import RECIPES, changed, made


def refused(read, *words) -> str:
    """The sentence with which `read` refuses, in less than a few seconds."""
    began = time.perf_counter()
    with pytest.raises(JaxphotoError) as caught:
        read()
    said = str(caught.value)
    assert time.perf_counter() - began < 5
    assert len(said) < 1500 and said.isprintable()
    for word in words:
        assert word in said, said
    return said


# Files ------------------------------------------------------------------------------------------------------


def test_only_files_that_end_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "large").write_bytes(b"x" * 101)
    for place, words in (
        (tmp_path / "pipe", "is a pipe or a device; name a file"),
        (tmp_path, "is a folder; name a file"),
        (tmp_path / "none", "there is no file"),
        (tmp_path / "large" / "below", "there is no file"),
        (tmp_path / "\0", "no file can be called"),
        (tmp_path / "large", "has more than the 0.0001 MB"),
    ):
        refused(lambda place=place: read_whole(place, 100), words)
    refused(lambda: read_records(tmp_path / "pipe"), "pipe")
    assert read_whole(tmp_path / "large", 101) == b"x" * 101


def test_text_has_any_line_ends_and_no_mark(tmp_path):
    (tmp_path / "a").write_bytes("\ufeffö\r\nb\rc\n".encode())
    assert read_text(tmp_path / "a", 100) == "ö\nb\nc\n"
    (tmp_path / "a").write_bytes(b"a\nb\n\xff\n")
    refused(lambda: read_text(tmp_path / "a", 100), "a, row 3", "UTF-8")


def test_a_block_names_its_trajectory_by_a_path_that_ends(write_folder):
    for name, words in (("/dev/zero", "device"), ("\\u0000", "no file can be called"), ("..", "folder")):
        toml = ("block.toml", "[sigmas]", f'[trajectory]\nfile = "{name}"\n[sigmas]')
        folder = write_folder(toml)
        refused(lambda folder=folder: read_block(folder), words)
        folder.rename(folder.with_name(f"done{len(name)}"))


# TOML and JSON ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 5000, "[1]", '{"a": ', "\xff"])
def test_json_is_bounded(tmp_path, text):
    (tmp_path / "a.json").write_text(text, encoding="latin-1")
    refused(lambda: read_json(tmp_path / "a.json"), "a.json")


@pytest.mark.parametrize(
    "number", ["1e400", "1e31", "-inf", "nan", "true", "9" * 18 + "0" * 20, '"1"'], ids=lambda n: n[:8]
)
def test_numbers_of_settings_are_those_of_something_measured(write_folder, number):
    folder = write_folder(("block.toml", "c_mm = 5.0", f"c_mm = {number}"))
    refused(lambda: read_block(folder), "block.toml")


# Tables -----------------------------------------------------------------------------------------------------


def test_names_of_every_language_and_signed_numbers_are_names():
    good = ["-1", "+5", "-1.5", "+a_b", "日本", "Straße 3", "ف ا", "a=b", "x@y", "$1$", "[/red]", "p-1", "É", ""]
    assert [harm_in(name) for name in good] == [""] * len(good)


def test_a_map_frame_needs_no_angle(write_folder):
    """An orientation without phi is incomplete and not used, as in a local frame."""
    folder = to_utm(write_folder())
    table = pd.read_csv(folder / "images.csv").drop(columns="phi_deg")
    table.to_csv(folder / "images.csv", index=False)
    with pytest.warns(UserWarning, match="the approximate orientation of 2 image"):
        assert not read_block(folder).start.image_known.any()


def test_height_control_without_columns_of_x_and_y_is_converted(write_folder):
    """Only Z_m is there: it comes into the local frame with the approximate X and Y, not as it stands."""
    folder = to_utm(write_folder())
    whole = read_block(folder)
    table = pd.read_csv(folder / "control_points.csv").drop(columns=["X_m", "Y_m", "sigma_X_m", "sigma_Y_m"])
    table[table["point"] == "p2"].to_csv(folder / "control_points.csv", index=False)
    block = read_block(folder)
    (value,) = np.asarray(block.control.value)
    (before,) = np.asarray(whole.control.value)[(whole.control.who == 1) & (whole.control.axis == 2)]
    origin = np.asarray(whole.frame.origin) - np.asarray(block.frame.origin)
    assert np.abs(origin).max() < 1e-3 and abs(value - before) < 1e-3 and abs(value - 4.0) > 1e-9


# Cameras ----------------------------------------------------------------------------------------------------


def test_a_report_of_many_digits_is_read_in_time(tmp_path):
    for text in (
        cameras.SMAC.replace("153.358", "1" * 5000),
        cameras.SMAC.replace(" mm", " ", 1) + "9" * 50_000,
        "calibrated focal length K1 " * 5_000,
        "calibrated focal length K1 " + "x 10 " * 20_000,
        "calibrated focal length" + " K1 = = " * 5_000 + "1.5 " * 5_000,
    ):
        refused(lambda text=text: read_camera_file(cameras.written(tmp_path, text, "a.txt")), "a.txt")


def test_cameras_of_impossible_sizes_and_ids(tmp_path):
    big = cameras.OPENCV.replace("1280", "9" * 30)
    refused(lambda: read_camera_file(cameras.written(tmp_path, big, "a.yml")), "a.yml")
    line = "9" * 5000 + " PINHOLE 3072 2304 2560.56 2561.56 1530.5 1158.25\n"
    refused(lambda: read_camera_file(cameras.written(tmp_path, line, "cameras.txt")), "cameras.txt", "no id")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("4500", '"wide"'),
        ("4500", "-1"),
        ("4500", "1e400"),
        ("0.008", "null"),
        ('"add"', "[]"),
        ('{"width', '[{"width'),
    ],
)
def test_a_summary_of_other_content_says_nothing_of_a_camera(tmp_path, old, new):
    (tmp_path / "interior.csv").write_text(cameras.INTERIOR)
    (tmp_path / "summary.json").write_text(SUMMARY.replace(old, new))
    refused(lambda: read_camera_file(tmp_path), "interior.csv", "give the block")


# Recipes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("recipe", "changes"),
    [
        ("000", {"points.ties": 10**9}),
        ("000", {"flight.strips.0.images": 10**9}),
        ("000", {"flight.strips.0.count": 10**9}),
        ("000", {"flight.strips.0.images": 19_000, "points.ties": 4_000_000}),
        ("000", {"targets.0.count": 10**12}),
        ("002", {"targets.0.grid": [100_000, 100_000]}),
        ("002", {"convergent.stations.0.azimuth_deg": [0.0] * 500, "convergent.stations.0.distance_m": [1.0] * 500}),
        ("000", {"terrain": {"kind": "random", "count": 10**9, "rms_m": 1.0, "length_m": 1.0}}),
        ("000", {"terrain": {"buildings": [{"count": 10**9}]}}),
    ],
)
def test_recipes_ask_for_what_a_computer_holds(recipe, changes):
    values = changed(changes, tomllib.loads((RECIPES / f"{recipe}.toml").read_text()))
    refused(lambda: recipe_from(values))


def test_places_in_strips_that_are_far_apart_end():
    strips = tuple(Strip(str(k), "c", 0.0, 2, 1.0, 1.0, Footprint(1.0, 1.0), across_m=1e9 * k) for k in range(2))
    refused(lambda: Swaths(strips).draw(np.random.default_rng(0), 3), "far apart")


def test_points_looked_at_in_parts_are_the_same(monkeypatch):
    whole = made().block.image_points
    monkeypatch.setattr(visibility, "_PAIRS", 100)
    parts = made().block.image_points
    np.testing.assert_array_equal(whole.image, parts.image)
    np.testing.assert_array_equal(whole.point, parts.point)
    np.testing.assert_array_equal(whole.xy, parts.xy)


# Draws and messages -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("spoil", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:200] + b"\0" * 20 + b[220:]])
def test_a_part_that_is_damaged_is_named_and_made_anew(tmp_path, spoil):
    table = pd.DataFrame({"draw": np.arange(100), "converged": [True] * 100, "c_mm": np.linspace(0, 1, 100)})
    run = DrawsFolder(tmp_path / "run", {}, 200, 100)
    run.write_part(0, table)
    (part,) = (tmp_path / "run" / "parts").iterdir()
    part.write_bytes(spoil(part.read_bytes()))
    said = refused(lambda: (run.next_part, run.read(["draw", "converged", "c_mm"])), "is damaged", "delete it")
    assert part.name in said
    part.unlink()
    assert run.next_part == 0


def test_messages_are_short_printable_and_keep_place_and_mend():
    said = str(InputError(f"a.csv, row 3: the cell {'x' * 10**6} \x1b[31m is\nbad; correct it"))
    assert len(said) < 1500 and said.isprintable()
    assert said.startswith("a.csv, row 3: the cell") and said.endswith("correct it") and "\\x1b" in said
    assert shown("plain, ö, 日本") == "plain, ö, 日本"
    assert len(quoted("x" * 10**6)) < 120 and len(quoted([[1] * 1000] * 1000)) < 1000
