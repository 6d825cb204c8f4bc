"""How much a recipe may ask for: more than any block has, and not more than a computer can hold.

A simulation of the largest block takes some gigabytes and an hour; what is larger is a slip of the pen.
"""

from jaxphoto.errors import InputError

IMAGES = 20_000
POINTS = 5_000_000
PAIRS = 2_000_000_000
"""Of an image and a point, each of which is looked at."""
WAVES = 1_000
BUILDINGS = 10_000
"""Each is kept clear of all others."""
TREES = 1_000_000


def check_pairs(file: str, images: int, points: int) -> None:
    """Raise InputError where images times points would take too long."""
    if images * points > PAIRS:
        raise InputError(
            f"{file}, [points] ties: {images} images and {points} points make more than {PAIRS} pairs; ask for fewer"
        )
