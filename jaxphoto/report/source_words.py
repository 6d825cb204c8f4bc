"""Where a block of another program is from, and what was assumed of it, in words."""

from collections.abc import Iterable, Mapping

from jaxphoto.block import Block
from jaxphoto.camera import Sensor
from jaxphoto.report.document import Paragraph


def report_title(block: Block) -> str:
    """The title of the block, and what it was converted from."""
    title = block.title or "jaxphoto adjustment"
    return f"{title}, converted from {block.converted_from}" if block.converted_from else title


def assumed_pixels(sensors: Mapping[str, Sensor]) -> Iterable[Paragraph]:
    """The sentence about cameras whose pixel was assumed, where there are such."""
    return [Paragraph(words)] if (words := assumed_pixel_words(sensors)) else []


def assumed_pixel_words(sensors: Mapping[str, Sensor]) -> str:
    """A sentence about cameras whose pixel was assumed; "" where there is none."""
    cameras = [name for name, sensor in sensors.items() if sensor.pixel_assumed]
    if not cameras:
        return ""
    size = sensors[cameras[0]].pixel_mm
    whose = "of every camera" if len(cameras) == len(sensors) else f"of {', '.join(cameras)}"
    return (
        f"The size of a pixel {whose} is not known: {size:g} mm is assumed. c, the principal point and all else that "
        "is in mm or its powers scale with it; numbers in pixels, and all on the ground, do not."
    )
