"""The formats in which adjusted photographs are written: what each is, what its cameras are, and its writer."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from jaxphoto.camera import Perspective
from jaxphoto.camera.conversion import Conversion, converted
from jaxphoto.errors import InputError
from jaxphoto.io.cameras import agisoft, colmap
from jaxphoto.io.cameras.camera_file import CameraModel
from jaxphoto.io.exports import blocks_exchange, nerfstudio, open_mvg, open_sfm, orthority
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs
from jaxphoto.io.exports.angles_text import write_angles_text
from jaxphoto.io.exports.bal import write_bal
from jaxphoto.io.exports.blocks_exchange import write_blocks_exchange
from jaxphoto.io.exports.bundler import write_bundler
from jaxphoto.io.exports.colmap_model import write_binary_model, write_text_model
from jaxphoto.io.exports.geo_json import write_geo_json
from jaxphoto.io.exports.geo_package import write_geo_package
from jaxphoto.io.exports.map_photographs import Misfit, map_misfit, misfit_of
from jaxphoto.io.exports.metashape import write_metashape
from jaxphoto.io.exports.nerfstudio import write_nerfstudio
from jaxphoto.io.exports.open_mvg import write_open_mvg
from jaxphoto.io.exports.open_sfm import write_open_sfm
from jaxphoto.io.exports.orthority import write_orthority
from jaxphoto.io.exports.same_rays import RADIAL, on_same_rays
from jaxphoto.writing import check_folder, whole_folder


class ExportFormat(NamedTuple):
    """A format: its writer, what its perspective cameras and its fisheyes are (None: it has no such, and where it has
    neither any camera goes), whether it is in map coordinates, and what it is in a line."""

    write: Callable[[AdjustedPhotographs, Path], None]
    plane: CameraModel | None
    fisheye: CameraModel | None
    in_map: bool
    about: str
    endings: tuple[str, ...]
    """Those of the files that it writes."""
    keeps_rays: bool = False
    """Whether image points are moved to where a camera that is fitted sees the same rays, instead of leaving them."""
    lacks: tuple[str, ...] = ()
    """What it has no place for at all, of cameras, points and image points."""


class Exported(NamedTuple):
    """What an export lost: by camera the conversion of its interior orientation, and what the map does."""

    cameras: dict[str, Conversion]
    map_misfit: Misfit | None
    """Of the image points, where the format has map coordinates; None in a Cartesian frame."""
    moved: Misfit | None = None
    """Of the image points, where the format keeps their rays."""


EXPORTS = {
    "colmap": ExportFormat(
        write_text_model,
        colmap.PLANE,
        colmap.FISHEYE,
        False,
        "COLMAP model: cameras, images, points3D as text",
        (".txt",),
    ),
    "colmap-binary": ExportFormat(
        write_binary_model,
        colmap.PLANE,
        colmap.FISHEYE,
        False,
        "the same, binary",
        (".bin",),
    ),
    "metashape": ExportFormat(
        write_metashape,
        agisoft.PLANE,
        agisoft.FISHEYE,
        False,
        "cameras of Agisoft Metashape, XML",
        (".xml", ".csv"),
        lacks=("points",),
    ),
    "opensfm": ExportFormat(
        write_open_sfm,
        open_sfm.PLANE,
        open_sfm.FISHEYE,
        False,
        "reconstruction of OpenSfM, as in WebODM",
        (".json", ".csv", ".txt"),
    ),
    "openmvg": ExportFormat(
        write_open_mvg,
        open_mvg.PLANE,
        open_mvg.FISHEYE,
        False,
        "sfm_data.json of OpenMVG, with structure",
        (".json",),
    ),
    "blocksexchange": ExportFormat(
        write_blocks_exchange,
        blocks_exchange.PLANE,
        None,
        False,
        "BlocksExchange XML of Bentley, with tie points",
        (".xml",),
    ),
    "nerfstudio": ExportFormat(
        write_nerfstudio,
        nerfstudio.PLANE,
        nerfstudio.FISHEYE,
        False,
        "transforms.json of nerfstudio",
        (".json", ".csv"),
        lacks=("points",),
    ),
    "bundler": ExportFormat(
        write_bundler,
        RADIAL,
        None,
        False,
        "bundle.out of Bundler, with list.txt: f, k1, k2",
        (".out", ".txt"),
        True,
    ),
    "bal": ExportFormat(
        write_bal,
        RADIAL,
        None,
        False,
        "problem of bundle adjustment in the large: f, k1, k2",
        (".txt",),
        True,
    ),
    "opk": ExportFormat(
        write_angles_text,
        None,
        None,
        True,
        "text of positions and omega, phi, kappa",
        (".txt", ".toml", ".csv"),
        lacks=("points",),
    ),
    "orthority": ExportFormat(
        write_orthority,
        orthority.PLANE,
        orthority.FISHEYE,
        True,
        "parameters of orthority, YAML and CSV",
        (".yaml", ".csv", ".prj"),
        lacks=("points",),
    ),
    "geojson": ExportFormat(
        write_geo_json,
        None,
        None,
        False,
        "stations and footprints in longitude and latitude",
        (".geojson",),
        lacks=("cameras", "points", "image points"),
    ),
    "geopackage": ExportFormat(
        write_geo_package,
        None,
        None,
        False,
        "stations, footprints and points for a GIS",
        (".gpkg",),
        lacks=("cameras", "image points"),
    ),
}
"""The formats that `export` knows, in the order of docs and help."""


def export(photographs: AdjustedPhotographs, folder: str | Path, format: str) -> Exported:
    """Write `photographs` into `folder` in one of `EXPORTS`, and say what is lost by it.

    Interior orientations are converted exactly where the format holds their distortion, else fitted over the format of
    the sensor (`camera.conversion`). Warns (UserWarning) of what the adjustment corrects by and the format does not.

    Raises InputError for an unknown format, where `folder` holds something else than what jaxphoto wrote, and for a
    camera or a frame that the format cannot hold.
    """
    known, folder = _known(format), Path(folder)
    check_export_target(folder)
    cameras = {name: _converted(photographs, name, format) for name in photographs.cameras}
    if photographs.changes:
        what = ", ".join(photographs.changes)
        warnings.warn(f"{format} knows no {what}: points will not fit the photographs by it", stacklevel=2)
    held = photographs._replace(
        cameras={name: c._replace(interior=cameras[name].interior) for name, c in photographs.cameras.items()}
    )
    moved = None
    if known.keeps_rays:
        held = held._replace(column_row=on_same_rays(photographs, cameras))
        moved = misfit_of(held.column_row - photographs.column_row)
    with whole_folder(folder, _all_clash) as work:
        known.write(held, work)
    on_map = known.in_map and photographs.frame.kind == "epsg"
    return Exported(cameras, map_misfit(photographs) if on_map else None, moved)


def check_export_target(folder: Path, *inputs: Path) -> None:
    """Raise InputError where nothing can be written (`check_folder`), or anything else lies in the folder."""
    check_folder(folder, *inputs, clashes=_all_clash)


def _all_clash(name: str) -> bool:
    # Programs read what they find: COLMAP binary files before text, rigs and frames of another model.
    return True


def _known(format: str) -> ExportFormat:
    if format not in EXPORTS:
        raise InputError(f"nothing can be exported as {format!r}; choose one of {', '.join(EXPORTS)}")
    return EXPORTS[format]


def _converted(photographs: AdjustedPhotographs, name: str, format: str) -> Conversion:
    """A camera as one that the format has."""
    sensor, interior = photographs.cameras[name]
    known = EXPORTS[format]
    model = known.plane if type(interior.projection) is Perspective else known.fisheye
    if known.plane is None:
        return Conversion(interior, 0.0, 0.0, 1.0)
    if model is None:
        # A polynomial on the plane would miss by hundreds of pixels where the fisheye looks aside.
        others = ", ".join(key for key, other in EXPORTS.items() if other.fisheye)
        raise InputError(
            f"camera {name} cannot be written as {format}, whose cameras are perspective, because it is a fisheye; "
            f"write one of {others}, or undistort its photographs"
        )
    try:
        return converted(interior, model.distortion, sensor, model.lacks, model.projection)
    except ValueError as error:
        raise InputError(f"camera {name} cannot be written as {format}: {error}") from None
