"""Read a block folder as `Block`. Readers of other formats also build `BlockTables` and call `assemble`."""

import dataclasses
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Block, Start, sensor_rows
from jaxphoto.camera import ThermalRates
from jaxphoto.errors import InputError, few
from jaxphoto.georeferencing import RigCamera
from jaxphoto.io.block_folder.camera_section import known_cameras, with_earlier_calibrations
from jaxphoto.io.block_folder.declared_tables import Ids, known_kinds, layouts, own_tables, read_declared
from jaxphoto.io.block_folder.flight import check_motion, read_flight
from jaxphoto.io.block_folder.map_tables import tables_to_local, with_origin
from jaxphoto.io.block_folder.observations import (
    check_datum_points,
    check_rays,
    check_times,
    partitions_of,
    read_control,
    read_image_points,
    read_images,
    read_surfaces,
    temperatures_of,
    with_temperatures,
)
from jaxphoto.io.block_folder.parameters import (
    check_shutters,
    known_unknowns,
    mounts_of,
    read_mounts,
    read_scanner,
    read_strips,
    read_unknowns,
)
from jaxphoto.io.block_folder.settings import BlockKeys, Settings, corrections_in, frame_of, read_settings
from jaxphoto.io.block_folder.table_layout import LAYOUTS, TOML, checked, layout_in
from jaxphoto.io.text_tables import Table, read_csv
from jaxphoto.io.toml import Section, read_toml
from jaxphoto.io.trajectory import Records, read_records
from jaxphoto.observations import AbstractObservations, Distances, sigma_key
from jaxphoto.parameters import AbstractParameters
from jaxphoto.unknowns import Unknowns, default_priors
from jaxphoto.variants import MODES


@dataclasses.dataclass(frozen=True)
class BlockTables:
    """Unchecked content of a block folder: block.toml and its tables by name (`layouts`).

    `file` is the name of the settings in messages. `trajectory` is the content of the file in [trajectory]. `more`
    contains user-defined classes of observations and unknowns.
    """

    settings: Mapping[str, Any]
    tables: Mapping[str, Table]
    file: str = TOML
    trajectory: Records | None = None
    more: tuple[type, ...] = ()

    @property
    def kinds(self) -> tuple[type[AbstractObservations], ...]:
        """Classes of observations that may have a table."""
        return known_kinds(kind for kind in self.more if issubclass(kind, AbstractObservations))

    @property
    def unknowns(self) -> tuple[type[AbstractParameters], ...]:
        """Classes of parameters that are allowed in [unknowns]."""
        return known_unknowns(kind for kind in self.more if issubclass(kind, AbstractParameters))


def read_block(folder: str | Path, more: Iterable[type] = ()) -> Block:
    """Read the block in a block folder (docs/block_folder.md).

    `more` contains user-defined classes of observations and unknowns (docs/extending.md).

    Raises InputError for an invalid file, row or value, and BlockError for inconsistent observations. Warns
    (UserWarning) of unused columns, points and cameras.
    """
    return assemble(read_folder(Path(folder), more))


def exposure_times(folder: str | Path) -> Float[np.ndarray, "images"]:
    """Return `time_s` of images.csv in the order of the block's images; NaN for empty cells."""
    return read_folder(Path(folder)).tables["images"].numbers("time_s", empty=True)


def read_folder(folder: Path, more: Iterable[type] = ()) -> BlockTables:
    """Read the files of a block folder. Raises InputError for missing or invalid files."""
    if not folder.is_dir():
        raise InputError(f"folder not found: {folder}; give the folder that contains {TOML}")
    required = (TOML, *(f"{name}.csv" for name, layout in LAYOUTS.items() if layout.required))
    for file in required:
        if not (folder / file).is_file():
            raise InputError(f"{folder}: missing file {file}; add it ({', '.join(required)} are needed)")
    settings = with_earlier_calibrations(read_toml(folder / TOML), TOML, folder)
    keys = Section(TOML, "", settings).model(BlockKeys)
    with warnings.catch_warnings(action="ignore"):
        frame = frame_of(keys.frame, TOML)
    trajectory = read_records(folder / keys.trajectory.file) if keys.trajectory else None
    tables: dict[str, Table] = {}
    source = BlockTables(settings, tables, trajectory=trajectory, more=tuple(more))
    for name, layout in layouts(source.kinds, keys.partitions).items():
        path = folder / f"{name}.csv"
        if path.exists():
            layout, partitions = layout_in(frame, layout), keys.partitions if name == "images" else ()
            needed = (*layout.names(required=True), *partitions)
            tables[name] = read_csv(path, needed, layout.names(required=False), layout.text)
    if ThermalRates.kind in keys.unknowns:
        tables["images"] = with_temperatures(tables["images"], folder)
    return source


def assemble(source: BlockTables) -> Block:
    """Build the block from settings and tables, and check the relations between them."""
    kinds = source.kinds
    settings = read_settings(dict(source.settings), source.file, [sigma_key(kind) for kind in own_tables(kinds)])
    keys, top, frame = settings.keys, settings.top, settings.frame
    known = layouts(kinds, keys.partitions)
    for name in keys.observations:
        if name not in known:
            raise InputError(
                f"{source.file}, observations: no class is known for {name}.csv; pass it as read_block(folder, "
                "more=(...,)), or remove the name to ignore these observations"
            )
    tables = {}
    for name, layout in known.items():
        layout = layout_in(frame, layout)
        empty = Table.of(f"{name}.csv", {column: np.zeros(0, object) for column in layout.names(required=True)})
        tables[name] = checked(source.tables.get(name, empty), layout)
    if frame.kind == "epsg":
        frame = with_origin(frame, tables, source.trajectory, source.file)
        tables = tables_to_local(tables, frame)
    if frame.kind == "grid":
        _warn(f'{source.file}: map-grid coordinates are not Cartesian; [frame] kind = "epsg" converts them exactly')
    images = read_images(tables["images"], settings)
    points = read_image_points(tables["image_points"], images, settings)
    control = read_control(tables["control_points"], tables["object_points"], points, settings)
    scanner, scanner_priors = read_scanner(top.section("scanner"))
    surfaces = read_surfaces(tables["surfaces"], tuple(scanner.shifts) if scanner else (), points, settings)
    controlled = control.controlled.copy()
    controlled[surfaces.point] = True
    check_rays(points, images, controlled)
    check_datum_points(settings.datum.over, points, source.file)

    cameras = {name: camera for name, camera in settings.cameras.items() if name in images.cameras}
    if unused := [name for name in settings.cameras if name not in cameras]:
        _warn(f"{source.file}: cameras without images are not used: {', '.join(unused)}")
    mounts, mount_priors = read_mounts(top.section("mounts"), settings.cameras)
    mount_of = mounts_of(cameras, mounts)
    used = [name for name in mounts if name in mount_of.values()]
    strips, strip_priors = read_strips(top.section("strips"), [n for n in dict.fromkeys(images.strips) if n])
    image_mount = tuple(mount_of[camera] for camera in images.cameras)
    flight = read_flight(tables, source.trajectory, images, frame, settings)
    if source.trajectory is not None:
        # Remove stations and attitudes of rig cameras without a mount: their rig fixes them to the reference camera.
        rig = keys.unknowns.get(RigCamera.kind, {})
        heads = [c in rig and not m for c, m in zip(images.cameras, image_mount, strict=True)]
        flight = flight.without_heads(np.array(heads, bool))

    start = Unknowns(
        {name: camera.interior for name, camera in cameras.items()},
        images.exterior,
        as_jax_array(control.start),
        {name: mounts[name] for name in used},
        strips,
        scanner,
    )
    priors = dataclasses.replace(
        default_priors(start),
        interior={name: camera.priors for name, camera in cameras.items()},
        mounts={name: mount_priors[name] for name in used},
        strips=strip_priors,
        scanner=scanner_priors,
    )
    block = Block(
        title=keys.title,
        images=images.ids,
        points=points.ids,
        sensors={name: camera.sensor for name, camera in cameras.items()},
        image_camera=images.cameras,
        image_mount=image_mount,
        image_strip=images.strips,
        image_time=as_jax_array(images.times),
        flight_time=None if images.strips_are_the_flight else as_jax_array(images.flight_times),
        middle_s=images.middle_s,
        temperatures=temperatures_of(images, settings),
        image_points=points.rows,
        control=control.control,
        fixed=control.fixed,
        check=control.check,
        stations=flight.stations,
        attitudes=flight.attitudes,
        distances=Distances.none(),
        datum=settings.datum,
        start=Start(start, images.known, control.known),
        priors=priors,
        motion=flight.motion,
        frame=frame,
        corrections=corrections_in(frame, settings),
        surfaces=surfaces,
        partitions=partitions_of(images, settings),
        converted_from=keys.converted_from,
    )
    more, more_priors = read_unknowns(top.section("unknowns"), source.unknowns, block)
    start, priors = dataclasses.replace(start, more=more), dataclasses.replace(priors, more=more_priors)
    check_times(images, start, priors)
    check_shutters(list(zip(images.ids, images.cameras, strict=True)), start, priors)
    ids = Ids(images, points, {kind: tuple(owners) for kind, owners in start.tables.items()})
    distances, further = read_declared(kinds, tables, ids, settings)
    check_motion(flight, further, image_mount, start, priors, images, source.file)
    block = dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=start),
        priors=priors,
        distances=distances,
        more=(*further, *known_cameras(cameras)),
    )
    for doubt in block.prior_warnings:
        warnings.warn(doubt, stacklevel=3)
    posed = MODES[keys.georeferencing.mode](block)
    if keys.georeferencing.mode == "direct":
        _warn_of_fixed_orientations(block, settings)
    return posed


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=4)


def _warn_of_fixed_orientations(block: Block, settings: Settings) -> None:
    """Warn of images without station and attitude in direct georeferencing: their approximate orientation is fixed."""
    sensed = set(sensor_rows(block, block.start.unknowns).image.tolist())
    without = [name for k, name in enumerate(block.images) if k not in sensed]
    if without and len(block.stations.who) + len(block.attitudes.image):
        _warn(
            f'{settings.file}, [georeferencing] mode = "direct": {len(without)} image(s) have no station and attitude, '
            f"so their orientation in images.csv is fixed: {few(without)}"
        )
