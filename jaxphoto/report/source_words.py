"""Where a block of another program is from, and what was assumed of it, in words."""

from jaxphoto.block import Block


def report_title(block: Block) -> str:
    """The title of the block, and what it was converted from."""
    title = block.title or "jaxphoto adjustment"
    return f"{title}, converted from {block.converted_from}" if block.converted_from else title


def assumed_pixel_words(block: Block) -> str:
    """A sentence about cameras whose pixel was assumed; "" where there is none."""
    cameras = [name for name in block.assumed_pixels if name in block.sensors]
    if not cameras:
        return ""
    size = block.sensors[cameras[0]].pixel_mm
    whose = "of every camera" if len(cameras) == len(block.sensors) else f"of {', '.join(cameras)}"
    return (
        f"The size of a pixel {whose} is not known: {size:g} mm is assumed. c, the principal point and all else that "
        "is in mm or its powers scale with it; numbers in pixels, and all on the ground, do not."
    )
