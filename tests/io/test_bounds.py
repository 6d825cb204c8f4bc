"""Limits of what is read: text, JSON, recipes that no computer holds, damaged draws, and lengths of messages."""

import numpy as np
import pandas as pd
import pytest

from jaxphoto.errors import BlockError, InputError, quoted, shown
from jaxphoto.io import read_block
from jaxphoto.io.draws_folder import DrawsFolder
from jaxphoto.io.text_files import read_bytes, read_json, read_text
from jaxphoto.simulation import points
from jaxphoto.simulation.plans import Footprint, Strip, Swaths
from tests.io.test_map_block import to_utm
from tests.simulation.small import made


def test_text_of_any_line_ends(tmp_path):
    path = tmp_path / "a"
    path.write_bytes("\ufeffö\r\nb\rc\n".encode())
    assert read_text(path) == "ö\nb\nc\n"
    path.write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match="a is a workbook"):
        read_text(path)
    path.write_bytes(b"a\0\xff\n")
    with pytest.raises(InputError, match="a is not a text file"):
        read_text(path)
    for text, encoding in (
        ("Höhe – 12 €", "cp1252"), ("Höhe 12 °", "latin-1"), ("Höhe ж", "utf-16"), ("Höhe ж", "utf-8"),
        ("\ufeffВысота", "utf-16-be"), ('<?xml version="1.0" encoding="cp1251"?><Высота/>', "cp1251"),
        ('<?xml version="1.0" encoding="unknown"?><Höhe/>', "cp1252"),
    ):  # fmt: skip
        path.write_bytes(text.encode(encoding))
        assert read_text(path) == text.removeprefix("\ufeff")
    for place, words in ((tmp_path, "is a folder"), (tmp_path / "none", "not found"), (path / "below", "not found")):
        with pytest.raises(InputError, match=words):
            read_bytes(place)


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 5000, "[1]", '{"a": '])
def test_json_without_an_object(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=r"a\.json"):
        read_json(tmp_path / "a.json")


def test_a_map_frame_needs_no_angle(write_folder):
    """An orientation without phi is incomplete and not used, as in a local frame."""
    folder = to_utm(write_folder())
    table = pd.read_csv(folder / "images.csv").drop(columns="phi_deg")
    table.to_csv(folder / "images.csv", index=False)
    with pytest.warns(UserWarning, match="the approximate orientation of 2 image"):
        assert not read_block(folder).start.image_known.any()


def test_height_control_without_columns_of_x_and_y_is_converted(write_folder):
    """Only Z_m is given: it is converted with the approximate X and Y."""
    folder = to_utm(write_folder())
    whole = read_block(folder)
    table = pd.read_csv(folder / "control_points.csv").drop(columns=["X_m", "Y_m", "sigma_X_m", "sigma_Y_m"])
    table[table["point"] == "p2"].to_csv(folder / "control_points.csv", index=False)
    block = read_block(folder)
    (value,) = np.asarray(block.control.value)
    (before,) = np.asarray(whole.control.value)[(whole.control.who == 1) & (whole.control.axis == 2)]
    origin = np.asarray(whole.frame.origin) - np.asarray(block.frame.origin)
    assert np.abs(origin).max() < 1e-3 and abs(value - before) < 1e-3 and abs(value - 4.0) > 1e-9


def test_distant_strips_are_refused():
    strips = tuple(Strip(str(k), "c", 0.0, 2, 1.0, 1.0, Footprint(1.0, 1.0), across_m=1e9 * k) for k in range(2))
    with pytest.raises(BlockError, match="far apart"):
        Swaths(strips).draw(np.random.default_rng(0), 3)


def test_visibility_computed_in_parts_is_the_same(monkeypatch):
    whole = made().block.image_points
    monkeypatch.setattr(points, "_PAIRS", 100)
    parts = made().block.image_points
    for name in ("image", "point", "xy"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))


@pytest.mark.parametrize("spoil", [lambda b: b[: len(b) // 2], lambda b: b[:200] + b"\0" * 20 + b[220:]])
def test_a_damaged_part_of_draws_is_named(tmp_path, spoil):
    table = pd.DataFrame({"draw": np.arange(100), "converged": [True] * 100, "c_mm": np.linspace(0, 1, 100)})
    run = DrawsFolder(tmp_path / "run", {}, 200, 100)
    run.write_part(0, table)
    (part,) = (tmp_path / "run" / "parts").iterdir()
    part.write_bytes(spoil(part.read_bytes()))
    with pytest.raises(InputError, match=rf"{part.name} is damaged: delete it"):
        _ = (run.missing_parts(), run.read(["draw", "converged", "c_mm"]))
    part.unlink()
    assert run.missing_parts() == [0, 1]


def test_messages_are_short_printable_and_keep_place_and_cure():
    message = str(InputError(f"a.csv, row 3: the cell {'x' * 10**6} \x1b[31m is\nbad; correct it"))
    assert len(message) < 1500 and message.isprintable()
    assert message.startswith("a.csv, row 3: the cell") and message.endswith("correct it") and "\\x1b" in message
    assert shown("plain, ö, 日本") == "plain, ö, 日本"
    assert len(quoted("x" * 10**6)) < 120 and len(quoted([[1] * 1000] * 1000)) < 1000
