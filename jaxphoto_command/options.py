"""Options shared by several commands, and checks of option values."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Argument, Option


def positive(context: typer.Context, value: float | None) -> float | None:
    """Raise BadParameter unless a value is positive and finite."""
    if value is not None and not 0 < value < math.inf:
        raise typer.BadParameter(f"{value:g} is not a positive number.")
    return value


def finite(context: typer.Context, value: float) -> float:
    """Raise BadParameter unless a value is finite."""
    if not math.isfinite(value):
        raise typer.BadParameter(f"{value:g} is not a finite number.")
    return value


def names(text: str | None) -> list[str]:
    """Split comma-separated names."""
    return [name.strip() for name in (text or "").split(",") if name.strip()]


def pair(option: str, text: str, example: str) -> tuple[float, float]:
    """Parse two positive numbers such as `15x11`."""
    try:
        first, second = (float(part) for part in text.lower().split("x"))
    except ValueError:
        first = second = math.nan
    if not (0 < first < math.inf and 0 < second < math.inf):
        raise typer.BadParameter(f"{option} {text}: give two positive numbers with an x between them, like {example}.")
    return first, second


def grid_points(sensor: Any, grid: str, extent: str | None) -> Any:
    """Return the image points (mm) of --grid and --extent."""
    from jaxphoto.stability import image_grid

    columns, rows = pair("--grid", grid, "15x11")
    if columns != int(columns) or rows != int(rows) or min(columns, rows) < 2:
        raise typer.BadParameter(f"--grid {grid}: give whole numbers of 2 or more, like 15x11.")
    return image_grid(sensor, int(columns), int(rows), pair("--extent", extent, "4.0x3.0") if extent else None)


Block = Annotated[Path, Argument(help="Block folder (docs/block_folder.md).")]
Out = Annotated[Path, Option(help="Output folder; earlier results in it are replaced.")]
BlockOut = Annotated[Path, Option(help="Block folder to write; a block in it is replaced.")]
MaxSteps = Annotated[int, Option(min=1, help="Maximum number of iterations.")]
Seed = Annotated[int, Option(min=0, help="Seed of the random numbers.")]
Workers = Annotated[int | None, Option(min=1, help="Compute with this number of processes (docs/cluster.md).")]
Scheduler = Annotated[
    str | None, Option(help="Compute on the workers of the Dask scheduler at this address (docs/cluster.md).")
]

Alignment = Annotated[
    Literal["zrot", "rot", "spr"], Option("--method", help="Alignment of the ray bundles (docs/stability.md).")
]
Grid = Annotated[str, Option(help="Columns and rows of the grid.")]
Extent = Annotated[
    str | None, Option(help="Width and height of the grid in mm, like 4.0x3.0 (default: the image format).")
]
Camera = Annotated[str | None, Option(help="Camera name, if there are several.")]
CameraB = Annotated[str | None, Option(help="Camera name in B, if different from A.")]
ResultBlock = Annotated[Path | None, Option(help="Block folder of the results, if they lack the camera model.")]

Photographs = Annotated[list[Path], Argument(help="Photographs of one camera, or folders of them.")]
Distortion = Annotated[str, Option(help="Distortion model, like brown, smac or opencv (docs/models.md).")]
FreeParameters = Annotated[
    str | None, Option(help="Parameters to estimate, comma-separated: c,xp,yp,k1 (default: the usual ones).")
]
R0 = Annotated[float | None, Option(help="Balance radius R0 of SMAC (default: 0).")]
PixelSize = Annotated[float | None, Option(help="Pixel size (default: from the file).")]
PrincipalDistance = Annotated[float | None, Option(help="Initial principal distance (default: from EXIF).")]
Pairs = Annotated[
    str | None,
    Option(
        help="Photographs to match: exhaustive, sequence:K, position:K, similar:K (default: exhaustive up to 40, else "
        "position:20, or similar:20 without positions). Fewer pairs take less time."
    ),
]
Features = Annotated[
    int | None, Option(min=100, help="Maximum number of features (default: 10000, above 40 photographs 5000).")
]
LongestSide = Annotated[int | None, Option(min=200, help="Longer side of the photograph for features (default: 2400).")]
ControlMarks = Annotated[Path | None, Option(help="Image measurements of the points, if in another file.")]
ControlSystem = Annotated[
    str | None, Option(help="Coordinate system of the points, if not in the file: 25832, 25832+7837, local.")
]
MapSystem = Annotated[
    str | None, Option(help="Map system of the block: EPSG code, or with heights 25832+7837 (default: UTM zone).")
]

Cloud = Annotated[Path, Argument(help="Point cloud: .las, .laz or .csv (docs/clouds.md).")]
Classes = Annotated[str | None, Option("--class", help="Classes to use, comma-separated: 2,6.")]
Returns = Annotated[Literal["all", "first", "last", "only"], Option(help="Returns to use.")]
CloudEpsg = Annotated[int | None, Option(help="EPSG code of the point cloud; overrides the file.")]


def selection(classes: str | None, returns: str, epsg: int | None) -> dict[str, Any]:
    """Return the options of `read_cloud`; raises BadParameter for classes that are not numbers."""
    if classes is not None and not all(part.isdigit() for part in names(classes)):
        raise typer.BadParameter(f"--class {classes}: give class numbers, comma-separated, like 2,6.")
    numbers = None if classes is None else [int(part) for part in names(classes)]
    return {"classes": numbers, "returns": returns, "epsg": epsg}
