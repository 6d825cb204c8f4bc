"""Oriented photographs brought to the positions that their files tell, which become observed stations.

A network of photographs has a frame and a scale of its own. The similarity that takes its projection centres to the
recorded positions is found of those that agree with one another: one receiver that jumps turns no block. Positions
that disagree are left out, each named.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxphoto.block import Block, Datum, Frame
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.observations import StationRows
from jaxphoto.procedures.orientation.onto_known import Similarity, similarity_between

SIGMA_M = (2.0, 2.0, 4.0)
"""Of positions of a receiver without corrections, east, north and up, where the file says none and they scatter less:
over the minutes of a flight most errors of GPS are common (SPS Performance Standard, 2020: 95 % within 8 m in plan and
13 m in height, once a position). Variance components tell more."""
# Samples of three positions: where 40 % are wrong, one in five is right throughout, and 200 hold one surely.
_SAMPLES = 200
# Of the median distance of all from where they should be: six standard deviations of a normal error in space.
_BEYOND = 4.0
_LEAST = 3


class GeoreferencedPhotographs(NamedTuple):
    """A block in a local frame of the map system, with stations; how they agree with the photographs."""

    block: Block
    images: tuple[str, ...]
    """Those that have a position; rows of what follows."""
    offsets_m: Float[np.ndarray, "images 3"]
    """Recorded minus that of the network after the similarity: east, north, up."""
    used: Bool[np.ndarray, "images"]
    sentences: tuple[str, ...]


def georeference_photographs(
    block: Block, positions: Mapping[str, Gps | None], code: int | None = None
) -> GeoreferencedPhotographs:
    """`block`, oriented as a free network, in the EPSG system `code` (else UTM), with the `positions` of its images.

    The stations' standard deviations are those of the file, else `SIGMA_M`. Heights are taken as the files have them.

    Raises InputError where fewer than three positions agree or all lie on a line, and for a code that is unknown.
    """
    known = {name: gps for name in block.images if (gps := positions.get(name)) and gps.altitude_m is not None}
    if len(known) < _LEAST:
        raise InputError(
            f"{len(known)} of {len(block.images)} photographs have a position with a height in their files; three tell "
            "place, scale and attitude of a block"
        )
    places = np.array([(g.longitude_deg, g.latitude_deg, g.altitude_m) for g in known.values()], float)
    middle = np.median(places, axis=0)
    origin = (round(float(middle[0]), 4), round(float(middle[1]), 4), 0.0)
    code = utm_of(*origin[:2]) if code is None else code
    here = MapFrame(code, None, origin).local_from_place(places)
    image = np.array([block.images.index(name) for name in known])
    there = np.asarray(block.start.unknowns.exterior.position, float)[image]
    similarity, used = _agreeing(there, here)
    sigma = _sigmas(list(known.values()), (here - similarity.of(there))[used])
    similarity = _nearest(similarity, there[used], here[used], sigma[used])
    rows, axis = np.flatnonzero(used).repeat(3), np.tile(np.arange(3), used.sum())
    stations = StationRows(image[rows], axis, here[rows, axis], sigma[rows, axis])
    placed = dataclasses.replace(
        _moved(block, similarity),
        stations=stations,
        datum=Datum(),
        frame=Frame("epsg", code, None, origin=origin),
    )
    offsets = here - similarity.of(there)
    said = tuple(_said(code, known, offsets, used, sigma))
    return GeoreferencedPhotographs(placed, tuple(known), offsets, used, said)


def utm_of(longitude_deg: float, latitude_deg: float) -> int:
    """The EPSG code of the zone of UTM (WGS 84) of a place."""
    area = AreaOfInterest(longitude_deg, latitude_deg, longitude_deg, latitude_deg)
    found = query_utm_crs_info(datum_name="WGS 84", area_of_interest=area)
    if not found:
        raise InputError(
            f"there is no zone of UTM at {longitude_deg:.3f}, {latitude_deg:.3f} degrees; give the EPSG code of a map "
            "system"
        )
    return int(found[0].code)


def _agreeing(there: Float[np.ndarray, "n 3"], here: Float[np.ndarray, "n 3"]) -> tuple[Similarity, np.ndarray]:
    """The similarity of most positions, and which agree with it (least median of distances, then least squares)."""
    n = len(here)
    distance = lambda s: np.linalg.norm(here - s.of(there), axis=1)  # noqa: E731
    whole = similarity_between(there, here)
    if whole is None:
        raise InputError(
            f"the {n} positions of the photographs lie on a line, which leaves a turn about it open: fly a cross "
            "strip, or measure control points"
        )
    rng = np.random.default_rng(0)
    samples = [rng.choice(n, 3, replace=False) for _ in range(_SAMPLES)]
    tried = [s for pick in samples if (s := similarity_between(there[pick], here[pick])) is not None]
    best = min([whole, *tried], key=lambda s: float(np.median(distance(s))))
    used = np.ones(n, bool)
    for _ in range(10):
        off = distance(best)
        agree = off <= _BEYOND * np.median(off)
        found = similarity_between(there[agree], here[agree])
        if found is None or (agree == used).all():
            break
        best, used = found, agree
    return best, used


def _sigmas(known: list[Gps], offsets: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """What the files say; of those that say nothing `SIGMA_M`, or the scatter where that is more."""
    plan = max(SIGMA_M[0], float(np.sqrt(np.mean(offsets[:, :2] ** 2))))
    height = max(SIGMA_M[2], float(np.sqrt(np.mean(offsets[:, 2] ** 2))))
    return np.array([gps.stated_sigma_m or (plan, plan, height) for gps in known])


def _nearest(
    start: Similarity, there: Float[np.ndarray, "n 3"], here: Float[np.ndarray, "n 3"], sigma: Float[np.ndarray, "n 3"]
) -> Similarity:
    """The similarity of least squares with these weights.

    An adjustment that began elsewhere would have to turn the whole block, in steps that images allow: hundreds.
    """

    def at(x: np.ndarray) -> Similarity:
        turn = Rotation.from_rotvec(x[3:6]).as_matrix() @ start.turn
        return Similarity(x[:3], turn, float(np.exp(x[6])))

    # The shift is that of the middle, which a turn leaves where it is.
    middle = there.mean(axis=0)
    residual = lambda x: np.ravel((here - at(x).of(there - middle)) / sigma)  # noqa: E731
    begin = np.concatenate([start.of(middle[None])[0], np.zeros(3), [np.log(start.scale)]])
    best = at(least_squares(residual, begin, x_scale="jac").x)
    return best._replace(shift=best.shift - best.scale * best.turn @ middle)


def _moved(block: Block, s: Similarity) -> Block:
    """`block` whose start is brought to another frame."""
    unknowns = block.start.unknowns
    exterior = dataclasses.replace(
        unknowns.exterior,
        position=s.of(np.asarray(unknowns.exterior.position, float)),  # type: ignore[arg-type]
        camera_from_object=np.asarray(unknowns.exterior.camera_from_object, float) @ s.turn.T,
    )
    unknowns = dataclasses.replace(unknowns, exterior=exterior, points=s.of(np.asarray(unknowns.points, float)))
    return dataclasses.replace(block, start=dataclasses.replace(block.start, unknowns=unknowns))


def _said(code: int, known: Mapping[str, Gps], offsets: np.ndarray, used: np.ndarray, sigma: np.ndarray):
    n, own = len(known), sum(g.sigma_m is not None for g in known.values())
    plan, height = np.hypot(*offsets[used, :2].T), np.abs(offsets[used, 2])
    yield (
        f"{used.sum()} of {n} positions agree with the network: medians {np.median(plan):.2g} m in plan, "
        f"{np.median(height):.2g} m in height; map system EPSG:{code}"
    )
    if own:
        yield f"standard deviations of {own} positions are those of their files (RTK)"
    if own < n:
        east, _, up = next(s for s, g in zip(sigma, known.values(), strict=True) if g.sigma_m is None)
        yield (
            f"{n - own} files do not say how good their positions are: {east:.2g} m east and north, {up:.2g} m up are "
            "taken to begin with"
        )
    yield "heights are as the files have them, which seldom say above what: the block is as high as they say"
    for name, off, good in zip(known, offsets, used, strict=True):
        if not good:
            told = ", ".join(f"{v:.1f}" for v in off)
            yield f"the position of {name} contradicts the others by {told} m (east, north, up) and is left out"
