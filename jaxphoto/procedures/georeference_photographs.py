"""Georeference oriented photographs by recorded positions, which become observed camera stations.

A free network has its own frame and scale. The similarity from its projection centres to the recorded positions is
estimated robustly, from positions that agree. Contradicting positions are rejected and reported.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Bool, Float
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from jaxphoto.block import Block, Datum, Frame
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError, counted, few
from jaxphoto.georeferencing.camera_attitude import CameraAttitude
from jaxphoto.georeferencing.datum_change import datum_change
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.georeferencing.map_frame import MapFrame, map_name
from jaxphoto.initial.rays import padded, padded_length
from jaxphoto.least_squares import least_squares
from jaxphoto.observations import CameraPositions
from jaxphoto.procedures.orientation.known_frame import Similarity, similarity_between
from jaxphoto.procedures.position_steps import position_parts, with_part_shifts
from jaxphoto.procedures.recorded_attitudes import RecordedRotation, recorded_rotation, with_attitudes
from jaxphoto.rotation import small_angles, small_rotation
from jaxphoto.variants import without_stations

SIGMA_M = (2.0, 2.0, 4.0)
"""Standard deviations of single-point GNSS positions (east, north, up), if the file has none and they scatter less.
Most GPS errors are common over the minutes of a flight (SPS Performance Standard, 2020: 95 % within 8 m in plan and
13 m in height). Variance components refine them.
"""
# Samples of three positions: with 40 % outliers, one in five samples is valid; 200 almost surely contain one.
_SAMPLES = 200
# Maximum ratio of a distance to the median distance: six standard deviations of a normal error in space.
_BEYOND = 4.0
# Maximum distance in standard deviations: exceeded by one position in a thousand.
_BEYOND_OWN = 4.0
_LEAST = 3
# With attitudes, which determine the rotation.
_LEAST_TURNED = 2
# Maximum standard deviation of the rotation from positions; above it a local frame is better.
_FIXED_RAD = 0.3
# Minimum number of positions for their scatter to be estimated, and its minimum (m).
_SCATTER, _FINEST_M = 6, 0.05
# Minimum upward component of the mean viewing direction of an inverted block.
_LOOK_UP = 0.5


class GeoreferencedPhotographs(NamedTuple):
    """Block in a local frame of the map system, with stations, and the agreement of positions with photographs."""

    block: Block
    images: tuple[str, ...]
    """Images with a position; rows of the following."""
    offsets_m: Float[np.ndarray, "images 3"]
    """Recorded minus network position after the similarity: east, north, up, without the shifts of parts."""
    used: Bool[np.ndarray, "images"]
    sentences: tuple[str, ...]
    steps: tuple[str, ...] = ()
    """One message per position step."""
    level: bool = False
    """True if the rotation about the line of a strip is undetermined, and assumed such that the photographs look down
    on average.
    """


def georeference_photographs(
    block: Block,
    positions: Mapping[str, Gps | None],
    code: int | None = None,
    attitudes: Mapping[str, CameraAttitude | None] | None = None,
    vertical: int | None = None,
    order: Sequence[str] = (),
) -> GeoreferencedPhotographs:
    """Transform `block`, a free network, to the EPSG system `code` (default UTM) by the `positions` of its images.

    `vertical` is the EPSG code of the block's heights in files; None: ellipsoidal. Positions are transformed from WGS
    84 to the datum of the system, as are ellipsoidal heights; other heights are used as recorded. Standard deviations
    are those of the file, otherwise `SIGMA_M`. If `attitudes` determine the rotation better than the positions (a
    single strip), they are observed, too. Positions with steps, in the `order` of exposures (default: of the block),
    have one shift per part (`position_steps`).

    Raises InputError if fewer than three positions agree or all lie on a line without attitudes, and for unknown codes
    and unavailable geoids.
    """
    usable = {name: gps for name in block.images if (gps := positions.get(name)) and gps.altitude_m is not None}
    turned = {name for name in usable if attitudes and attitudes.get(name) is not None}
    if len(usable) < (_LEAST_TURNED if turned else _LEAST):
        raise InputError(
            f"{len(usable)} of {len(block.images)} photographs have a position with height in their files; three are "
            "required, or two with attitudes"
        )
    received = np.array([(g.longitude_deg, g.latitude_deg, g.altitude_m) for g in usable.values()], float)
    longitude, latitude, _ = np.median(received, axis=0).tolist()
    code = utm_of(round(longitude, 4), round(latitude, 4)) if code is None else code
    change = datum_change(code, longitude, latitude)
    # Heights of a geoid, above take-off or of unknown reference do not change with the ellipsoid.
    ellipsoidal = np.array([g.heights == "ellipsoid" for g in usable.values()])
    places = change.places(received, ellipsoidal)
    middle = np.median(places, axis=0)
    origin = (round(float(middle[0]), 4), round(float(middle[1]), 4), 0.0)
    frame = MapFrame(code, vertical, origin)
    here = frame.local_from_place(places)
    image = np.array([block.images.index(name) for name in usable])
    there = np.asarray(block.start.unknowns.exterior.position, float)[image]
    sigmas = np.array([gps.stated_sigma_m or SIGMA_M for gps in usable.values()])
    at, sigma_of = (dict(zip(usable, v, strict=True)) for v in (places, sigmas))
    rotation = recorded_rotation(block, attitudes or {}, at, sigma_of, frame)
    # Without stated standard deviations, positions are judged by one another alone.
    own_sigmas = sigmas if any(gps.stated_sigma_m for gps in usable.values()) else np.zeros_like(sigmas)
    fitted = _fit(block, image, here, sigmas, own_sigmas, rotation)
    # Single-point GNSS drifts by a fraction of its standard deviation within minutes; that is no step.
    parts = position_parts(list(usable), order, here - fitted.similarity.of(there), here, np.median(sigmas, axis=0))
    raw, here = here, here - parts.off_m
    if parts.sentences:
        fitted = _fit(block, image, here, sigmas, own_sigmas, rotation)
    similarity, used, helping, level = fitted
    sigma = _sigmas(list(usable.values()), (here - similarity.of(there))[used])
    if not level:
        similarity = _least_squares_similarity(similarity, there[used], here[used], sigma[used], helping)
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
    messages = (
        *change.sentences(received, ellipsoidal),
        *position_messages(map_name(code, vertical), block.images, usable, offsets, used, sigma),
        *attitude_messages(rotation, helping is not None, similarity.turn),
        *([LEVEL_MESSAGE] if level else ()),
    )
    return GeoreferencedPhotographs(placed, tuple(usable), offsets, used, messages, parts.sentences, level)


def with_observed_scatter(
    placed: GeoreferencedPhotographs, positions: Mapping[str, Gps | None]
) -> GeoreferencedPhotographs | None:
    """Replace assumed standard deviations of positions by their scatter, if that is smaller.

    Of the similarity's seven parameters, four concern plan and three height. None if a file states standard deviations,
    positions are too few, or their scatter is not smaller.
    """
    names = [name for name, used in zip(placed.images, placed.used, strict=True) if used]
    offset, n = placed.offsets_m[placed.used], len(names)
    if n < _SCATTER or any((gps := positions[name]) and gps.stated_sigma_m for name in names):
        return None
    plan = max(float(np.sqrt(np.sum(offset[:, :2] ** 2) / (2 * n - 4))), _FINEST_M)
    height = max(float(np.sqrt(np.sum(offset[:, 2] ** 2) / (n - 3))), _FINEST_M)
    if plan >= SIGMA_M[0] or height >= SIGMA_M[2]:
        return None
    stations = placed.block.stations
    sigma = np.array([plan, plan, height])[np.asarray(stations.axis)]
    block = dataclasses.replace(placed.block, stations=dataclasses.replace(stations, sigma=sigma))
    message = (
        f"positions scatter by {plan:.2g} m in plan and {height:.2g} m in height; used as their standard deviations, "
        "as larger ones would leave the rotation of this small block undetermined"
    )
    return placed._replace(block=block, sentences=(*placed.sentences, message))


def with_fixed_datum(placed: GeoreferencedPhotographs, datum: Datum) -> GeoreferencedPhotographs | None:
    """Define the datum of the georeferenced block by `datum` instead of stations.

    None if positions determine the rotation worse than 17 degrees, unless the strip is assumed level.
    """
    stations = placed.block.stations
    here, sigma = (np.asarray(v, float).reshape(-1, 3) for v in (stations.value, stations.sigma))
    if not (placed.level or _rotation_sigma(here, sigma) <= _FIXED_RAD):
        return None
    return placed._replace(block=without_stations(dataclasses.replace(placed.block, datum=datum)))


class _Fit(NamedTuple):
    """Similarity, the positions that agree with it, and the source of the rotation if positions do not determine it."""

    similarity: Similarity
    used: np.ndarray
    helping: RecordedRotation | None = None
    level: bool = False
    """True if the rotation about the line of a strip is assumed."""


def _fit(
    block: Block,
    image: np.ndarray,
    here: Float[np.ndarray, "n 3"],
    sigmas: Float[np.ndarray, "n 3"],
    own_sigmas: Float[np.ndarray, "n 3"],
    recorded: RecordedRotation | str | None,
) -> _Fit:
    """Fit the network to positions `here`, with attitudes if these determine the rotation better."""
    exterior = block.start.unknowns.exterior
    there = np.asarray(exterior.position, float)[image]
    if isinstance(recorded, RecordedRotation):
        similarity, used = _fit_with_rotation(there, here, recorded.turn, own_sigmas)
        if recorded.turn_sigma_rad < _rotation_sigma(here[used], sigmas[used]):
            return _Fit(similarity, used, recorded)
    elif is_line(there):
        turn = level_rotation(there, here, np.asarray(exterior.camera_from_object, float)[:, 2])
        similarity, used = _fit_with_rotation(there, here, turn, own_sigmas)
        if not _rotation_sigma(here[used], sigmas[used]) <= _FIXED_RAD:
            return _Fit(similarity, used, level=True)
    return _Fit(*_fit_by_positions(there, here, own_sigmas))


def _check_upright(block: Block, similarity: Similarity) -> None:
    """Raise InputError if the photographs would look upwards.

    Stations of a flight are nearly coplanar: mirrored positions fit an inverted block as well.
    """
    ahead = -np.asarray(block.start.unknowns.exterior.camera_from_object, float)[:, 2] @ similarity.turn.T
    if float(np.median(ahead[:, 2])) > _LOOK_UP:
        raise InputError(
            "with these positions the photographs would look upwards: positions are mirrored (X and Y, or latitude and "
            "longitude exchanged, or a sign lost), or nearly on a line, which leaves the rotation about it "
            "undetermined. Correct or omit their file"
        )


def _rotation_sigma(here: Float[np.ndarray, "n 3"], sigma: Float[np.ndarray, "n 3"]) -> float:
    """Standard deviation of the rotation about the longest direction of the positions (rad), from their extent across
    it.
    """
    across = np.linalg.svd(here - np.median(here, axis=0), compute_uv=False)
    # The extent includes the scatter of the positions.
    noise = float(np.sqrt(np.mean(np.median(sigma, axis=0) ** 2)))
    apart = np.sqrt(max(across[1] ** 2 - len(here) * noise**2, 0.0)) if len(across) > 1 else 0.0
    return noise / apart if apart > 0 else np.inf


def _fit_with_rotation(
    there: Float[np.ndarray, "n 3"],
    here: Float[np.ndarray, "n 3"],
    turn: Float[np.ndarray, "3 3"],
    own_sigmas: Float[np.ndarray, "n 3"],
) -> tuple[Similarity, np.ndarray]:
    """Scale and shift for a known rotation by the positions that agree, and their mask."""
    a = there @ turn.T
    one, other = np.triu_indices(len(here), 1)
    length = np.linalg.norm(a[one] - a[other], axis=1)
    scale = float(np.median(np.linalg.norm(here[one] - here[other], axis=1)[length > 0] / length[length > 0]))
    similarity, used = Similarity(np.median(here - scale * a, axis=0), turn, scale), np.ones(len(here), bool)
    for _ in range(10):
        agree = _inliers(here - similarity.of(there), own_sigmas)
        b, c = a[agree] - a[agree].mean(axis=0), here[agree] - here[agree].mean(axis=0)
        scale = float(np.sum(b * c) / np.sum(b * b))
        similarity = Similarity(here[agree].mean(axis=0) - scale * a[agree].mean(axis=0), turn, scale)
        if (agree == used).all():
            break
        used = agree
    return similarity, used


def utm_of(longitude_deg: float, latitude_deg: float) -> int:
    """Return the EPSG code of the UTM zone (WGS 84) of a place."""
    area = AreaOfInterest(longitude_deg, latitude_deg, longitude_deg, latitude_deg)
    zones = query_utm_crs_info(datum_name="WGS 84", area_of_interest=area)
    if not zones:
        raise InputError(
            f"no UTM zone at {longitude_deg:.3f}, {latitude_deg:.3f} degrees; give the EPSG code of a map system"
        )
    return int(zones[0].code)


def _inliers(offsets: Float[np.ndarray, "n 3"], sigmas: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Mark offsets no larger than most, or within their own standard deviations (zero: unknown)."""
    distance = np.linalg.norm(offsets, axis=1)
    allowed = np.linalg.norm(offsets / np.maximum(sigmas, 1e-9), axis=1) <= _BEYOND_OWN
    return (distance <= max(_BEYOND * float(np.median(distance)), 1e-9)) | allowed


def _fit_by_positions(
    there: Float[np.ndarray, "n 3"], here: Float[np.ndarray, "n 3"], own_sigmas: Float[np.ndarray, "n 3"]
) -> tuple[Similarity, np.ndarray]:
    """Robust similarity (least median of distances, then least squares) and the mask of positions that agree."""
    n = len(here)
    distance = lambda s: np.linalg.norm(here - s.of(there), axis=1)  # noqa: E731
    whole = similarity_between(there, here)
    if whole is None:
        raise InputError(
            f"the {n} positions of the photographs lie on a line: the rotation about it is undetermined. Fly a cross "
            "strip, measure control points, or give attitudes"
        )
    rng = np.random.default_rng(0)
    samples = [rng.choice(n, 3, replace=False) for _ in range(_SAMPLES)]
    tried = [s for pick in samples if (s := similarity_between(there[pick], here[pick])) is not None]
    best = min([whole, *tried], key=lambda s: float(np.median(distance(s))))
    used = np.ones(n, bool)
    for _ in range(10):
        agree = _inliers(here - best.of(there), own_sigmas)
        similarity = similarity_between(there[agree], here[agree])
        if similarity is None or (agree == used).all():
            break
        best, used = similarity, agree
    return best, used


def _sigmas(positions: list[Gps], offsets: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Stated standard deviations; otherwise `SIGMA_M`, or the scatter if larger."""
    plan = max(SIGMA_M[0], float(np.sqrt(np.mean(offsets[:, :2] ** 2))))
    height = max(SIGMA_M[2], float(np.sqrt(np.mean(offsets[:, 2] ** 2))))
    return np.array([gps.stated_sigma_m or (plan, plan, height) for gps in positions])


def _least_squares_similarity(
    start: Similarity,
    there: Float[np.ndarray, "n 3"],
    here: Float[np.ndarray, "n 3"],
    sigma: Float[np.ndarray, "n 3"],
    recorded: RecordedRotation | None = None,
) -> Similarity:
    """Weighted least-squares similarity, with the rotation from attitudes as an observation.

    An adjustment from a worse start would rotate the whole block, in hundreds of steps.
    """

    # Shift of the centroid, which a rotation leaves fixed.
    middle = there.mean(axis=0)
    n = padded_length(len(here))
    weight = padded(1 / sigma, n) * (np.arange(n) < len(here))[:, None]
    turn, turn_weight = (start.turn, 0.0) if recorded is None else (recorded.turn, 1 / recorded.turn_sigma_rad)
    begin = start.of(middle[None])[0], start.turn, np.asarray(start.scale)
    rows = padded(there - middle, n), padded(here, n), weight
    shift, matrix, scale = map(
        np.asarray, call_compiled(_optimise_similarity, *begin, *rows, turn, np.asarray(turn_weight))
    )
    return Similarity(shift - scale * matrix @ middle, matrix, float(scale))


@eqx.filter_jit
def _optimise_similarity(shift, matrix, scale, there, here, weight, turn, turn_weight):
    """Estimate shift, rotation and scale from the offsets, and the angles to the rotation `turn`."""

    def at(x):
        return shift + x[:3], small_rotation(x[3:6]) @ matrix, scale * jnp.exp(x[6])

    def residuals(x, _):
        shift, matrix, scale = at(x)
        offsets = (here - shift - scale * there @ matrix.T) * weight
        return jnp.concatenate([offsets.ravel(), small_angles(matrix @ turn.T) * turn_weight])

    return at(least_squares(residuals, jnp.zeros(7), damping=1e-6).unknowns)


LEVEL_DEG = 5.0
"""Assumed standard deviation of the mean roll of a nadir strip."""
# Maximum ratio of width to length of a line.
_NARROW = 0.1


def is_line(centres: Float[np.ndarray, "n 3"]) -> bool:
    """Return True if projection centres lie on a line."""
    across = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
    return bool(across[1] < _NARROW * across[0])


def level_rotation(
    centres: Float[np.ndarray, "n 3"], positions: Float[np.ndarray, "n 3"], backwards: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "3 3"]:
    """Rotation of a network to a level frame: its line to that of the `positions`, as upright as possible on average.

    `backwards` are the camera axes of the network opposite to the viewing directions.
    """
    one, other = _axes(_line(centres), backwards.mean(axis=0)), _axes(_line(positions), np.array([0.0, 0.0, 1.0]))
    return other @ one.T


def _line(places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Direction from the first to the last places, by medians (robust to single outliers)."""
    half = len(places) // 2
    apart = places[half:] - places[: len(places) - half]
    return np.median(apart, axis=0)


def _axes(along: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Axes along, across and up, as columns."""
    x = along / np.linalg.norm(along)
    y = np.cross(up, x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


# Relative tolerance of equal height offsets, and minimum of such an offset (m).
_EQUAL, _ZERO_M = 0.1, 10.0
# Minimum ratio of the height offset to the offset in plan.
_HEIGHT_RATIO = 4.0

LEVEL_MESSAGE = (
    "positions on one line leave the rotation about it undetermined: photographs are assumed to look down on average, "
    f"to about {LEVEL_DEG:g} degrees, and heights tilt across the line by as much; attitudes, a cross strip or control "
    "points would determine it"
)


def position_messages(
    system: str,
    images: Sequence[str],
    positions: Mapping[str, Gps],
    offsets: Float[np.ndarray, "n 3"],
    used: Bool[np.ndarray, "n"],
    sigma: Float[np.ndarray, "n 3"],
) -> Iterator[str]:
    """Yield messages about the agreement of `positions` with the network (offsets: recorded minus network, m)."""
    n, stated = len(positions), [g.stated_sigma_m is not None for g in positions.values()]
    plan, height = np.hypot(*offsets[used, :2].T), np.abs(offsets[used, 2])
    yield (
        f"{used.sum()} of {n} positions agree with the network: medians {np.median(plan):.2g} m in plan, "
        f"{np.median(height):.2g} m in height; map system {system}"
    )
    if without := [name for name in images if name not in positions]:
        yield f"{counted(len(without), 'photograph')} without a position with height: {few(without)}"
    if any(stated):
        yield f"{sum(stated)} positions have standard deviations in their files"
    if not all(stated):
        east, _, up = sigma[stated.index(False)]
        yield (
            f"{stated.count(False)} positions have no standard deviation in their files: assumed {east:.2g} m east and "
            f"north, {up:.2g} m up"
        )
    names = np.array(list(positions), object)
    high = ~used & _other_height_datum(offsets, used)
    if high.any():
        yield (
            f"the heights of {high.sum()} photographs ({few(names[high].tolist())}) all differ by "
            f"{np.median(offsets[high, 2]):+.0f} m from the others: another height datum, such as take-off; rejected"
        )
    for name, offset in zip(names[~used & ~high], offsets[~used & ~high], strict=True):
        components = ", ".join(f"{v:z.1f}" for v in offset)
        yield f"the position of {name} differs by {components} m (east, north, up) from the others: rejected"


def _other_height_datum(offsets: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Mark rejected positions, two or more, that differ in height alone, all by the same amount."""
    plan = np.hypot(*offsets[:, :2].T)
    level = ~used & (np.abs(offsets[:, 2]) > np.maximum(_ZERO_M, _HEIGHT_RATIO * plan))
    if level.sum() < 2:
        return np.zeros(len(offsets), bool)
    middle = float(np.median(offsets[level, 2]))
    equal = level & (np.abs(offsets[:, 2] - middle) <= max(_EQUAL * abs(middle), 2 * _EQUAL * _ZERO_M))
    return equal if equal.sum() >= 2 else np.zeros(len(offsets), bool)


def attitude_messages(
    recorded: RecordedRotation | str | None, used: bool, turn: Float[np.ndarray, "3 3"]
) -> Iterator[str]:
    """Yield messages about the agreement of recorded attitudes with the network's `turn` to the map, and their use."""
    if isinstance(recorded, str):
        yield recorded
    if not isinstance(recorded, RecordedRotation):
        return
    apart = np.rad2deg(np.linalg.norm(scipy.spatial.transform.Rotation.from_matrix(turn @ recorded.turn.T).as_rotvec()))
    scatter, boresight = np.rad2deg([recorded.scatter_rad, recorded.turn_sigma_rad])
    words = f"{len(recorded.image)} recorded attitudes agree with one another to {scatter:.2g} degrees"
    if recorded.quarters:
        yield (
            f"the pictures are turned by {90 * recorded.quarters} degrees clockwise relative to the attitudes of their "
            "files, according to the positions: attitudes were turned likewise"
        )
    if used:
        yield (
            f"{words}; positions determine the rotation of the block less well: attitudes are observed, with a common "
            f"error of {boresight:.2g} degrees"
        )
    else:
        digits = f"{apart:.0f}" if apart >= 10 else f"{apart:.2g}"
        yield f"{words} and with the positions to {digits}; positions determine the rotation better: not used"
    if recorded.left_out:
        yield f"the attitudes of {few(list(recorded.left_out))} contradict the others: rejected"
