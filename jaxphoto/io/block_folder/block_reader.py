"""A block folder -> `Block`; what cannot be a block is refused with one sentence that names file, row and mend.

Readers of other formats bring their data into the same tables (`BlockTables`) and share everything from there.
"""

import dataclasses
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import on_device
from jaxphoto.block import Block, Frame, Start, sensor_rows
from jaxphoto.camera import ThermalRates
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import Mount, RigCamera
from jaxphoto.io.block_folder.attitude_units import check_attitude_units
from jaxphoto.io.block_folder.control import check_datum_points, read_control
from jaxphoto.io.block_folder.declared_unknowns import known_unknowns, read_unknowns
from jaxphoto.io.block_folder.earlier_calibration import known_cameras, with_earlier_calibrations
from jaxphoto.io.block_folder.frame_sections import read_corrections, read_frame
from jaxphoto.io.block_folder.georeferencing import read_attitudes, read_stations
from jaxphoto.io.block_folder.image_points import check_rays, read_image_points
from jaxphoto.io.block_folder.images import Images, check_rates, check_times, read_images
from jaxphoto.io.block_folder.map_tables import origin_of, tables_to_local
from jaxphoto.io.block_folder.motion import (
    ObservedFlight,
    check_rig_delays,
    check_time_offsets,
    read_motion,
    without_heads,
)
from jaxphoto.io.block_folder.mount_sections import mounts_of, read_mounts, read_strips
from jaxphoto.io.block_folder.observed import Ids, Kind, known_kinds, own_tables
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.block_folder.settings import Settings, read_partitions, read_settings
from jaxphoto.io.block_folder.shutters import check_shutters
from jaxphoto.io.block_folder.surfaces import read_surfaces
from jaxphoto.io.block_folder.table_layout import LAYOUTS, TOML, TableLayout, layout_in
from jaxphoto.io.block_folder.tables import layouts, read_declared
from jaxphoto.io.block_folder.temperatures import temperatures_of, with_temperatures
from jaxphoto.io.block_folder.trajectory_section import read_flight
from jaxphoto.io.names import points_called
from jaxphoto.io.text_tables import Table, read_csv
from jaxphoto.io.toml import read_toml
from jaxphoto.io.trajectory import Records, read_records
from jaxphoto.observations import AbstractObservations, Distances, sigma_key
from jaxphoto.parameters import AbstractParameters
from jaxphoto.unknowns import Unknowns, default_priors
from jaxphoto.variants import MODES

# The vertical so far from the origin of the local frame is tilted by 3 degrees: what is given is not the block's.
_FAR_M = 3e5


@dataclasses.dataclass(frozen=True)
class BlockTables:
    """What a block folder says, not yet checked: the content of block.toml and the tables by name of `layouts`.

    `file` is what messages call the settings; `trajectory` is what the file named under [trajectory] gives; `more` are
    the classes that are not jaxphoto's own.
    """

    settings: Mapping[str, Any]
    tables: Mapping[str, Table]
    file: str = TOML
    trajectory: Records | None = None
    more: tuple[type, ...] = ()

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The classes of observations that there may be tables of."""
        return known_kinds(kind for kind in self.more if issubclass(kind, AbstractObservations))

    @property
    def unknowns(self) -> tuple[type[AbstractParameters], ...]:
        """The classes of parameters that [unknowns] may have."""
        return known_unknowns(kind for kind in self.more if issubclass(kind, AbstractParameters))


def read_block(folder: str | Path, more: Iterable[type] = ()) -> Block:
    """The block that a folder describes (docs/block_folder.md).

    `more` are classes of observations and of unknowns of your own (docs/extending_files.md).

    Raises InputError for a file, row or number that cannot be read and BlockError for observations that do not fit
    together. Warns (UserWarning) of columns, points and cameras that are not used.
    """
    return assemble(read_folder(Path(folder), more))


def exposure_times(folder: str | Path) -> Float[np.ndarray, "images"]:
    """`time_s` of images.csv, as it stands there, in the order of the block; NaN where there is none."""
    return read_folder(Path(folder)).tables["images"].numbers("time_s", empty=True)


def _instead(folder: Path, file: str) -> str:
    """What to do where a needed file is missing: the table may lie there as something else."""
    if (folder / file).is_dir():
        return "what is called so is a folder: put the file in its place"
    like = sorted(p.name for p in folder.iterdir() if p.stem.lower() == Path(file).stem and p.is_file())
    return f"there is {like[0]}: save it as {file}" if like else "add it"


def read_folder(folder: Path, more: Iterable[type] = ()) -> BlockTables:
    """The files of a block folder. Raises InputError for those that are missing or cannot be read."""
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; give the folder that holds {TOML}")
    needed = (TOML, *(f"{name}.csv" for name, layout in LAYOUTS.items() if layout.needed))
    for file in needed:
        if not (folder / file).is_file():
            raise InputError(f"{folder} has no file {file}; {_instead(folder, file)} ({', '.join(needed)} are needed)")
    settings = with_earlier_calibrations(read_toml(folder / TOML), TOML, folder)
    tables: dict[str, Table] = {}
    top = Section(TOML, "", settings)
    frame, flight = read_frame(top.section("frame")), top.section("trajectory")
    trajectory = read_records(folder / flight.text("file")) if flight.values else None
    source = BlockTables(settings, tables, trajectory=trajectory, more=tuple(more))
    for name, layout in layouts(source.kinds, read_partitions(top)).items():
        path = folder / f"{name}.csv"
        if path.exists():
            tables[name] = read_csv(path, *layout_in(frame, layout)[1:])
    if ThermalRates.kind in top.section("unknowns"):
        tables["images"] = with_temperatures(tables["images"], folder)
    return source


def assemble(source: BlockTables) -> Block:
    """The block that settings and tables describe; all checks that need more than one line are made here."""
    kinds = source.kinds
    settings = read_settings(dict(source.settings), source.file, [sigma_key(kind) for kind in own_tables(kinds)])
    known = layouts(kinds, settings.partitions)
    for name in settings.observations:
        if name not in known:
            raise InputError(
                f"{source.file}, observations: jaxphoto has no class for {name}.csv; give yours to "
                "read_block(folder, more=(...,)), or remove the name, and the observations are not used"
            )
    given = {name: source.tables.get(name, _empty(name, layout, settings.frame)) for name, layout in known.items()}
    frame = _located(settings.frame, given, source)
    tables = tables_to_local(given, frame) if frame.kind == "epsg" else given
    if frame.kind == "grid":
        message = f'{source.file}: map-grid coordinates are not Cartesian; [frame] kind = "epsg" converts them exactly'
        warnings.warn(message, UserWarning, stacklevel=3)
    corrections = read_corrections(settings.corrections, frame)
    images = read_images(tables["images"], settings)
    points = read_image_points(tables["image_points"], images, settings)
    control = read_control(tables["control_points"], tables["object_points"], points, settings)
    surfaces = read_surfaces(tables["surfaces"], settings.scanner, points)
    held = control.held.copy()
    held[surfaces.rows.point] = True
    check_rays(points, images, held)
    check_datum_points(settings.datum.over, points, source.file)

    cameras = {name: camera for name, camera in settings.cameras.items() if name in images.cameras}
    if unused := [name for name in settings.cameras if name not in cameras]:
        message = f"{source.file}: no image is taken by camera {', '.join(unused)}, which is not used"
        warnings.warn(message, UserWarning, stacklevel=3)
    mounts, mount_priors = read_mounts(settings.mounts, settings.cameras)
    mount_of = mounts_of(cameras, mounts)
    used = {mount for mount in mount_of.values() if mount}
    strips, strip_priors = read_strips(settings.strips, _distinct(images.strips))
    check_times(images, strips, strip_priors)
    image_mount = tuple(mount_of[camera] for camera in images.cameras)
    flight = _flight(source, tables, images, frame, settings)
    if source.trajectory is not None:
        flight = without_heads(flight, images, image_mount, settings.unknowns.section(RigCamera.kind))
    if source.trajectory is None:
        check_attitude_units(given["attitudes"], flight.stations, images)

    start = Unknowns(
        {name: camera.interior for name, camera in cameras.items()},
        images.exterior,
        on_device(control.start),
        _only(mounts, used),
        strips,
        surfaces.scanner,
    )
    priors = dataclasses.replace(
        default_priors(start),
        interior={name: camera.priors for name, camera in cameras.items()},
        mounts=_only(mount_priors, used),
        strips=strip_priors,
        scanner=surfaces.priors,
    )
    block = Block(
        title=settings.title,
        images=images.ids,
        points=points.ids,
        sensors={name: camera.sensor for name, camera in cameras.items()},
        image_camera=images.cameras,
        image_mount=image_mount,
        image_strip=images.strips,
        image_time=on_device(images.times),
        flight_time=None if images.strips_are_the_flight else on_device(images.flight_times),
        middle_s=images.middle_s,
        temperatures=temperatures_of(images.temperatures, settings),
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
        corrections=corrections,
        surfaces=surfaces.rows,
        partitions=_partitions(images, settings),
        converted_from=settings.converted_from,
        breaklines=points_called(points.ids, settings.breaklines, f"{source.file}, breaklines:"),
    )
    more, more_priors = read_unknowns(settings.unknowns, source.unknowns, block)
    start, priors = dataclasses.replace(start, more=more), dataclasses.replace(priors, more=more_priors)
    check_rates(images, start, priors)
    check_shutters(images, start, priors)
    ids = Ids(images, points, {kind: tuple(owners) for kind, owners in start.tables.items()})
    distances, further = read_declared(kinds, tables, ids, settings)
    check_time_offsets(flight, further, image_mount, mounts, mount_priors, images, source.file)
    check_rig_delays(flight, further, start, priors, images)
    block = dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=start),
        priors=priors,
        distances=distances,
        more=(*further, *known_cameras(cameras)),
    )
    for doubt in block.doubts:
        warnings.warn(doubt, stacklevel=3)
    posed = MODES[settings.mode](block)
    if settings.mode == "direct":
        _warn_of_given_orientations(block, source.file)
    return posed


def _partitions(images: Images, settings: Settings) -> dict[str, tuple[str, ...]]:
    """Of each partition, the part that each image is in."""
    found = {}
    for name in settings.partitions:
        if name not in images.table:
            raise InputError(
                f"{images.table.file}: the column {name} is missing, which is one of the partitions; add it"
            )
        found[name] = tuple(images.table.names(name))
        for line in [k for k, part in enumerate(found[name]) if part == "default"][:1]:
            raise images.table.bad(line, f"the {name} default means every {name} in [unknowns]; give it another name")
    return found


def _warn_of_given_orientations(block: Block, file: str) -> None:
    """A UserWarning where direct georeferencing with sensors must hold an orientation that they did not give."""
    sensed = set(sensor_rows(block, block.start.unknowns).image.tolist())
    bare = [name for k, name in enumerate(block.images) if k not in sensed]
    if bare and len(block.stations.who) + len(block.attitudes.image):
        warnings.warn(
            f'{file}, [georeferencing] mode = "direct": {len(bare)} image(s) have no station and attitude, so their '
            f"orientation in images.csv is held as if it were exact: {', '.join(bare[:5])}"
            + (", ..." if len(bare) > 5 else ""),
            UserWarning,
            stacklevel=4,
        )


def _located(frame: Frame, tables: Mapping[str, Table], source: BlockTables) -> Frame:
    """The frame with an origin: what block.toml gives, else a place amid the block."""
    if frame.kind != "epsg":
        return frame
    amid = origin_of(tables, frame, source.trajectory)
    origin = amid if frame.origin is None else frame.origin
    if origin is None:
        raise InputError(
            f"{source.file}, [frame]: no coordinate tells where the block lies; add "
            "origin = [longitude, latitude, height] in degrees and metres"
        )
    located = dataclasses.replace(frame, origin=origin)
    if amid is None:
        return located
    away = float(np.linalg.norm(located.map.local_from_place(np.array([amid]))))
    if away > _FAR_M:
        raise InputError(
            f"{source.file}, [frame] origin: the place is {away / 1e3:.0f} km from the block, which lies about "
            f"({amid[0]:.4f}, {amid[1]:.4f}) degrees; correct it or remove the key"
        )
    return located


def _flight(
    source: BlockTables, tables: Mapping[str, Table], images: Images, frame: Frame, settings: Settings
) -> ObservedFlight:
    """Stations, attitudes and motion, from the trajectory or from their tables."""
    stations, attitudes = tables["stations"], tables["attitudes"]
    if source.trajectory is None:
        motion = read_motion(stations, attitudes, images)
        return ObservedFlight(
            read_stations(stations, images, settings), read_attitudes(attitudes, images, settings), *motion
        )
    for table in (stations, attitudes):
        if len(table):
            raise InputError(
                f"{table.file}: stations and attitudes are interpolated in {source.trajectory.file}; remove this file, "
                f"or [trajectory] from {source.file}"
            )
    return read_flight(source.trajectory, images, frame, settings)


def _empty(name: str, layout: TableLayout, frame: Frame) -> Table:
    columns = layout_in(frame, layout).columns
    return Table.of(f"{name}.csv", {column: np.zeros(0, object) for column in columns})


def _distinct(names: Iterable[str]) -> list[str]:
    return [name for name in dict.fromkeys(names) if name]


def _only(mounts: dict[str, Mount], used: set[str]) -> dict[str, Mount]:
    return {name: mount for name, mount in mounts.items() if name in used}
