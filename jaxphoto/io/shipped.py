"""Examples and experiments distributed with jaxphoto: inside the package of a wheel, or at the root of a clone."""

from pathlib import Path

from jaxphoto.errors import InputError

_PACKAGE = Path(__file__).resolve().parents[1]
EXAMPLES = {
    "cross_block": "a block to adjust: 31 images in two crossing pairs of strips, with control and check points",
    "recipe": "a recipe to simulate: two heights, a cross strip, boresight and shifts of strips",
    "boresight": "a recipe to simulate: a flight to estimate the misalignment between camera and IMU",
    "lidar": "a simulated flight of camera and lidar: block, cloud, trajectory, and the truth",
    "strips": "a simulated flight of overlapping strips of a scanner and a camera on one trajectory, all with errors",
    "photographs": "rendered photographs of a flight with positions in EXIF, and surveyed points with their marks",
    "board": "rendered photographs of a chessboard",
    "experiments": "the published experiments as runnable declarations",
}
"""Examples and their descriptions."""


def shipped(name: str) -> Path:
    """Return the path of an example, a file or folder. Raises InputError for an unknown name."""
    if name not in EXAMPLES:
        raise InputError(f"unknown example {name}; choose one of {', '.join(EXAMPLES)}")
    root = next((r for r in (_PACKAGE / "shipped", _PACKAGE.parent) if (r / "examples").is_dir()), None)
    if root is None:
        raise InputError("this installation has no examples: install jaxphoto from its wheel, or use a clone")
    if name == "experiments":
        return root / name
    folder = root / "examples"
    return folder / name if (folder / name).is_dir() else folder / f"{name}.toml"
