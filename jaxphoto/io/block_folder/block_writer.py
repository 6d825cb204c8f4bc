"""Write a `Block` as a block folder, atomically."""

import csv
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from jaxphoto.block import Block
from jaxphoto.errors import BlockError
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.block_folder.declared_tables import declared_tables, kinds_of
from jaxphoto.io.block_folder.flight import check_motion_held
from jaxphoto.io.block_folder.map_tables import tables_to_map
from jaxphoto.io.block_folder.parameters import mounts_of, parameters_section, scanner_section, unknown_sections
from jaxphoto.io.block_folder.settings import corrections_section, datum_section, frame_section
from jaxphoto.io.block_folder.table_layout import (
    ANGLES,
    ATTITUDE,
    FOOT,
    LAYOUTS,
    NORMAL,
    RATE,
    SIGMA_ATTITUDE,
    SIGMA_XYZ,
    TOML,
    TURN,
    VELOCITY,
    XYZ,
)
from jaxphoto.io.toml import toml_text
from jaxphoto.observations import OBSERVATIONS, AbstractCoordinates
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import FIXED, FREE
from jaxphoto.writing import whole_folder


@outside_transformations
def write_block(block: Block, folder: str | Path) -> None:
    """Write `block` as a folder that `read_block` reads as the same block, with identical floating-point values.

    Angles are written in degrees, times on the clock of the original file, and coordinates of an `epsg` frame in its
    coordinate system (1e-6 m): these agree to rounding only. Velocities are written for images with a station, rates
    for images with an attitude. A block that jaxphoto wrote to `folder` is replaced; other files are retained
    (`whole_folder`).

    Raises InputError if `folder` contains a block or file that jaxphoto did not write. Raises
    BlockError for priors that block.toml cannot represent.
    """
    with whole_block(block, folder):
        pass


@contextmanager
def whole_block(block: Block, folder: str | Path) -> Iterator[Path]:
    """Yield a temporary folder with the files of `write_block`; the caller may add files before it becomes `folder`."""
    check_motion_held(block)
    with whole_folder(Path(folder)) as work:
        _write_files(block, work)
        yield work


def _write_files(block: Block, folder: Path) -> None:
    settings, tables = _settings(block), _tables(block) | declared_tables(block)
    if block.frame.kind == "epsg":
        tables = tables_to_map(tables, block.frame)
    (folder / TOML).write_text(toml_text(settings), encoding="utf-8")
    for name, frame in tables.items():
        if len(frame) or (name in LAYOUTS and LAYOUTS[name].required):
            # Quote ids that start with #: unquoted, the first id of a line would make the line a comment.
            comment = frame.iloc[:, 0].astype(str).str.startswith("#").any()
            quoting: Literal[0, 2] = csv.QUOTE_NONNUMERIC if comment else csv.QUOTE_MINIMAL
            frame.to_csv(folder / f"{name}.csv", index=False, quoting=quoting)


def _settings(block: Block) -> dict[str, Any]:
    start, priors = block.start.unknowns, block.priors
    if priors.points != FREE:
        raise BlockError("block.toml cannot represent priors of object points; reset them to FREE")
    mount_of = mounts_of(start.interior, start.mounts)
    for image, camera, mount in zip(block.images, block.image_camera, block.image_mount, strict=True):
        if mount != mount_of[camera]:
            raise BlockError(
                f"image {image} of camera {camera} has {f'mount {mount}' if mount else 'no mount'}, but block.toml "
                f"allows one mount per camera; name it {camera} or default, and split a camera with two mounts into two"
            )
    optional = {
        "converted_from": block.converted_from,
        "observations": [kind.group for kind in kinds_of(block) if kind not in OBSERVATIONS],
        "partitions": list(block.partitions),
    }
    return {
        "title": block.title,
        **{key: value for key, value in optional.items() if value},
        **({"reference_temperature_c": block.temperatures.reference_c} if block.temperatures else {}),
        "frame": frame_section(block.frame),
        "corrections": corrections_section(block.corrections, block.frame),
        "cameras": {
            name: camera_section(Camera(block.sensors[name], start.interior[name], priors.interior[name]))
            for name in start.interior
        },
        "mounts": {name: parameters_section(mount, priors.mounts[name]) for name, mount in start.mounts.items()},
        "strips": {name: parameters_section(bias, priors.strips[name]) for name, bias in start.strips.items()},
        "scanner": scanner_section(start.scanner, priors.scanner),
        "unknowns": unknown_sections(block),
        "datum": datum_section(block.datum),
        "georeferencing": _mode_section(block),
    }


def _mode_section(block: Block) -> dict[str, str]:
    """Return [georeferencing]: empty, or mode "direct" for fixed exterior orientation without observations."""
    exterior = block.priors.exterior
    priors = (exterior.position, exterior.camera_from_object)
    if priors == (FREE, FREE):
        return {}
    sensors = len(block.stations.who) or len(block.attitudes.image)
    if priors == (FIXED, FIXED) and block.start.image_known.all() and not sensors:
        return {"mode": "direct"}
    raise BlockError(
        "block.toml cannot represent these priors of exterior orientation; reset them to FREE, or fix all of it by "
        "jaxphoto.variants.direct"
    )


def _tables(block: Block) -> dict[str, pd.DataFrame]:
    images, points = np.array(block.images, object), np.array(block.points, object)
    rows, surfaces, scanner = block.image_points, block.surfaces, block.start.unknowns.scanner
    strips = np.array(tuple(scanner.shifts) if scanner is not None and scanner.shifts else ("",), object)
    known = block.start.point_known
    attitudes = block.attitudes
    roles = (("control", block.control), ("fixed", block.fixed), ("check", block.check))
    return {
        "images": _images(block),
        "image_points": pd.DataFrame(
            {"image": images[rows.image], "point": points[rows.point]}
            | _columns(("x_mm", "y_mm"), rows.xy)
            | _columns(("sigma_x_mm", "sigma_y_mm"), rows.sigma)
        ),
        "control_points": pd.concat(
            [_xyz_rows("point", points, given).assign(role=role) for role, given in roles], ignore_index=True
        ),
        "stations": _with_motion(_xyz_rows("image", images, block.stations), block, VELOCITY),
        "attitudes": _with_motion(
            pd.DataFrame(
                {"image": images[attitudes.image]}
                | _columns(ATTITUDE, np.rad2deg(attitudes.roll_pitch_yaw))
                | _columns(SIGMA_ATTITUDE, np.rad2deg(attitudes.sigma))
            ),
            block,
            RATE,
        ),
        "object_points": pd.DataFrame(
            {"point": points[known]} | _columns(XYZ, np.asarray(block.start.unknowns.points)[known])
        ),
        "surfaces": pd.DataFrame(
            {"point": points[surfaces.point]}
            | _columns(FOOT, surfaces.foot)
            | _columns(NORMAL, surfaces.normal)
            | _columns(TURN, surfaces.turn)
            | {"sigma_m": np.asarray(surfaces.sigma)}
            | ({"strip": strips[surfaces.strip]} if strips.any() else {})
        ),
    }


def _images(block: Block) -> pd.DataFrame:
    exterior, known = block.start.unknowns.exterior, block.start.image_known
    columns: dict[str, Any] = {"image": block.images, "camera": block.image_camera}
    if any(block.image_strip):
        columns["strip"] = block.image_strip
    columns |= block.partitions
    times = np.asarray(block.image_time if block.flight_time is None else block.flight_time)
    if times.any() or block.start.unknowns.strips:
        # Round to nanoseconds: this restores the decimals of the original file.
        columns["time_s"] = np.round(times + block.middle_s, 9) + 0.0 if block.middle_s else times
    if block.temperatures is not None:
        columns["temperature_c"] = np.asarray(block.temperatures.celsius)
    if known.any():
        values = np.hstack([np.asarray(exterior.position), np.rad2deg(exterior.omega_phi_kappa)])
        columns |= _columns((*XYZ, *ANGLES), np.where(known[:, None], values, math.nan))
    return pd.DataFrame(columns)


def _with_motion(table: pd.DataFrame, block: Block, columns: tuple[str, ...]) -> pd.DataFrame:
    if block.motion is None:
        return table
    values = block.motion.velocity if columns == VELOCITY else np.rad2deg(block.motion.rate)
    place = pd.Index(block.images).get_indexer(pd.Index(table["image"]))
    return table.assign(**_columns(columns, np.asarray(values)[place]))


def _xyz_rows(id_column: str, ids: np.ndarray, rows: AbstractCoordinates) -> pd.DataFrame:
    """Tabulate coordinates, one row per point or image; cells of unobserved coordinates and zero sigmas are empty."""
    line, who = pd.factorize(np.asarray(rows.who))
    table = np.full((len(who), 6), math.nan)
    table[line, rows.axis] = rows.value
    table[line, np.asarray(rows.axis) + 3] = np.where(np.asarray(rows.sigma) > 0, rows.sigma, math.nan)
    return pd.DataFrame({id_column: ids[who]} | _columns((*XYZ, *SIGMA_XYZ), table))


def _columns(names: tuple[str, ...], values: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(values)[:, j] for j, name in enumerate(names)}
