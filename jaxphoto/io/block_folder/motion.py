"""Velocity and rate of turn at the exposures, from columns of stations.csv and attitudes.csv."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.arrays import on_device
from jaxphoto.block import Block, Motion
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import Mount, RigCamera
from jaxphoto.io.block_folder.images import Images
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.block_folder.table_layout import RATE, VELOCITY
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import Attitudes, RelativeAttitudes, RelativePositions, RigPlaces, RigTurns, StationRows
from jaxphoto.unknowns import FIXED, Unknowns, late_cameras


class ObservedFlight(NamedTuple):
    """What is observed of stations, attitudes and motion, and of which images velocity and rate are known."""

    stations: StationRows
    attitudes: Attitudes
    motion: Motion | None
    velocity_known: np.ndarray
    rate_known: np.ndarray


def read_motion(stations: Table, attitudes: Table, images: Images) -> tuple[Motion | None, np.ndarray, np.ndarray]:
    """The motion that the tables give (None where they have no such columns), and the images whose parts are known."""
    velocity, velocity_known = _columns(stations, VELOCITY, images)
    rate, rate_known = _columns(attitudes, RATE, images)
    motion = None
    if velocity_known.any() or rate_known.any():
        motion = Motion(on_device(velocity), on_device(np.deg2rad(rate)))
    return motion, velocity_known, rate_known


def check_time_offsets(
    flight: ObservedFlight,
    rows: Iterable[Any],
    image_mount: tuple[str, ...],
    mounts: dict[str, Mount],
    priors: dict[str, Mount],
    images: Images,
    file: str,
) -> None:
    """Raise BlockError where a time offset should act on a station or attitude whose motion is not known.

    So it does on those of `rows` that are relative.
    """
    positions, turns = (
        [index for of in rows if isinstance(of, kind) for _, index in of.indices()]
        for kind in (RelativePositions, RelativeAttitudes)
    )
    offset = {
        name for name, mount in mounts.items() if priors[name].time_offset != FIXED or float(mount.time_offset) != 0
    }
    uses = np.array([mount in offset for mount in image_mount])
    for who, known, table, columns in (
        (np.concatenate([flight.stations.who, *positions]), flight.velocity_known, "stations.csv", VELOCITY),
        (np.concatenate([flight.attitudes.image, *turns]), flight.rate_known, "attitudes.csv", RATE),
    ):
        for image in who[uses[who] & ~known[who]][:1]:
            raise images.table.misfit(
                image,
                f"the time_offset of [mounts.{image_mount[image]}] in {file} needs the motion of image "
                f"{images.ids[image]}; give a [trajectory], add {', '.join(columns)} to {table}, or make time_offset "
                '"fixed" at zero',
            )


def without_heads(flight: ObservedFlight, images: Images, image_mount: tuple[str, ...], rig: Section) -> ObservedFlight:
    """Without stations and attitudes of cameras that the rig alone says how they sit, having no mount."""
    head = np.array([c in rig and not m for c, m in zip(images.cameras, image_mount, strict=True)], bool)
    stations, attitudes = flight.stations, flight.attitudes
    own, turned = ~head[np.asarray(stations.who)], ~head[np.asarray(attitudes.image)]
    return flight._replace(
        stations=stations.take(own),
        attitudes=attitudes.take(turned),
    )


def check_rig_delays(
    flight: ObservedFlight, rows: Iterable[Any], start: Unknowns, priors: Unknowns, images: Images
) -> None:
    """Raise BlockError where a camera of a rig exposes late beside a reference whose motion is not known."""
    known = flight.velocity_known & flight.rate_known
    for reference, camera in _late_pairs(rows, images.cameras, late_cameras(start, priors)):
        if not known[reference]:
            raise images.table.misfit(
                reference,
                f"the delay of [unknowns.{RigCamera.kind}.{camera}] needs the motion of image "
                f"{images.ids[reference]}; give a [trajectory], add {', '.join(VELOCITY)} to stations.csv and "
                f'{", ".join(RATE)} to attitudes.csv, or make delay "fixed" at zero',
            )


def check_motion_held(block: Block) -> None:
    """Raise BlockError where a folder could not hold the motion that the delay of a camera in a rig needs."""
    late = late_cameras(block.start.unknowns, block.priors)
    held = set(np.asarray(block.stations.who).tolist()) & set(np.asarray(block.attitudes.image).tolist())
    for reference, camera in _late_pairs(block.more, block.image_camera, late):
        if reference not in held:
            raise BlockError(
                f"the delay of {RigCamera.kind}[{camera}] needs the motion of image {block.images[reference]}, which a "
                "folder holds beside its station and its attitude: give it both, or hold the delay fixed at zero"
            )


def _late_pairs(rows: Iterable[Any], cameras: Sequence[str], late: Collection[str]) -> Iterator[tuple[int, str]]:
    """Of photographs that expose late: the image of the reference, and the camera that is late beside it."""
    for of in (of for of in rows if isinstance(of, RigPlaces | RigTurns)):
        for reference, image in zip(of.reference.tolist(), of.image.tolist(), strict=True):
            if cameras[image] in late:
                yield reference, cameras[image]


def _columns(table: Table, columns: tuple[str, ...], images: Images) -> tuple[np.ndarray, np.ndarray]:
    """Values by image, zero where unknown, and where they are known."""
    values = np.full((len(images.ids), 3), np.nan)
    given = np.stack([table.numbers(column, empty=True) for column in columns], axis=1)
    for line in np.flatnonzero(np.isnan(given).any(axis=1) & ~np.isnan(given).all(axis=1)):
        raise table.bad(line, f"the motion is given in part; fill in {', '.join(columns)}, or none of them")
    values[images.find(table)] = given
    known = ~np.isnan(values).any(axis=1)
    return np.nan_to_num(values), known
