"""When photographs were taken, by the clock of the camera: EXIF to the second, or finer where it notes that."""

from collections.abc import Sequence
from datetime import datetime

from PIL import ExifTags, Image

from jaxphoto.io.photographs import Photograph
from jaxphoto.procedures.rolling_shutter import Moment

_EPOCH = datetime(1980, 1, 6)
_TAG = ExifTags.Base


def photograph_seconds(photographs: Sequence[Photograph]) -> dict[str, Moment]:
    """Seconds since 1980-01-06 on the camera's clock, and the step it counts in, by name; none where EXIF has none."""
    found = {p.name: _moment(p) for p in photographs}
    return {name: moment for name, moment in found.items() if moment is not None}


def _moment(photograph: Photograph) -> Moment | None:
    try:
        with Image.open(photograph.path) as picture:
            exif = picture.getexif().get_ifd(ExifTags.IFD.Exif)
        clock = datetime.strptime(str(exif.get(_TAG.DateTimeOriginal))[:19], "%Y:%m:%d %H:%M:%S")
    except Exception:
        # Damaged EXIF raises whatever the reader meets in it; a photograph without time is none that tells a motion.
        return None
    seconds, digits = (clock - _EPOCH).total_seconds(), str(exif.get(_TAG.SubsecTimeOriginal, "")).strip("\0 ")
    if not (digits.isascii() and digits.isdigit() and len(digits) < 10 and int(digits)):
        return seconds, 1.0
    return seconds + int(digits) / 10 ** len(digits), 10.0 ** -len(digits)
