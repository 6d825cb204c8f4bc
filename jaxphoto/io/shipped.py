"""Examples and experiments that come with jaxphoto: in a wheel beside its modules, in a clone at its root."""

from pathlib import Path

from jaxphoto.errors import InputError

_PACKAGE = Path(__file__).resolve().parents[1]
EXAMPLES = {
    "cross_block": "a block to adjust: 31 images in two crossing pairs of strips, with control and check points",
    "recipe": "a recipe to simulate: two heights, a cross strip, boresight and shifts of strips",
    "boresight": "a recipe to simulate: a flight to find the misalignment of a camera beside an IMU",
    "lidar": "a simulated flight of camera and lidar: block, cloud, trajectory, and the truth",
    "strips": "a simulated flight of overlapping strips of a scanner and a camera on one trajectory, all of them wrong",
    "experiments": "the published experiments as runnable declarations",
}
"""Examples and their descriptions."""


def shipped(name: str) -> Path:
    """Path of an example, a file or folder. Raises InputError for an unknown name."""
    if name not in EXAMPLES:
        raise InputError(f"there is no example {name}; there are {', '.join(EXAMPLES)}")
    root = next((r for r in (_PACKAGE / "shipped", _PACKAGE.parent) if (r / "examples").is_dir()), None)
    if root is None:
        raise InputError("this installation came without its examples: install jaxphoto from its wheel, or use a clone")
    if name == "experiments":
        return root / name
    folder = root / "examples"
    return folder / name if (folder / name).is_dir() else folder / f"{name}.toml"
