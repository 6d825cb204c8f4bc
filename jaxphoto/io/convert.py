"""Any format that is known -> `Block`, or -> a block folder."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from jaxphoto.block import Block
from jaxphoto.errors import InputError
from jaxphoto.io import aicon, bal, colmap, dbat, photomodeler
from jaxphoto.io.block_folder import BlockTables, assemble, write_block
from jaxphoto.io.block_folder.block_reader import read_folder
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.cameras.camera_reader import is_camera_file
from jaxphoto.io.control_files.reader import is_control_file
from jaxphoto.io.reconstructions import (
    blocks_exchange,
    bundler,
    metashape,
    nerfstudio,
    open_mvg,
    open_sfm,
    orthority,
    pix4d,
    text_project,
)


class Format(NamedTuple):
    """A format: what tells it, its reader, and what it is in a line."""

    recognises: Callable[[Path], bool]
    read: Callable[[Path], BlockTables]
    about: str


FORMATS = {
    "block": Format(lambda source: (source / TOML).is_file(), read_folder, "block folder"),
    "dbat": Format(dbat.recognises, dbat.read_dbat, "script of DBAT, XML"),
    "photomodeler": Format(photomodeler.recognises, photomodeler.read_photomodeler, "export of PhotoModeler"),
    "aicon": Format(aicon.recognises, aicon.read_aicon, "AICON: .ior, .phc, .eor, .obc"),
    "bal": Format(bal.recognises, bal.read_bal, "bundle adjustment in the large"),
    "colmap": Format(colmap.recognises, colmap.read_colmap_model, "model of COLMAP"),
    "opensfm": Format(open_sfm.recognises, open_sfm.read_open_sfm, "OpenSfM, OpenDroneMap, WebODM"),
    "openmvg": Format(open_mvg.recognises, open_mvg.read_open_mvg, "sfm_data.json of OpenMVG"),
    "blocksexchange": Format(
        blocks_exchange.recognises, blocks_exchange.read_blocks_exchange, "BlocksExchange XML of Bentley"
    ),
    "metashape": Format(metashape.recognises, metashape.read_metashape, "cameras of Metashape, XML, with tie points"),
    "pix4d": Format(pix4d.recognises, pix4d.read_pix4d, "folder params of Pix4D"),
    "nerfstudio": Format(
        nerfstudio.recognises, nerfstudio.read_nerfstudio, "transforms.json of nerfstudio, with image points"
    ),
    "orthority": Format(
        orthority.recognises,
        orthority.read_orthority,
        "parameters of orthority, with image points",
    ),
    "texts": Format(
        text_project.recognises,
        text_project.read_text_project,
        "folder of texts: omega, phi, kappa or PATB's matrices, image points of BINGO or PATB, and a camera file",
    ),
    "bundler": Format(bundler.recognises, bundler.read_bundler, "bundle.out of Bundler, VisualSFM"),
}
"""The formats that `read_source` knows, in the order of help."""


def read_source(source: str | Path, format: str | None = None, *, stations: bool = True) -> Block:
    """The block in a file or folder of any format of `FORMATS`, recognised unless `format` names it.

    Of another program it says what it was `converted_from`.

    `stations` False leaves observed camera positions out. Raises InputError for an unknown format, and what
    `jaxphoto.io.read_block` raises.
    """
    source = Path(source)
    if not source.exists():
        raise InputError(f"there is no file or folder {source}; correct the name")
    name = _format(source, format)
    tables = FORMATS[name].read(source)
    if not stations:
        kept = {name: table for name, table in tables.tables.items() if name != "stations"}
        tables = BlockTables(tables.settings, kept, tables.file)
    block = assemble(tables)
    if name == "block":
        return block
    place = "/".join(source.resolve().parts[-2:])
    return dataclasses.replace(block, converted_from=f"{name}: {place}")


def convert(source: str | Path, folder: str | Path, format: str | None = None, *, stations: bool = True) -> Block:
    """Write what `read_source` reads as a block folder, and return it. Raises what these two raise."""
    block = read_source(source, format, stations=stations)
    write_block(block, folder)
    return block


def _format(source: Path, name: str | None) -> str:
    known = ", ".join(FORMATS)
    if name is None:
        found = [name for name, format in FORMATS.items() if format.recognises(source)]
        if len(found) != 1:
            if not found and source.is_file() and is_camera_file(source):
                raise InputError(f"{source} is a camera file, without photographs; jaxphoto camera converts it")
            if not found and source.is_file() and is_control_file(source):
                raise InputError(f"{source} is control, without photographs; jaxphoto control takes it to a block")
            what = f"is of several formats at once ({', '.join(found)})" if found else "is of no format that is known"
            raise InputError(f"{source} {what}; name the format, one of {known}")
        return found[0]
    if name not in FORMATS:
        raise InputError(f"the format {name!r} is unknown; choose one of {known}")
    return name
