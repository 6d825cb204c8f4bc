"""Oriented photographs brought to the positions that their files tell, which become observed stations.

A network of photographs has a frame and a scale of its own. The similarity that takes its projection centres to the
recorded positions is found of those that agree with one another: one receiver that jumps turns no block. Positions
that disagree are left out, each named.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from jaxphoto.block import Block, Datum, Frame
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.camera_attitude import CameraAttitude
from jaxphoto.georeferencing.datum_change import datum_change
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.georeferencing.map_frame import MapFrame, map_name
from jaxphoto.initial.rays import padded, padded_length
from jaxphoto.least_squares import least_squares
from jaxphoto.observations import CameraPositions
from jaxphoto.procedures.attitudes_of_photographs import RecordedTurn, recorded_turn, with_attitudes
from jaxphoto.procedures.georeferencing_words import LEVEL_WORDS, attitude_words, position_words
from jaxphoto.procedures.level_strip import is_line, level_turn
from jaxphoto.procedures.orientation.known_frame import Similarity, similarity_between
from jaxphoto.procedures.position_parts import position_parts, with_part_shifts
from jaxphoto.rotation import small_angles, small_rotation
from jaxphoto.variants import without_stations

SIGMA_M = (2.0, 2.0, 4.0)
"""Of positions of a receiver without corrections, east, north and up, where the file says none and they scatter less:
over the minutes of a flight most errors of GPS are common (SPS Performance Standard, 2020: 95 % within 8 m in plan and
13 m in height, once a position). Variance components tell more."""
# Samples of three positions: where 40 % are wrong, one in five is right throughout, and 200 hold one surely.
_SAMPLES = 200
# Of the median distance of all from where they should be: six standard deviations of a normal error in space.
_BEYOND = 4.0
# Of its own standard deviations, in space: one position in a thousand is farther off.
_BEYOND_OWN = 4.0
_LEAST = 3
# With attitudes, which give the turn.
_LEAST_TURNED = 2
# A block whose turn positions tell no better is better off in a frame of its own than in a map.
_HELD_RAD = 0.3
# Fewer positions than this do not tell how they scatter, and what is below (m) is luck.
_SCATTER, _FINEST_M = 6, 0.05
# Cameras of a flight look down or ahead; some up, on average by 30 degrees, only where the block stands on its head.
_LOOK_UP = 0.5


class GeoreferencedPhotographs(NamedTuple):
    """A block in a local frame of the map system, with stations; how they agree with the photographs."""

    block: Block
    images: tuple[str, ...]
    """Those that have a position; rows of what follows."""
    offsets_m: Float[np.ndarray, "images 3"]
    """Recorded minus that of the network after the similarity: east, north, up, less what parts are off by."""
    used: Bool[np.ndarray, "images"]
    sentences: tuple[str, ...]
    steps: tuple[str, ...] = ()
    """Of each step of the positions a sentence."""
    level: bool = False
    """Whether nothing tells the turn about the line of a strip, which is assumed to look down on average."""


def georeference_photographs(
    block: Block,
    positions: Mapping[str, Gps | None],
    code: int | None = None,
    attitudes: Mapping[str, CameraAttitude | None] | None = None,
    vertical: int | None = None,
    order: Sequence[str] = (),
) -> GeoreferencedPhotographs:
    """`block`, oriented as a free network, in the EPSG system `code` (else UTM), with the `positions` of its images.

    `vertical` is the EPSG code of the heights that the block is to have in files; None: above the ellipsoid.

    The positions are brought from WGS 84 to the datum of the system, heights above the ellipsoid as well; other heights
    are taken as the files have them. The stations' standard deviations are those of the file, else `SIGMA_M`.
    Where `attitudes` tell the turn better than the positions do, as of a single strip, they are observed as well.
    Positions that step, in the `order` of exposures (else of the block), have a shift by part (`position_steps`).

    Raises InputError where fewer than three positions agree, or all lie on a line that no attitudes turn, and for
    codes that are unknown, or heights whose geoid is not at hand.
    """
    known = {name: gps for name in block.images if (gps := positions.get(name)) and gps.altitude_m is not None}
    turned = {name for name in known if attitudes and attitudes.get(name) is not None}
    if len(known) < (_LEAST_TURNED if turned else _LEAST):
        raise InputError(
            f"{len(known)} of {len(block.images)} photographs have a position with a height in their files; three tell "
            "place, scale and attitude of a block, and two where they have attitudes as well"
        )
    received = np.array([(g.longitude_deg, g.latitude_deg, g.altitude_m) for g in known.values()], float)
    longitude, latitude, _ = np.median(received, axis=0).tolist()
    code = utm_of(round(longitude, 4), round(latitude, 4)) if code is None else code
    change = datum_change(code, longitude, latitude)
    # Heights of a geoid, of take-off or of nobody knows what do not change with the ellipsoid.
    ellipsoidal = np.array([g.heights == "ellipsoid" for g in known.values()])
    places = change.places(received, ellipsoidal)
    middle = np.median(places, axis=0)
    origin = (round(float(middle[0]), 4), round(float(middle[1]), 4), 0.0)
    frame = MapFrame(code, vertical, origin)
    here = frame.local_from_place(places)
    image = np.array([block.images.index(name) for name in known])
    there = np.asarray(block.start.unknowns.exterior.position, float)[image]
    given = np.array([gps.stated_sigma_m or SIGMA_M for gps in known.values()])
    at, sigma_of = (dict(zip(known, v, strict=True)) for v in (places, given))
    recorded = recorded_turn(block, attitudes or {}, at, sigma_of, frame)
    # Where no file says how good its positions are, they are judged by one another alone.
    own = given if any(gps.stated_sigma_m for gps in known.values()) else np.zeros_like(given)
    fitted = _fitted(block, image, here, given, own, recorded)
    # A receiver without corrections wanders by a part of its standard deviation within minutes, which is no step.
    parts = position_parts(list(known), order, here - fitted.similarity.of(there), here, np.median(given, axis=0))
    raw, here = here, here - parts.off_m
    if parts.sentences:
        fitted = _fitted(block, image, here, given, own, recorded)
    similarity, used, helping, level = fitted
    sigma = _sigmas(list(known.values()), (here - similarity.of(there))[used])
    if not level:
        similarity = _nearest(similarity, there[used], here[used], sigma[used], helping)
    _check_upright(block, similarity)
    rows, axis = np.flatnonzero(used).repeat(3), np.tile(np.arange(3), used.sum())
    stations = CameraPositions(image[rows], axis, raw[rows, axis], sigma[rows, axis])
    placed = dataclasses.replace(
        with_part_shifts(similarity.of_block(block), parts, image),
        stations=stations,
        datum=Datum(),
        frame=Frame("epsg", code, vertical, origin=origin),
    )
    if helping is not None:
        placed = with_attitudes(placed, helping)
    offsets = here - similarity.of(there)
    said = (
        *change.sentences(received, ellipsoidal),
        *position_words(map_name(code, vertical), block.images, known, offsets, used, sigma),
        *attitude_words(recorded, helping is not None, similarity.turn),
        *([LEVEL_WORDS] if level else ()),
    )
    return GeoreferencedPhotographs(placed, tuple(known), offsets, used, said, parts.sentences, level)


def as_they_scatter(
    placed: GeoreferencedPhotographs, positions: Mapping[str, Gps | None]
) -> GeoreferencedPhotographs | None:
    """The same where positions that no file calls good scatter less than was taken: with that as standard deviations.

    Of the similarity's seven parameters four are of plan and three of height. None where a file says how good positions
    are, for too few of them, and where they are as poor as was taken.
    """
    names = [name for name, used in zip(placed.images, placed.used, strict=True) if used]
    off, n = placed.offsets_m[placed.used], len(names)
    if n < _SCATTER or any((gps := positions[name]) and gps.stated_sigma_m for name in names):
        return None
    plan = max(float(np.sqrt(np.sum(off[:, :2] ** 2) / (2 * n - 4))), _FINEST_M)
    height = max(float(np.sqrt(np.sum(off[:, 2] ** 2) / (n - 3))), _FINEST_M)
    if plan >= SIGMA_M[0] or height >= SIGMA_M[2]:
        return None
    stations = placed.block.stations
    sigma = np.array([plan, plan, height])[np.asarray(stations.axis)]
    block = dataclasses.replace(placed.block, stations=dataclasses.replace(stations, sigma=sigma))
    said = (
        f"they scatter about the network by no more than {plan:.2g} m in plan and {height:.2g} m in height, which is "
        "taken: with more the turn of so small a block were open"
    )
    return placed._replace(block=block, sentences=(*placed.sentences, said))


def held_in_place(placed: GeoreferencedPhotographs, datum: Datum) -> GeoreferencedPhotographs | None:
    """The block where the positions brought it, held there by `datum` instead of by them.

    None where they do not tell its turn to some 17 degrees, and it is none of a strip that is assumed to be level.
    """
    stations = placed.block.stations
    here, sigma = (np.asarray(v, float).reshape(-1, 3) for v in (stations.value, stations.sigma))
    if not (placed.level or _turn_sigma(here, sigma) <= _HELD_RAD):
        return None
    return placed._replace(block=without_stations(dataclasses.replace(placed.block, datum=datum)))


class _Fitted(NamedTuple):
    """The similarity of most positions, which agree with it, and what tells the turn where they do not."""

    similarity: Similarity
    used: np.ndarray
    helping: RecordedTurn | None = None
    level: bool = False
    """Whether the turn about the line of a strip is assumed."""


def _fitted(
    block: Block,
    image: np.ndarray,
    here: Float[np.ndarray, "n 3"],
    given: Float[np.ndarray, "n 3"],
    own: Float[np.ndarray, "n 3"],
    recorded: RecordedTurn | str | None,
) -> _Fitted:
    """How positions `here` bring the network of `block` to their frame, with attitudes where these tell more."""
    exterior = block.start.unknowns.exterior
    there = np.asarray(exterior.position, float)[image]
    if isinstance(recorded, RecordedTurn):
        similarity, used = _turned(there, here, recorded.turn, own)
        if recorded.turn_sigma_rad < _turn_sigma(here[used], given[used]):
            return _Fitted(similarity, used, recorded)
    elif is_line(there):
        turn = level_turn(there, here, np.asarray(exterior.camera_from_object, float)[:, 2])
        similarity, used = _turned(there, here, turn, own)
        if not _turn_sigma(here[used], given[used]) <= _HELD_RAD:
            return _Fitted(similarity, used, level=True)
    return _Fitted(*_agreeing(there, here, own))


def _check_upright(block: Block, similarity: Similarity) -> None:
    """Raise InputError where the photographs would look at the sky.

    A flight is about level, so that mirrored positions fit a block that is turned over as well as the true ones fit it.
    """
    ahead = -np.asarray(block.start.unknowns.exterior.camera_from_object, float)[:, 2] @ similarity.turn.T
    if float(np.median(ahead[:, 2])) > _LOOK_UP:
        raise InputError(
            "with these positions the photographs would look at the sky: they are mirrored, as where X and Y, or "
            "latitude and longitude, have changed places or a sign is lost, or lie so near to a line that nothing "
            "tells the turn about it; correct them, or leave their file out"
        )


def _turn_sigma(here: Float[np.ndarray, "n 3"], sigma: Float[np.ndarray, "n 3"]) -> float:
    """How well positions tell the turn about their longest direction (rad): by what is across it."""
    across = np.linalg.svd(here - np.median(here, axis=0), compute_uv=False)
    # A part of what is across is the positions' own scatter.
    noise = float(np.sqrt(np.mean(np.median(sigma, axis=0) ** 2)))
    apart = np.sqrt(max(across[1] ** 2 - len(here) * noise**2, 0.0)) if len(across) > 1 else 0.0
    return noise / apart if apart > 0 else np.inf


def _turned(
    there: Float[np.ndarray, "n 3"],
    here: Float[np.ndarray, "n 3"],
    turn: Float[np.ndarray, "3 3"],
    own: Float[np.ndarray, "n 3"],
) -> tuple[Similarity, np.ndarray]:
    """Scale and shift of most positions where the turn is known, and which positions agree."""
    a = there @ turn.T
    one, other = np.triu_indices(len(here), 1)
    length = np.linalg.norm(a[one] - a[other], axis=1)
    scale = float(np.median(np.linalg.norm(here[one] - here[other], axis=1)[length > 0] / length[length > 0]))
    found, used = Similarity(np.median(here - scale * a, axis=0), turn, scale), np.ones(len(here), bool)
    for _ in range(10):
        agree = _agree(here - found.of(there), own)
        b, c = a[agree] - a[agree].mean(axis=0), here[agree] - here[agree].mean(axis=0)
        scale = float(np.sum(b * c) / np.sum(b * b))
        found = Similarity(here[agree].mean(axis=0) - scale * a[agree].mean(axis=0), turn, scale)
        if (agree == used).all():
            break
        used = agree
    return found, used


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


def _agree(offsets: Float[np.ndarray, "n 3"], own: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which are no farther off than most, or than their own standard deviations allow (zero: these are not known)."""
    off = np.linalg.norm(offsets, axis=1)
    allowed = np.linalg.norm(offsets / np.maximum(own, 1e-9), axis=1) <= _BEYOND_OWN
    return (off <= max(_BEYOND * float(np.median(off)), 1e-9)) | allowed


def _agreeing(
    there: Float[np.ndarray, "n 3"], here: Float[np.ndarray, "n 3"], own: Float[np.ndarray, "n 3"]
) -> tuple[Similarity, np.ndarray]:
    """The similarity of most positions, and which agree with it (least median of distances, then least squares)."""
    n = len(here)
    distance = lambda s: np.linalg.norm(here - s.of(there), axis=1)  # noqa: E731
    whole = similarity_between(there, here)
    if whole is None:
        raise InputError(
            f"the {n} positions of the photographs lie on a line, which leaves a turn about it open: fly a cross "
            "strip, measure control points, or give attitudes"
        )
    rng = np.random.default_rng(0)
    samples = [rng.choice(n, 3, replace=False) for _ in range(_SAMPLES)]
    tried = [s for pick in samples if (s := similarity_between(there[pick], here[pick])) is not None]
    best = min([whole, *tried], key=lambda s: float(np.median(distance(s))))
    used = np.ones(n, bool)
    for _ in range(10):
        agree = _agree(here - best.of(there), own)
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
    start: Similarity,
    there: Float[np.ndarray, "n 3"],
    here: Float[np.ndarray, "n 3"],
    sigma: Float[np.ndarray, "n 3"],
    recorded: RecordedTurn | None = None,
) -> Similarity:
    """The similarity of least squares with these weights, and the turn that attitudes say.

    An adjustment that began elsewhere would have to turn the whole block, in steps that images allow: hundreds.
    """

    # The shift is that of the middle, which a rotation leaves where it is.
    middle = there.mean(axis=0)
    n = padded_length(len(here))
    weight = padded(1 / sigma, n) * (np.arange(n) < len(here))[:, None]
    turn, turn_weight = (start.turn, 0.0) if recorded is None else (recorded.turn, 1 / recorded.turn_sigma_rad)
    begin = start.of(middle[None])[0], start.turn, np.asarray(start.scale)
    rows = padded(there - middle, n), padded(here, n), weight
    shift, matrix, scale = map(
        np.asarray, call_compiled(_fitted_similarity, *begin, *rows, turn, np.asarray(turn_weight))
    )
    return Similarity(shift - scale * matrix @ middle, matrix, float(scale))


@eqx.filter_jit
def _fitted_similarity(shift, matrix, scale, there, here, weight, turn, turn_weight):
    """Shift, rotation and scale of least squares of the offsets, and of the angles to the rotation `turn`."""

    def at(x):
        return shift + x[:3], small_rotation(x[3:6]) @ matrix, scale * jnp.exp(x[6])

    def residuals(x, _):
        shift, matrix, scale = at(x)
        offsets = (here - shift - scale * there @ matrix.T) * weight
        return jnp.concatenate([offsets.ravel(), small_angles(matrix @ turn.T) * turn_weight])

    return at(least_squares(residuals, jnp.zeros(7), damping=1e-6).unknowns)
