"""Undistorted photographs: a picture that is a function of the ray is the same function of the ray afterwards."""

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from jaxphoto.camera import Brown, Equidistant, InteriorOrientation, OpenCv, OpenCvFisheye, Sensor
from jaxphoto.camera.undistortion import pinhole, source_pixels
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import write_camera_file
from jaxphoto.io.camera_files import CameraFile, read_camera_file
from jaxphoto.io.photographs import photographs
from jaxphoto.io.undistorted import write_undistorted
from tests.commands import run

SENSOR = Sensor(360, 270, 0.01)
BARREL = InteriorOrientation(3.0, 0.05, -0.03, Brown(k1=-0.02, k2=1e-3, p1=1e-3))
EXIF = ExifTags.Base


def grey(u, v):
    """Brightness of a direction (u, v, -1), 90 to 165: a period of some forty pixels, seven a pixel at most."""
    return 127.5 + 37.5 * np.sin(60 * u + 0.3) * np.cos(50 * v)


def centres_mm(sensor):
    """x and y of the centres of all pixels."""
    columns, rows = np.meshgrid(np.arange(sensor.width_px) + 0.5, np.arange(sensor.height_px) + 0.5)
    return (columns - sensor.width_px / 2) * sensor.pixel_mm, (sensor.height_px / 2 - rows) * sensor.pixel_mm


def taken():
    """What `BARREL` sees of `grey`, by Brown's formula: ideal = measured - distortion."""
    x, y = centres_mm(SENSOR)
    x, y, d = x - BARREL.x_p, y - BARREL.y_p, BARREL.distortion
    r2 = x * x + y * y
    q = d.k1 * r2 + d.k2 * r2 * r2
    ideal_x = x - x * q - d.p1 * (r2 + 2 * x * x)
    ideal_y = y - y * q - 2 * d.p1 * x * y
    return grey(ideal_x / BARREL.c, ideal_y / BARREL.c)


def expected(camera):
    x, y = centres_mm(camera.sensor)
    c = float(camera.interior.c)
    return grey((x - float(camera.interior.x_p)) / c, (y - float(camera.interior.y_p)) / c)


def saved(folder, name, mode="RGB", **options):
    values = np.rint(taken() * (256 if mode == "I;16" else 1)).astype(np.uint16 if mode == "I;16" else np.uint8)
    picture = Image.fromarray(values)
    folder.mkdir(exist_ok=True)
    (picture.convert(mode) if mode not in ("L", "I;16") else picture).save(folder / name, **options)
    return folder / name


@pytest.mark.parametrize("keep", ["crop", "all"])
def test_every_pixel_sees_what_its_ray_sees(tmp_path, keep):
    paths = [saved(tmp_path, "a.png", "L"), saved(tmp_path, "b.tif", "I;16"), saved(tmp_path, "c.jpg", quality=100)]
    done = write_undistorted(photographs(paths), CameraFile("one", SENSOR, BARREL), tmp_path / "out", keep)
    truth = expected(done.camera)
    column, row = source_pixels(SENSOR, BARREL, done.camera)
    inside = (column >= 1) & (column <= SENSOR.width_px - 2) & (row >= 1) & (row <= SENSOR.height_px - 2)
    for name, scale, most in (("a.png", 1, 1.6), ("b.tif", 256, 0.5), ("c.jpg", 1, 4.5)):
        values = np.asarray(Image.open(tmp_path / "out" / name), float) / scale
        off = (values if values.ndim == 2 else values[..., 1]) - truth
        # Half a pixel aside would be 3.7, 1.9 RMS; rounding of bytes, read and written, comes to 1.3, JPEG to more.
        assert np.abs(off[inside]).max() < most and np.sqrt(np.mean(off[inside] ** 2)) < 0.7
        assert abs(off[inside].mean()) < 0.05
        if keep == "all":
            assert (values[0, values.shape[1] // 2] == 0).all()
    if keep == "crop":
        assert column.min() > 0 and column.max() < SENSOR.width_px - 1
        assert row.min() > 0 and row.max() < SENSOR.height_px - 1
    read = read_camera_file(tmp_path / "out")
    assert read.sensor == done.camera.sensor and read.interior.c == BARREL.c
    assert read.interior.x_p == done.camera.interior.x_p


def test_crop_is_filled_and_all_has_everything():
    """By sight of the four corners and sides of the given format, whose places in the new one are known."""
    x, y = (
        np.array(v)
        for v in zip(*[(-1.8, 1.35), (1.8, 1.35), (1.8, -1.35), (-1.8, -1.35), (0, 1.35), (-1.8, 0)], strict=True)
    )
    x, y, d = x - BARREL.x_p, y - BARREL.y_p, BARREL.distortion
    r2 = x * x + y * y
    q = d.k1 * r2 + d.k2 * r2 * r2
    ideal = np.stack([x - x * q - d.p1 * (r2 + 2 * x * x), y - y * q - 2 * d.p1 * x * y], axis=1)
    for keep, inside in (("crop", False), ("all", True)):
        sensor, interior = pinhole(SENSOR, BARREL, keep)
        px = sensor.px_from_mm(ideal + np.array([float(interior.x_p), float(interior.y_p)]))
        held = (px > -1e-6).all(axis=1) & (px < np.array([sensor.width_px, sensor.height_px]) + 1e-6).all(axis=1)
        # Corners of a barrel lie outside of what it fills, and make what holds it.
        assert held[:4].all() == inside and not (held[:4].any() and not inside)


def test_exif_is_kept_with_the_new_size(tmp_path):
    exif = Image.Exif()
    exif[EXIF.Make], exif[EXIF.Orientation] = "Maker", 6
    exif.get_ifd(ExifTags.IFD.Exif).update({EXIF.ExifImageWidth: 360, EXIF.ExifImageHeight: 270, EXIF.FocalLength: 3.0})
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({1: "N", 2: (55.0, 30.0, 0.0), 3: "E", 4: (13.0, 0.0, 0.0)})
    path = saved(tmp_path, "a.jpg", exif=exif, xmp=b"<x/>", icc_profile=b"profile")
    exif[EXIF.Orientation] = 1
    other = saved(tmp_path, "b.tif", exif=exif.tobytes())
    camera = write_undistorted(photographs([path, other]), CameraFile("one", SENSOR, BARREL), tmp_path / "out").camera
    for name, flag in (("a.jpg", 6), ("b.tif", 1)):
        (read,) = photographs([tmp_path / "out" / name])
        assert (read.make, read.orientation, read.focal_length_mm) == ("Maker", flag, 3.0)
        assert (read.width_px, read.height_px) == (camera.sensor.width_px, camera.sensor.height_px)
        assert read.gps is not None and read.gps.latitude_deg == 55.5
        with Image.open(tmp_path / "out" / name) as picture:
            taken = picture.getexif().get_ifd(ExifTags.IFD.Exif)
            assert (taken[EXIF.ExifImageWidth], taken[EXIF.ExifImageHeight]) == picture.size
    with Image.open(tmp_path / "out" / "a.jpg") as picture:
        assert (picture.info["xmp"], picture.info["icc_profile"]) == (b"<x/>", b"profile")


def test_the_command_leaves_out_what_is_not_of_the_camera(tmp_path, monkeypatch, capsys):
    for name, options in (("a.png", {}), ("b.png", {"compress_level": 1}), ("c.jpg", {})):
        saved(tmp_path / "given", name, **options)
    Image.new("RGB", (100, 100)).save(tmp_path / "given" / "small.png")
    cv2.imwrite(str(tmp_path / "given" / "deep.png"), np.zeros((270, 360, 3), np.uint16))
    cut = saved(tmp_path / "given", "cut.png")
    cut.write_bytes(cut.read_bytes()[:5000])
    write_camera_file(tmp_path / "camera.toml", SENSOR, BARREL, name="one")
    given = ("--camera", tmp_path / "camera.toml", "--out", tmp_path / "out")
    code, said, wrong = run(monkeypatch, capsys, "undistort", tmp_path / "given", *given)
    assert code == 1 and "3 photographs of " in said
    assert "small.png: its size is 100 x 100 px" in wrong and "cut.png: " in wrong
    assert f"skipped: {tmp_path / 'given' / 'deep.png'}: 16 bits per channel" in wrong
    assert {p.name for p in (tmp_path / "out").iterdir()} >= {"a.png", "b.png", "c.jpg", "camera.toml"}
    for arguments, message in (
        ((tmp_path / "given", *given[:3], tmp_path / "no", "--keep", "most"), "'most' is not one of 'crop', 'all'"),
        (
            (tmp_path / "given" / "small.png", *given[:3], tmp_path / "no"),
            "has 100 x 100 pixels, but its camera 360 x 270",
        ),
    ):
        code, _, wrong = run(monkeypatch, capsys, "undistort", *arguments)
        assert code == 2 and message in wrong and not (tmp_path / "no").exists()


def test_there_is_not_always_a_pinhole(tmp_path):
    wide = InteriorOrientation(1.0, 0.0, 0.0, OpenCvFisheye(), projection=Equidistant())
    with pytest.raises(ValueError, match="sees directions 90 degrees or more from its axis"):
        pinhole(SENSOR, wide)
    with pytest.raises(ValueError, match=r"keep only what fills them \(crop\)"):
        pinhole(SENSOR, InteriorOrientation(1.5, 0.0, 0.0, OpenCvFisheye(), projection=Equidistant()), "all")
    folding = InteriorOrientation(3.0, 0.0, 0.0, OpenCv(k1=-1.5))
    with pytest.raises(InputError, match="camera one: at the border of its format"):
        write_undistorted([], CameraFile("one", SENSOR, folding), tmp_path / "out")
