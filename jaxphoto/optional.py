"""Optional dependencies: modules that an extra of jaxphoto installs."""

from collections.abc import Iterator
from contextlib import contextmanager

EXTRAS = {
    "laspy": "lidar", "lazrs": "lidar",
    "cv2": "photos", "pycolmap": "photos",
    "pyarrow": "parquet",
    "dask": "cluster", "distributed": "cluster",
}  # fmt: skip
"""Extra of jaxphoto that installs each optional module."""


class MissingExtra(ModuleNotFoundError):
    """Optional module that is not installed, and the command that installs it."""

    def __init__(self, module: str):
        super().__init__(f"{module} is not installed: pip install 'jaxphoto[{EXTRAS[module]}]'", name=module)


@contextmanager
def extra() -> Iterator[None]:
    """Import optional modules. Raises MissingExtra if one is not installed."""
    try:
        yield
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if module not in EXTRAS:
            raise
        raise MissingExtra(module) from None
