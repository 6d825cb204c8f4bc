"""A block folder -> `Block`; what cannot be a block is refused with one sentence that names file, row and mend.

Readers of other formats bring their data into the same tables (`BlockTables`) and share everything from there.
"""

import dataclasses
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxphoto.block import Block, Start
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import Mount
from jaxphoto.io.block_folder.control import check_datum_points, read_control
from jaxphoto.io.block_folder.georeferencing import read_attitudes, read_distances, read_stations
from jaxphoto.io.block_folder.image_points import check_rays, read_image_points
from jaxphoto.io.block_folder.images import check_times, read_images
from jaxphoto.io.block_folder.layout import LAYOUTS, TOML
from jaxphoto.io.block_folder.mount_sections import read_mounts, read_strips
from jaxphoto.io.block_folder.settings import read_settings, read_toml
from jaxphoto.io.tables import Table, read_csv
from jaxphoto.unknowns import Unknowns, default_priors


@dataclasses.dataclass(frozen=True)
class BlockTables:
    """What a block folder says, not yet checked: the content of block.toml and the tables by name of `LAYOUTS`.

    `file` is what messages call the settings.
    """

    settings: Mapping[str, Any]
    tables: Mapping[str, Table]
    file: str = TOML


def read_block(folder: str | Path) -> Block:
    """The block that a folder describes (docs/block_folder.md).

    Raises InputError for a file, row or number that cannot be read and BlockError for observations that do not fit
    together. Warns (UserWarning) of columns, points and cameras that are not used.
    """
    return assemble(read_folder(Path(folder)))


def read_folder(folder: Path) -> BlockTables:
    """The files of a block folder. Raises InputError for those that are missing or cannot be read."""
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; give the folder that holds {TOML}")
    needed = (TOML, *(f"{name}.csv" for name, layout in LAYOUTS.items() if layout.needed))
    for file in needed:
        if not (folder / file).is_file():
            raise InputError(f"{folder} has no file {file}; add it ({', '.join(needed)} are needed)")
    tables = {}
    for name, layout in LAYOUTS.items():
        path = folder / f"{name}.csv"
        if path.exists():
            tables[name] = read_csv(path, layout.columns, layout.optional)
    return BlockTables(read_toml(folder / TOML), tables)


def assemble(source: BlockTables) -> Block:
    """The block that settings and tables describe; all checks that need more than one line are made here."""
    tables = {name: source.tables.get(name, _empty(name)) for name in LAYOUTS}
    settings = read_settings(dict(source.settings), source.file)
    images = read_images(tables["images"], settings)
    points = read_image_points(tables["image_points"], images, settings)
    control = read_control(tables["control_points"], tables["object_points"], points, settings)
    check_rays(points, images, control.held)
    check_datum_points(settings.datum.over, points, source.file)

    cameras = {name: camera for name, camera in settings.cameras.items() if name in images.cameras}
    if unused := [name for name in settings.cameras if name not in cameras]:
        message = f"{source.file}: no image is taken by camera {', '.join(unused)}, which is not used"
        warnings.warn(message, UserWarning, stacklevel=3)
    mounts, mount_priors = read_mounts(settings.mounts, settings.cameras)
    mount_of = {name: name if name in mounts else "default" if "default" in mounts else "" for name in cameras}
    used = {mount for mount in mount_of.values() if mount}
    strips, strip_priors = read_strips(settings.strips, _distinct(images.strips))
    check_times(images, strips, strip_priors)

    start = Unknowns(
        {name: camera.interior for name, camera in cameras.items()},
        images.exterior,
        jnp.asarray(control.start),
        _only(mounts, used),
        strips,
    )
    priors = dataclasses.replace(
        default_priors(start),
        interior={name: camera.priors for name, camera in cameras.items()},
        mounts=_only(mount_priors, used),
        strips=strip_priors,
    )
    return Block(
        title=settings.title,
        images=images.ids,
        points=points.ids,
        sensors={name: camera.sensor for name, camera in cameras.items()},
        image_camera=images.cameras,
        image_mount=tuple(mount_of[camera] for camera in images.cameras),
        image_strip=images.strips,
        image_time=jnp.asarray(images.times),
        image_points=points.rows,
        control=control.control,
        fixed=control.fixed,
        check=control.check,
        stations=read_stations(tables["stations"], images, settings),
        attitudes=read_attitudes(tables["attitudes"], images, settings),
        distances=read_distances(tables["distances"], points, settings),
        datum=settings.datum,
        start=Start(start, images.known, control.known),
        priors=priors,
    )


def _empty(name: str) -> Table:
    columns = LAYOUTS[name].columns
    return Table.of(f"{name}.csv", {column: np.zeros(0, object) for column in columns})


def _distinct(names: Iterable[str]) -> list[str]:
    return [name for name in dict.fromkeys(names) if name]


def _only(mounts: dict[str, Mount], used: set[str]) -> dict[str, Mount]:
    return {name: mount for name, mount in mounts.items() if name in used}
