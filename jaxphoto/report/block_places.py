"""Where images and points of a block are, before adjusting or after: what the pictures of a block draw."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block

# Length of the drawn pyramid of an image, as a part of the extent of the block.
_PYRAMID = 0.06
# Around the format, and to each corner from the projection centre (None), so that one line draws a pyramid.
_AROUND = (0, 1, 2, 3, 0, None, 0, None, 1, None, 2, None, 3)
_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2


class BlockPlaces(NamedTuple):
    """Positions in the system of the block (m), and whose are known."""

    stations: Float[np.ndarray, "images 3"]
    points: Float[np.ndarray, "points 3"]
    image_known: Bool[np.ndarray, "images"]
    point_known: Bool[np.ndarray, "points"]
    control: Int[np.ndarray, "control"]
    """Numbers of control points, weighted or fixed, that have a place."""
    check: Int[np.ndarray, "check"]
    strips: tuple[Int[np.ndarray, "of_strip"], ...]
    """Numbers of the images of each strip, in the order of the block."""

    @property
    def extent(self) -> float:
        """Of all known images along the axis in which it is largest (m)."""
        known = self.stations[self.image_known]
        return float(np.ptp(known, axis=0).max()) or 1.0 if len(known) else 1.0

    def ties(self, most: int) -> Int[np.ndarray, "drawn"]:
        """Numbers of known points; of more than `most` every so manyeth."""
        known = np.flatnonzero(self.point_known)
        return known[:: max(1, -(-len(known) // most))]


def places_of(source: Block | Adjustment) -> BlockPlaces:
    """Of an adjusted block the estimates; of a block what is known to start with, of coordinates that are observed."""
    block, found = (source, _given(source)) if isinstance(source, Block) else (source.block, _adjusted(source))
    stations, points, image_known, point_known = found
    control = np.union1d(block.control.who, block.fixed.who).astype(int)
    check = np.unique(block.check.who).astype(int)
    strip = np.array(block.image_strip)
    strips = tuple(np.flatnonzero((strip == s) & image_known) for s in dict.fromkeys(strip[strip != ""]))
    control, check = (who[point_known[who]] for who in (control, check))
    return BlockPlaces(stations, points, image_known, point_known, control, check, strips)


def pyramids(source: Block | Adjustment, places: BlockPlaces, most: int) -> Float[np.ndarray, "images corners 3"]:
    """For each image a line along the edges of the pyramid from its projection centre to its format, which is drawn a
    part of the block's extent away; of more than `most` images, for every so manyeth."""
    block, start = (source, source.start.unknowns) if isinstance(source, Block) else (source.block, source.unknowns)
    turned = places.image_known & (np.asarray(block.start.image_known, bool) | (source is not block))
    images = np.flatnonzero(turned)
    images = images[:: max(1, -(-len(images) // most))]
    length, rotation = _PYRAMID * places.extent, np.asarray(start.exterior.camera_from_object)
    lines = np.zeros((len(images), len(_AROUND), 3))
    for line, i in zip(lines, images, strict=True):
        sensor, c = block.sensors[block.image_camera[i]], float(start.interior[block.image_camera[i]].c)
        corners = np.column_stack([_CORNERS * [sensor.width_mm, sensor.height_mm], np.full(4, -c)]) * (length / c)
        frame = places.stations[i] + corners @ rotation[i]
        line[:] = [places.stations[i] if k is None else frame[k] for k in _AROUND]
    return lines


def _adjusted(adjusted: Adjustment) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    stations, points = np.asarray(adjusted.unknowns.exterior.position), np.asarray(adjusted.unknowns.points)
    return stations, points, np.ones(len(stations), bool), np.ones(len(points), bool)


def _given(block: Block) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    start = block.start
    stations, points = (np.array(v, float) for v in (start.unknowns.exterior.position, start.unknowns.points))
    known: list[np.ndarray] = []
    for places, given, groups in (
        (stations, start.image_known, (block.stations,)),
        (points, start.point_known, (block.control, block.fixed, block.check)),
    ):
        has = np.repeat(np.asarray(given, bool)[:, None], 3, axis=1)
        for rows in groups:
            unknown = ~has[rows.who, rows.axis]
            places[rows.who[unknown], rows.axis[unknown]] = np.asarray(rows.value)[unknown]
            has[rows.who, rows.axis] = True
        # In plan X and Y are enough: a point that is held in height only has no place.
        known.append(np.asarray(has[:, :2].all(axis=1)))
    return stations, points, known[0], known[1]
