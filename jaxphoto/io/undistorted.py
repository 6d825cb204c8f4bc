"""Photographs without distortion: resampled to a pinhole camera, which is written beside them."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from PIL import ExifTags, Image

from jaxphoto.camera import Sensor
from jaxphoto.camera.undistortion import Keep, Pinhole, pinhole, source_pixels
from jaxphoto.errors import InputError
from jaxphoto.io.camera_files import CAMERA, CameraFile, write_block_camera
from jaxphoto.io.photographs import Photograph
from jaxphoto.io.raster import read_photograph
from jaxphoto.writing import whole_folder

# Modes of Pillow that are resampled.
_MODES = ("L", "RGB", "RGBA", "I;16")
_JPEG = (".jpg", ".jpeg")
_TIFF = (".tif", ".tiff")
_WAY = cv2.INTER_CUBIC
_QUALITY = 95
_TAG = ExifTags.Base


class Undistorted(NamedTuple):
    """The camera of the new photographs, and why others were left out, by path."""

    camera: Pinhole
    left_out: dict[str, str]


def write_undistorted(
    photographs: Sequence[Photograph],
    camera: CameraFile,
    folder: Path,
    keep: Keep = "crop",
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Undistorted:
    """Write `photographs` of `camera` without distortion into `folder`, with camera.toml beside them.

    Resampled bicubically (OpenCV, places to 1/32 px). Names and EXIF, XMP and colour profile are kept; a JPEG is one of
    quality 95, a TIFF is not compressed (libtiff would lose its EXIF), what is neither JPEG, PNG nor TIFF becomes PNG.
    A picture is taken as it lies in the file, whatever its orientation flag. `keep`: see `camera.undistortion.pinhole`.

    Left out and told: photographs of another size than the camera's, and what is damaged. Raises InputError where none
    is left, and for a camera in whose place there is no pinhole.
    """
    try:
        new = pinhole(camera.sensor, camera.interior, keep)
    except ValueError as error:
        raise InputError(f"camera {camera.name}: {error}") from None
    places, left = source_pixels(camera.sensor, camera.interior, new), {}
    with whole_folder(folder) as work:
        for done, photograph in enumerate(photographs, 1):
            try:
                pixels, exif, kept = _read(photograph.path, camera.sensor)
            except InputError as error:
                left[str(photograph.path)] = f"{photograph.path}: {error}"
            else:
                straight = cv2.remap(pixels, *places, _WAY, borderMode=cv2.BORDER_CONSTANT)
                _write(straight, exif, kept, photograph.path, work)
            progress(done, len(photographs))
        if len(left) == len(photographs):
            raise InputError(f"no photograph is of camera {camera.name}: {next(iter(left.values()), 'there is none')}")
        write_block_camera(work / CAMERA, camera.name, *new)
    return Undistorted(new, left)


def _read(path: Path, sensor: Sensor) -> tuple[np.ndarray, Image.Exif, dict[str, Any]]:
    """The pixels of a photograph (rows, columns, bands), its EXIF, and what else is kept of it."""
    # Not Pillow's pixels: it turns a TIFF by its orientation flag.
    bands = read_photograph(path, sensor)
    with Image.open(path) as picture:
        if picture.mode not in _MODES:
            known = ", ".join(_MODES)
            raise InputError(f"its pixels are {picture.mode}, and undistorted are {known}; convert it to RGB")
        # Pillow reads colours of 16 bits as 8, and cannot write them.
        if bands.dtype != np.uint8 and picture.mode != "I;16":
            raise InputError("its colours have 16 bits, and undistorted are those of 8; convert it to 8 bits")
        kept: dict[str, Any] = {key: picture.info[key] for key in ("icc_profile", "xmp") if key in picture.info}
        if picture.format not in ("JPEG", "MPO"):
            kept.pop("xmp", None)
        exif = picture.getexif()
        for part in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
            exif.get_ifd(part)
    # cv2 asks for rows that lie in one piece.
    return np.ascontiguousarray(np.moveaxis(bands, 0, -1).squeeze()), exif, kept


def _write(pixels: np.ndarray, exif: Image.Exif, kept: dict[str, Any], path: Path, folder: Path) -> None:
    """Write the new photograph in place of `path`, EXIF with its size."""
    taken = exif.get_ifd(ExifTags.IFD.Exif)
    for tag, side in ((_TAG.ExifImageWidth, pixels.shape[1]), (_TAG.ExifImageHeight, pixels.shape[0])):
        if tag in taken:
            taken[tag] = side
    # Of the layout of a TIFF, which the new one has of its own.
    for own in [tag for tag in exif if tag in _LAYOUT]:
        del exif[own]
    suffix = path.suffix.lower()
    name = path.name if suffix in (*_JPEG, *_TIFF, ".png") else f"{path.stem}.png"
    options: dict[str, Any] = {"quality": _QUALITY, "subsampling": 0} if suffix in _JPEG else {}
    options |= kept | ({"exif": exif.tobytes()} if len(exif) else {})
    Image.fromarray(pixels).save(folder / name, **options)


_LAYOUT = {
    _TAG.ImageWidth, _TAG.ImageLength, _TAG.BitsPerSample, _TAG.Compression, _TAG.PhotometricInterpretation,
    _TAG.StripOffsets, _TAG.SamplesPerPixel, _TAG.RowsPerStrip, _TAG.StripByteCounts, _TAG.PlanarConfiguration,
    _TAG.TileWidth, _TAG.TileLength, _TAG.TileOffsets, _TAG.TileByteCounts, _TAG.Predictor, _TAG.ColorMap,
    _TAG.ExtraSamples, _TAG.SampleFormat, _TAG.JPEGTables,
}  # fmt: skip
