"""The grey values of a photograph, whatever kind of picture its file holds."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxphoto.errors import InputError
from jaxphoto.io.photographs import photographs

_FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def read_grey(path: str | Path) -> UInt8[np.ndarray, "rows columns"]:
    """The grey values of a photograph, 0 to 255, as they lie in the file: no note of the camera about turning counts.

    Colours, palettes and CMYK become grey; transparency is not looked at. Values of more than 8 bits are divided by the
    power of two with which the brightest still fits: what 12 bits of 16 hold keeps its contrast.
    Raises InputError for a file that is missing, is no picture or is cut off, for one that is far too small for the
    size it says, and for values that are no whole numbers from 0.
    """
    path = Path(path)
    # Pillow's judgement first: OpenCV takes room for whatever a damaged file says.
    photographs([path])
    try:
        picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), _FLAGS)
    except (OSError, cv2.error):  # OpenCV's where the file is empty or the picture too large
        picture = None
    if picture is None:
        raise InputError(f"{path}: this is no picture that OpenCV can read, or it is cut off; give a TIFF, PNG or JPEG")
    if picture.dtype == np.uint8:
        return picture
    if picture.dtype.kind not in "iu" or picture.min() < 0:
        raise InputError(f"{path}: its grey values are {picture.dtype}; give a picture of 8 or 16 bits, from 0 up")
    return np.right_shift(picture, max(0, int(picture.max()).bit_length() - 8)).astype(np.uint8)
