"""`jaxphoto fly`: a folder of photographs to blocks, results and a page; two parts, spoilt files, a wrong position."""

import json

import cv2
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from jaxphoto.extras.photos.rendered_photographs import SENSOR, ground_texture
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.io import read_block
from jaxphoto.procedures.georeference_photographs import utm_of
from tests.commands import run
from tests.photos.ground import photograph

ORIGIN = (13.2, 55.7, 0.0)
PIXEL_MM, C_MM = SENSOR.pixel_mm, 3.6
HEIGHT_M = 60.0
SIGMA_M = 0.03
RTK = '<rdf:Description drone-dji:RtkFlag="50"' + "".join(
    f' drone-dji:RtkStd{axis}="{SIGMA_M}"' for axis in ("Lon", "Lat", "Hgt")
)


def with_position(path, place):
    """The picture as a JPEG with a position in its EXIF."""
    exif = Image.Exif()
    longitude, latitude, height = place
    parts = [(int(v), int(v % 1 * 60), v * 60 % 1 * 60) for v in (latitude, longitude)]
    exif.get_ifd(0x8825).update({1: "N", 2: parts[0], 3: "E", 4: parts[1], 5: b"\0", 6: height})
    Image.open(path).save(path.with_suffix(".jpg"), quality=97, exif=exif, xmp=RTK.encode())
    path.unlink()


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Twelve photographs of one place, from three heights and turned, three of another, and what is spoilt."""
    folder, rng = tmp_path_factory.mktemp("flown"), np.random.default_rng(4)
    frame = MapFrame(utm_of(*ORIGIN[:2]), None, ORIGIN)
    for name, far, number in (("a", 0.0, 12), ("b", 5000.0, 3)):
        ground = ground_texture(rng, 2400).astype(np.float32)
        for k in range(number):
            at = np.array([14.0 * (k % 4) - 21, 14.0 * (k // 4) - 14, HEIGHT_M + 8 * (k % 3)])
            angles = (*rng.uniform(-14, 14, 2), 90.0 * (k % 4))
            photograph(folder / f"{name}{k:02}.png", ground, at, angles, rng)
            recorded = at + rng.normal(0, SIGMA_M, 3) + [far, 0, 0] + (40.0 if (name, k) == ("a", 5) else 0.0)
            with_position(folder / f"{name}{k:02}.png", frame.place(frame.map(recorded[None]))[0])
    whole = (folder / "a03.jpg").read_bytes()
    (folder / "cut.jpg").write_bytes(whole[:20_000])
    cv2.imwrite(str(folder / "blank.png"), np.full((SENSOR.height_px, SENSOR.width_px), 90, np.uint8))
    return folder


@pytest.mark.slow
def test_a_folder_becomes_blocks_results_and_a_page(flown, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    given = ("--c-mm", 3.7, "--pixel-mm", PIXEL_MM, "--features", 500)
    _, said, wrong = run(monkeypatch, capsys, "fly", flown, "--out", out, *given)
    assert "cut.jpg: the image is cut off or damaged" in wrong
    assert "the position of a05 differs by" in said
    assert said.count("estimates (a posteriori") == 2 and said.count("sigma0 ") == 2
    summary = json.loads((out / "summary.json").read_text())
    assert [p["n_images"] for p in summary["parts"]] == [12, 3]
    assert summary["parts"][0]["positions_left_out"] == ["a05"]
    assert any("cut.jpg" in name for name in summary["not_used"]) and "blank" in summary["not_used"]
    assert "blank" in summary["positions_from"][0]
    assert summary["positions_from"][-1] == "heights are above the ellipsoid"
    images = pd.read_csv(out / "images.csv")
    assert len(images) == 15 and (images["rms_px"] < 1).all()
    # The folder knows its blocks and the files of its photographs.
    assert run(monkeypatch, capsys, "convert", out, tmp_path / "sfm", "--to", "opensfm")[0] == 0
    shots = json.loads((tmp_path / "sfm" / "reconstruction.json").read_text())[0]["shots"]
    assert set(shots) == {f"a{k:02}.jpg" for k in range(12)}
    # What was written can be adjusted again: the largest part, with its stations, in the map system.
    block = read_block(out / "block")
    assert block.frame.code == utm_of(*ORIGIN[:2]) and len(block.stations) == 33
    interior = pd.read_csv(out / "result" / "interior.csv").set_index("parameter")
    assert abs(interior.loc["c_mm", "value"] - C_MM) < 4 * interior.loc["c_mm", "sigma"] + 0.01
    page = (out / "report.html").read_text()
    for part in ("a05", "blank", "cut.jpg", "result/report.html", "result_2/report.html", "2 blocks of 12, 3"):
        assert part in page
    assert (out / "result_2" / "report.html").is_file() and (out / "block_2" / "block.toml").is_file()


def test_options_that_cannot_be(flown, tmp_path, monkeypatch, capsys):
    for arguments, message in (
        (["--epsg", 99], "EPSG code 99 is unknown"),
        (["--epsg", "25832+"], "--epsg 25832+: give the code"),
        (["--epsg", "4326"], "(WGS 84) is longitude and latitude; give a map system in metres"),
        (["--epsg", "25832+4326"], "EPSG:4326 (WGS 84) is not a vertical CRS"),
        (["--model", "pinhole"], "pinhole"),
        (["--pairs", "position:3"], "have no GPS position"),
        (["--lever-arm", "0,1"], "--lever-arm 0,1: give three numbers in metres"),
        (["--heights", "ground"], "--heights ground: give ellipsoid, geoid, take-off"),
        (["--exposures", tmp_path / "absent.MRK"], "absent.MRK; add it, or correct the name"),
    ):
        code, _, wrong = run(monkeypatch, capsys, "fly", flown, "--out", tmp_path / "o", *arguments)
        assert code == 2 and message in wrong and not (tmp_path / "o").exists()


def test_no_result_takes_the_place_of_a_file_of_exposures(flown, tmp_path, monkeypatch, capsys):
    out = tmp_path / "o"
    (out / "told").mkdir(parents=True)
    table = out / "told" / "exposures.csv"
    table.write_text("image,longitude_deg,latitude_deg,height_m\n")
    for folder in (out, table):
        code, _, wrong = run(monkeypatch, capsys, "fly", flown, "--out", folder, "--exposures", table)
        assert code == 2 and "exposures.csv, which would be lost" in wrong and table.is_file()
