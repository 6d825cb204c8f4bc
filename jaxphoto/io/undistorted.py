"""Resample photographs to a pinhole camera without distortion."""

import warnings
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
from jaxphoto.optional import extra
from jaxphoto.writing import whole_folder

with extra():
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

# Pillow modes that can be resampled.
_MODES = ("L", "RGB", "RGBA", "I;16")
_JPEG = (".jpg", ".jpeg")
_TIFF = (".tif", ".tiff")
_WAY = cv2.INTER_CUBIC
_QUALITY = 95
_TAG = ExifTags.Base


class Undistorted(NamedTuple):
    """Camera of the resampled photographs, and the reason for each skipped file."""

    camera: Pinhole
    left_out: dict[str, str]


def write_undistorted(
    photographs: Sequence[Photograph],
    camera: CameraFile,
    folder: Path,
    keep: Keep = "crop",
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Undistorted:
    """Resample `photographs` of `camera` without distortion into `folder`, and write camera.toml.

    Interpolation is bicubic (OpenCV, coordinates rounded to 1/32 px). Names, EXIF, XMP and colour profile are retained.
    JPEG has quality 95; TIFF is uncompressed (libtiff would remove its EXIF); other formats are converted to PNG.
    Pictures are read as stored, ignoring the orientation flag. `keep`: see `camera.undistortion.pinhole`.

    Photographs that are damaged or of different size are skipped and reported. Raises InputError if all are skipped,
    and for a camera without an equivalent pinhole.
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
            raise InputError(f"no photograph of camera {camera.name}: {next(iter(left.values()), 'none given')}")
        write_block_camera(work / CAMERA, camera.name, *new)
    return Undistorted(new, left)


def _read(path: Path, sensor: Sensor) -> tuple[np.ndarray, Image.Exif, dict[str, Any]]:
    """Read the pixels of a photograph (rows, columns, bands), its EXIF, and other metadata to retain."""
    # Do not use the pixels of Pillow, which rotates TIFFs by their orientation flag.
    try:
        with warnings.catch_warnings(action="ignore", category=NotGeoreferencedWarning), rasterio.open(path) as file:
            bands = file.read()
    except RasterioError as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:100]
        raise InputError(f"{path.name} cannot be read as a raster ({reason}); copy it again from its source") from None
    height, width = bands.shape[1:]
    if (width, height) != (sensor.width_px, sensor.height_px):
        rotated = (height, width) == (sensor.width_px, sensor.height_px)
        raise InputError(
            f"{path.name} has {width} x {height} pixels, but its camera {sensor.width_px} x {sensor.height_px}; name "
            f"{'the photograph before it was rotated' if rotated else 'another'}"
        )
    with Image.open(path) as picture:
        if picture.mode not in _MODES:
            known = ", ".join(_MODES)
            raise InputError(f"its pixels are {picture.mode}, but undistorted images are {known}; convert it to RGB")
        # Reject 16-bit colours: Pillow reads them as 8-bit, and cannot write them.
        if bands.dtype != np.uint8 and picture.mode != "I;16":
            raise InputError("16 bits per channel, but undistorted images have 8; convert it to 8 bits")
        kept: dict[str, Any] = {key: picture.info[key] for key in ("icc_profile", "xmp") if key in picture.info}
        if picture.format not in ("JPEG", "MPO"):
            kept.pop("xmp", None)
        exif = picture.getexif()
        for part in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
            exif.get_ifd(part)
    # cv2 requires contiguous rows.
    return np.ascontiguousarray(np.moveaxis(bands, 0, -1).squeeze()), exif, kept


def _write(pixels: np.ndarray, exif: Image.Exif, kept: dict[str, Any], path: Path, folder: Path) -> None:
    """Write the resampled photograph to `path`, and update the size in EXIF."""
    taken = exif.get_ifd(ExifTags.IFD.Exif)
    for tag, side in ((_TAG.ExifImageWidth, pixels.shape[1]), (_TAG.ExifImageHeight, pixels.shape[0])):
        if tag in taken:
            taken[tag] = side
    # Remove tags of the TIFF layout: the new file has its own.
    for layout in [tag for tag in exif if tag in _LAYOUT]:
        del exif[layout]
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
