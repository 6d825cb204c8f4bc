"""`Block` -> a block folder, whole or not at all."""

import csv
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from jaxphoto.block import Block
from jaxphoto.errors import BlockError, quoted
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.block_folder.declared_unknowns import unknown_sections
from jaxphoto.io.block_folder.frame_sections import corrections_section, frame_section
from jaxphoto.io.block_folder.map_tables import tables_to_map
from jaxphoto.io.block_folder.motion import check_motion_held
from jaxphoto.io.block_folder.mount_sections import mount_section, mounts_of, strip_section
from jaxphoto.io.block_folder.observed import Kind
from jaxphoto.io.block_folder.settings import datum_section, toml_text
from jaxphoto.io.block_folder.surfaces import scanner_section, surface_table
from jaxphoto.io.block_folder.table_layout import (
    ANGLES,
    ATTITUDE,
    LAYOUTS,
    RATE,
    SIGMA_ATTITUDE,
    SIGMA_XYZ,
    TOML,
    VELOCITY,
    XYZ,
)
from jaxphoto.io.block_folder.tables import declared_tables, kinds_of, layouts
from jaxphoto.io.names import harm_in, harmless
from jaxphoto.observations import OBSERVATIONS, AbstractCoordinates
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import FIXED, FREE
from jaxphoto.writing import Clashes, check_folder, whole_folder


def check_block_target(folder: Path, *inputs: Path) -> None:
    """Raise InputError where no block can be written (`check_folder`), or a table lies that would be read with it."""
    check_folder(folder, *inputs, clashes=_tables_of(OBSERVATIONS))


@outside_transformations
def write_block(block: Block, folder: str | Path) -> None:
    """Write `block` as a folder that `read_block` reads as the same block; numbers come back exactly.

    Angles are written in degrees, times as the file had them, coordinates of a frame of kind epsg in its system (1e-6
    m); these come back to rounding. Velocities are written for images with a station, rates for those with an attitude.
    A block that jaxphoto wrote there is replaced; what else lies in the folder stays (`whole_folder`).

    Raises InputError where `folder` holds a block or anything else that jaxphoto did not write, or that was changed
    since, BlockError for priors that block.toml cannot express.
    """
    with whole_block(block, folder):
        pass


@contextmanager
def whole_block(block: Block, folder: str | Path) -> Iterator[Path]:
    """`write_block`, and what else belongs there: a folder with the files of the block, to write more into."""
    _check_names(block)
    check_motion_held(block)
    clashes = _tables_of((*OBSERVATIONS, *kinds_of(block)))
    with whole_folder(Path(folder), clashes) as work:
        _write_files(block, work)
        yield work


def _check_names(block: Block) -> None:
    """Raise BlockError for names that `read_block` would refuse."""
    for kind, names in (
        ("image", block.images),
        ("point", block.points),
        ("camera", block.sensors),
        ("strip", block.image_strip),
    ):
        distinct = list(dict.fromkeys(names))
        for name in [] if harmless(distinct) else distinct:
            if harm := harm_in(name):
                raise BlockError(f"the {kind} {quoted(name)} {harm}")


def _write_files(block: Block, folder: Path) -> None:
    """The files of `write_block`, into a folder that is being made."""
    settings, tables = _settings(block), _tables(block) | declared_tables(block)
    if block.frame.kind == "epsg":
        tables = tables_to_map(tables, block.frame)
    (folder / TOML).write_text(toml_text(settings), encoding="utf-8")
    for name, frame in tables.items():
        if len(frame) or (name in LAYOUTS and LAYOUTS[name].needed):
            # A first id that starts with # is quoted, or its line would be a comment.
            comment = frame.iloc[:, 0].astype(str).str.startswith("#").any()
            quoting: Literal[0, 2] = csv.QUOTE_NONNUMERIC if comment else csv.QUOTE_MINIMAL
            frame.to_csv(folder / f"{name}.csv", index=False, quoting=quoting)


def _settings(block: Block) -> dict[str, Any]:
    start, priors = block.start.unknowns, block.priors
    if priors.points != FREE:
        raise BlockError("block.toml can only say FREE of object points; reset their priors")
    cameras = {
        name: camera_section(Camera(block.sensors[name], start.interior[name], priors.interior[name]))
        for name in start.interior
    }
    mount_of = mounts_of(start.interior, start.mounts)
    for image, camera, mount in zip(block.images, block.image_camera, block.image_mount, strict=True):
        if mount != mount_of[camera]:
            raise BlockError(
                f"block.toml says of a camera, by the name of its mount, how all its images are mounted: image {image} "
                f"of camera {camera} has {f'mount {mount}' if mount else 'none'}; name a mount {camera} or default, "
                "and give a camera that was mounted in two ways two names"
            )
    own, known = [kind.group for kind in kinds_of(block) if kind not in OBSERVATIONS], set(block.points)
    return {
        "title": block.title,
        **({"converted_from": block.converted_from} if block.converted_from else {}),
        **({"observations": own} if own else {}),
        **({"partitions": list(block.partitions)} if block.partitions else {}),
        # Of those that are still among its points.
        **({"breaklines": lines} if (lines := [name for name in block.breaklines if name in known]) else {}),
        **({"reference_temperature_c": block.temperatures.reference_c} if block.temperatures else {}),
        "frame": frame_section(block.frame),
        "corrections": corrections_section(block.corrections, block.frame),
        "cameras": cameras,
        "mounts": {name: mount_section(mount, priors.mounts[name]) for name, mount in start.mounts.items()},
        "strips": {name: strip_section(bias, priors.strips[name]) for name, bias in start.strips.items()},
        "scanner": scanner_section(start.scanner, priors.scanner),
        "unknowns": unknown_sections(block),
        "datum": datum_section(block.datum),
        "georeferencing": _mode_section(block),
    }


def _tables_of(kinds: Iterable[Kind]) -> Clashes:
    """Whether a file is one that a block folder with these kinds of rows would be read from."""
    return {TOML, *(f"{name}.csv" for name in layouts(kinds))}.__contains__


def _mode_section(block: Block) -> dict[str, str]:
    """Nothing, or that the exterior orientation is held; what it was computed from must be gone (`variants.direct`)."""
    exterior = block.priors.exterior
    priors = (exterior.position, exterior.camera_from_object)
    if priors == (FREE, FREE):
        return {}
    sensors = len(block.stations.who) or len(block.attitudes.image)
    if priors == (FIXED, FIXED) and block.start.image_known.all() and not sensors:
        return {"mode": "direct"}
    raise BlockError(
        "block.toml can say of exterior orientation that all of it is FREE, or FIXED at known values and no station or "
        "attitude observed; reset its priors, or hold it by jaxphoto.variants.direct"
    )


def _tables(block: Block) -> dict[str, pd.DataFrame]:
    images, points = np.array(block.images, object), np.array(block.points, object)
    rows = block.image_points
    xy, sigma = np.asarray(rows.xy), np.asarray(rows.sigma)
    position = np.asarray(block.start.unknowns.points)[block.start.point_known]
    attitudes = pd.DataFrame(
        {"image": images[block.attitudes.image]}
        | _columns(ATTITUDE, np.rad2deg(block.attitudes.roll_pitch_yaw))
        | _columns(SIGMA_ATTITUDE, np.rad2deg(block.attitudes.sigma))
    )
    return {
        "images": _images(block),
        "image_points": pd.DataFrame(
            {"image": images[rows.image], "point": points[rows.point]}
            | {"x_mm": xy[:, 0], "y_mm": xy[:, 1], "sigma_x_mm": sigma[:, 0], "sigma_y_mm": sigma[:, 1]}
        ),
        "control_points": pd.concat(
            [
                _xyz_rows("point", points, given).assign(role=role)
                for role, given in (("control", block.control), ("fixed", block.fixed), ("check", block.check))
            ],
            ignore_index=True,
        ),
        "stations": _with_motion(_xyz_rows("image", images, block.stations), block, VELOCITY),
        "attitudes": _with_motion(attitudes, block, RATE),
        "object_points": pd.DataFrame({"point": points[block.start.point_known]} | _columns(XYZ, position)),
        "surfaces": surface_table(block),
    }


def _images(block: Block) -> pd.DataFrame:
    exterior, known = block.start.unknowns.exterior, block.start.image_known
    columns: dict[str, Any] = {"image": block.images, "camera": block.image_camera}
    if any(block.image_strip):
        columns["strip"] = block.image_strip
    columns |= block.partitions
    times = np.asarray(block.image_time if block.flight_time is None else block.flight_time)
    if times.any() or block.start.unknowns.strips:
        # To a nanosecond: the decimals that the file had.
        columns["time_s"] = np.round(times + block.middle_s, 9) + 0.0 if block.middle_s else times
    if block.temperatures is not None:
        columns["temperature_c"] = np.asarray(block.temperatures.celsius)
    if known.any():
        values = np.hstack([np.asarray(exterior.position), np.rad2deg(exterior.omega_phi_kappa)])
        values = np.where(known[:, None], values, math.nan)
        columns |= _columns((*XYZ, *ANGLES), values)
    return pd.DataFrame(columns)


def _with_motion(table: pd.DataFrame, block: Block, columns: tuple[str, ...]) -> pd.DataFrame:
    if block.motion is None:
        return table
    values = block.motion.velocity if columns == VELOCITY else np.rad2deg(block.motion.rate)
    place = pd.Index(block.images).get_indexer(pd.Index(table["image"]))
    return table.assign(**_columns(columns, np.asarray(values)[place]))


def _xyz_rows(id_column: str, ids: np.ndarray, rows: AbstractCoordinates) -> pd.DataFrame:
    """One line per point or image; coordinates that are not observed, and sigmas of zero, are left empty."""
    line, who = pd.factorize(np.asarray(rows.who))
    table = np.full((len(who), 6), math.nan)
    table[line, rows.axis] = rows.value
    table[line, np.asarray(rows.axis) + 3] = np.where(np.asarray(rows.sigma) > 0, rows.sigma, math.nan)
    return pd.DataFrame({id_column: ids[who]} | _columns((*XYZ, *SIGMA_XYZ), table))


def _columns(names: tuple[str, ...], values: np.ndarray) -> dict[str, np.ndarray]:
    return {name: np.asarray(values)[:, j] for j, name in enumerate(names)}
