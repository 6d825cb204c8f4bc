"""Georeference oriented photographs by recorded positions, which become observed camera stations.

A free network has an arbitrary frame and scale. The similarity from its projection centres to the recorded positions is
estimated robustly from consistent positions. Contradicting positions are rejected and reported.

Each photograph gives the rotation from network to map: the product of its recorded and its oriented attitude. The
average determines the rotation about the line of a single strip, which positions do not determine. It contains the
common error of all attitudes (zero of a gimbal, mounting). As observations, attitudes therefore have a boresight with a
prior of that size.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Bool, Float, Int
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Block, Datum, Frame
from jaxphoto.compiling import call_compiled, jit_quickly
from jaxphoto.errors import InputError, counted, few
from jaxphoto.georeferencing import Mount
from jaxphoto.georeferencing.camera_attitude import CameraAttitude
from jaxphoto.georeferencing.datum_change import datum_change
from jaxphoto.georeferencing.map_frame import MapFrame, map_name
from jaxphoto.georeferencing.recorded_positions import Gps
from jaxphoto.initial.quaternions import average_rotation
from jaxphoto.initial.rays import padded, padded_length
from jaxphoto.least_squares import least_squares
from jaxphoto.observations import Attitudes, CameraPositions
from jaxphoto.procedures.orientation.blocks import Similarity, similarity_between
from jaxphoto.rotation import roll_pitch_yaw_from_matrix, small_angles, small_rotation
from jaxphoto.unknowns import FIXED, Weighted
from jaxphoto.variants import without_stations

BORESIGHT_DEG = (2.0, 2.0, 2.0)
"""Standard deviations (degrees) of the common error of the attitudes of a flight, about the camera's axes: gimbal or
mounting, and declination of a compass.
"""
# Maximum ratio of a deviation to the median deviation; minimum of this limit (degrees).
_BEYOND, _LEAST_DEG = 4.0, 5.0
# Median deviation (degrees) above which attitudes are contradictory.
_CONTRADICT_DEG = 15.0
# Minimum cosine between directions in the rotated network and of positions; pictures that software rotated by 90
# degrees contradict the attitudes of the sensor.
_OTHER_LINE = 0.5
# Maximum median relative error of distances for positions to determine directions; number of positions below which only
# distant pairs are used; minimum distance of these in standard deviations.
_TELLING, _FEW, _APART = 0.1, 6, 3.0
# Maximum number of photographs compared pairwise, as memory increases with its square.
_MOST = 500
# Name of the mount that a block folder applies to all cameras.
_MOUNT = "default"


class RecordedRotation(NamedTuple):
    """Rotation of a network by recorded attitudes."""

    image: np.ndarray
    """Images of the block whose attitudes agree."""
    local_from_camera: Float[np.ndarray, "n 3 3"]
    sigma_rad: Float[np.ndarray, "n 3"]
    """Standard deviations of roll, pitch, yaw."""
    turn: Float[np.ndarray, "3 3"]
    """Rotation from the network frame to the local frame."""
    turn_sigma_rad: float
    """Standard deviation of the rotation about a horizontal axis, including the boresight."""
    scatter_rad: float
    """RMS deviation of single attitudes from `turn`."""
    left_out: tuple[str, ...]


def recorded_rotation(
    block: Block,
    attitudes: Mapping[str, CameraAttitude | None],
    places: Mapping[str, Float[np.ndarray, "3"]],
    sigma_m: Mapping[str, Float[np.ndarray, "3"]],
    frame: MapFrame,
) -> RecordedRotation | str | None:
    """Estimate the rotation from the `attitudes` of images that also have `places` (longitude, latitude, height, +-
    `sigma_m`).

    Return None without attitudes, and a message if they contradict each other or the positions.
    """
    usable = [(k, name, a) for k, name in enumerate(block.images) if name in places and (a := attitudes.get(name))]
    if not usable:
        return None
    local = frame.local_from_place(np.array([places[name] for _, name, _ in usable], float))
    attitude = frame.local_from_level(local) @ np.array([a.level_from_camera for _, _, a in usable])
    network = np.asarray(block.start.unknowns.exterior.position, float)[[k for k, _, _ in usable]]
    sigma = np.linalg.norm([sigma_m[name] for _, name, _ in usable], axis=1)
    first = _rotation_of(block, usable, attitude)
    along = _cosine(network, local, sigma, first)
    if isinstance(first, RecordedRotation) and (along is None or along > _OTHER_LINE):
        return first
    if along is None:
        return first
    apart_deg = np.rad2deg(np.arccos(np.clip(along, -1, 1)))
    return (
        f"the attitudes of the files contradict the positions by {apart_deg:.0f} degrees (pictures rotated by a "
        "program?): not used"
    )


def _rotation_of(
    block: Block, usable: list[tuple[int, str, CameraAttitude]], attitude: Float[np.ndarray, "n 3 3"]
) -> RecordedRotation | str:
    """Return the rotation by attitudes (local from camera) of the `usable` images; a message if they contradict."""
    image = np.array([k for k, _, _ in usable])
    rotations = attitude @ np.asarray(block.start.unknowns.exterior.camera_from_object, float)[image]
    sigma = np.deg2rad([a.sigma_deg for _, _, a in usable])
    inlier, deviation = np.ones(len(rotations), bool), np.zeros(len(rotations))
    # Start at the rotation with the smallest median distance to all others, then average the rotations near it.
    some = rotations[_subset(len(rotations))]
    apart = _angles(np.einsum("nji,mjk->nmik", some, some))
    turn = some[np.argmin(np.median(apart, axis=1))]
    for _ in range(5):
        deviation = _angles(rotations @ turn.T)
        inlier = deviation <= max(_BEYOND * float(np.median(deviation)), np.deg2rad(_LEAST_DEG))
        turn, _ = average_rotation(rotations[inlier])
    apart_deg = np.rad2deg(np.median(deviation))
    if apart_deg > _CONTRADICT_DEG:
        return f"the attitudes of the files contradict the photographs by {apart_deg:.0f} degrees: not used"
    scatter = float(np.sqrt(np.mean(_angles(rotations[inlier] @ turn.T) ** 2)))
    level = np.sqrt(np.mean(sigma[inlier, :2] ** 2) / inlier.sum() + np.deg2rad(max(BORESIGHT_DEG[:2])) ** 2)
    lost = tuple(name for (_, name, _), good in zip(usable, inlier, strict=True) if not good)
    return RecordedRotation(image[inlier], attitude[inlier], sigma[inlier], turn, float(level), scatter, lost)


def _subset(n: int) -> Int[np.ndarray, "m"]:
    """Return evenly spaced indices of at most `_MOST` photographs."""
    return np.linspace(0, n - 1, min(n, _MOST)).astype(int)


def _cosine(
    network: Float[np.ndarray, "n 3"],
    local: Float[np.ndarray, "n 3"],
    sigma: Float[np.ndarray, "n"],
    recorded: RecordedRotation | str,
) -> float | None:
    """Return the median cosine between directions in the rotated network and on the ground; None if undetermined."""
    some = _subset(len(local))
    one, other = (some[k] for k in np.triu_indices(len(some), 1))
    if isinstance(recorded, str) or not len(one):
        return None
    a, b = ((v[one] - v[other]) for v in (network @ recorded.turn.T, local))
    there, here = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    far = (here >= np.median(here)) & (there > 0) & (here > 0)
    if len(local) < _FEW:
        far &= here > _APART * np.hypot(sigma[one], sigma[other])
    if not far.any():
        return None
    ratio = here[far] / there[far]
    if np.median(np.abs(ratio / np.median(ratio) - 1)) > _TELLING:
        return None
    return float(np.median(np.sum(a[far] * b[far], axis=1) / (there[far] * here[far])))


def with_attitudes(block: Block, recorded: RecordedRotation) -> Block:
    """Observe the attitudes, of a nadir camera with the top of its pictures forward."""
    angles = _roll_pitch_yaw(recorded.local_from_camera)
    zero = np.zeros(3)
    mount = Mount(as_jax_array(zero), as_jax_array(zero), as_jax_array(0.0), "right")  # type: ignore[arg-type]
    boresight = Weighted(zero, np.deg2rad(BORESIGHT_DEG))
    prior = Mount(FIXED, boresight, FIXED, "right")  # type: ignore[arg-type]
    unknowns = dataclasses.replace(block.start.unknowns, mounts={_MOUNT: mount})
    return dataclasses.replace(
        block,
        attitudes=Attitudes(recorded.image, as_jax_array(np.asarray(angles)), as_jax_array(recorded.sigma_rad)),
        image_mount=(_MOUNT,) * len(block.images),
        start=dataclasses.replace(block.start, unknowns=unknowns),
        priors=dataclasses.replace(block.priors, mounts={_MOUNT: prior}),
    )


def _angles(matrices: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n"]:
    """Return rotation angles (rad), from the chord, which is accurate for small angles."""
    chord = np.linalg.norm(matrices - np.eye(3), axis=(-2, -1))
    return 2 * np.arcsin(np.clip(chord / np.sqrt(8), 0, 1))


_roll_pitch_yaw = jit_quickly(jax.vmap(roll_pitch_yaw_from_matrix))


SIGMA_M = (2.0, 2.0, 4.0)
"""Default standard deviations (m) of single-point GNSS positions (east, north, up), if the file has none. Larger
scatter replaces them. Most GPS errors are common over the minutes of a flight (SPS Performance Standard, 2020: 95 %
within 8 m in plan and 13 m in height). Variance components refine them.
"""
# Number of samples of three positions: with 40 % outliers, one sample in five is valid.
_SAMPLES = 200
# Maximum distance in standard deviations: exceeded by one position in a thousand.
_BEYOND_OWN = 4.0
_LEAST = 3
# Minimum number of positions with attitudes, which determine the rotation.
_LEAST_TURNED = 2
# Maximum number of rejected positions with a message each.
_LISTED = 10
# Maximum standard deviation (rad) of the rotation from positions.
_FIXED_RAD = 0.3
# Minimum upward component of the mean viewing direction of an inverted block.
_LOOK_UP = 0.5


class GeoreferencedPhotographs(NamedTuple):
    """Block in a local frame of the map system, with stations, and the agreement of positions with photographs."""

    block: Block
    images: tuple[str, ...]
    """Images with a position, in the order of the rows of the following arrays."""
    offsets_m: Float[np.ndarray, "images 3"]
    """Recorded minus network position after the similarity: east, north, up."""
    used: Bool[np.ndarray, "images"]
    sentences: tuple[str, ...]


def georeference_photographs(
    block: Block,
    positions: Mapping[str, Gps | None],
    code: int | None = None,
    attitudes: Mapping[str, CameraAttitude | None] | None = None,
    vertical: int | None = None,
) -> GeoreferencedPhotographs:
    """Transform `block`, a free network, to the EPSG system `code` (default UTM) by the `positions` of its images.

    `vertical` is the EPSG code of the block's heights in files; None: ellipsoidal. Positions and ellipsoidal heights
    are transformed from WGS 84 to the datum of the system; other heights are used as recorded. Standard deviations come
    from the file, otherwise from `SIGMA_M`. If `attitudes` determine the rotation better than the positions (a single
    strip), they are also observed.

    Raises InputError if fewer than three positions agree, if they do not determine the rotation and there are no
    attitudes, and for unknown codes and unavailable geoids.
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
    # Heights above a geoid, take-off or unknown reference do not change with the ellipsoid.
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
    # Without stated standard deviations, test positions only by their median distance.
    own_sigmas = sigmas if any(gps.stated_sigma_m for gps in usable.values()) else np.zeros_like(sigmas)
    similarity, used = None, np.ones(len(here), bool)
    helping = rotation if isinstance(rotation, RecordedRotation) else None
    if helping is not None:
        similarity, used = _fit_with_rotation(there, here, helping.turn, own_sigmas)
        if not helping.turn_sigma_rad < _rotation_sigma(similarity.of(there)[used], sigmas[used]):
            similarity, helping = None, None
    if similarity is None:
        similarity, used = _fit_by_positions(there, here, own_sigmas)
        if not (uncertainty := _rotation_sigma(similarity.of(there)[used], sigmas[used])) <= _FIXED_RAD:
            raise InputError(
                f"the {len(usable)} positions of the photographs lie on a line or determine the rotation of the block "
                f"only to {np.rad2deg(uncertainty):.0f} degrees. Fly a cross strip, measure control points, or give "
                "attitudes or standard deviations of the positions"
            )
    sigma = _sigmas(list(usable.values()), (here - similarity.of(there))[used])
    similarity = _least_squares_similarity(similarity, there[used], here[used], sigma[used], helping)
    _check_upright(block, similarity)
    rows, axis = np.flatnonzero(used).repeat(3), np.tile(np.arange(3), used.sum())
    placed = dataclasses.replace(
        similarity.of_block(block),
        stations=CameraPositions(image[rows], axis, here[rows, axis], sigma[rows, axis]),
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
    )
    return GeoreferencedPhotographs(placed, tuple(usable), offsets, used, messages)


def with_fixed_datum(placed: GeoreferencedPhotographs, datum: Datum) -> GeoreferencedPhotographs:
    """Define the datum of the georeferenced block by `datum` instead of stations."""
    return placed._replace(block=without_stations(dataclasses.replace(placed.block, datum=datum)))


def _check_upright(block: Block, similarity: Similarity) -> None:
    """Raise InputError if the photographs would look upwards.

    Stations of a flight are nearly coplanar: mirrored positions also fit an inverted block.
    """
    if looks_up(block, similarity):
        raise InputError(
            "with these positions the photographs would look upwards: positions are mirrored (X and Y, or latitude and "
            "longitude exchanged, or a sign lost), or nearly on a line, which leaves the rotation about it "
            "undetermined. Correct or omit their file"
        )


def looks_up(block: Block, similarity: Similarity) -> bool:
    """Return True if the images look upwards after the transformation of the block by `similarity`."""
    ahead = -np.asarray(block.start.unknowns.exterior.camera_from_object, float)[:, 2] @ similarity.turn.T
    return float(np.median(ahead[:, 2])) > _LOOK_UP


def _rotation_sigma(network: Float[np.ndarray, "n 3"], sigma: Float[np.ndarray, "n 3"]) -> float:
    """Return the standard deviation (rad) of the rotation about the longest direction of the projection centres.

    It follows from the standard deviations of the positions and the extent of the network across that direction.
    """
    across = np.linalg.svd(network - network.mean(axis=0), compute_uv=False)
    noise = float(np.sqrt(np.mean(np.median(sigma, axis=0) ** 2)))
    return noise / float(across[1]) if len(across) > 1 and across[1] > 0 else np.inf


def _fit_with_rotation(
    there: Float[np.ndarray, "n 3"],
    here: Float[np.ndarray, "n 3"],
    turn: Float[np.ndarray, "3 3"],
    own_sigmas: Float[np.ndarray, "n 3"],
) -> tuple[Similarity, np.ndarray]:
    """Estimate scale and shift for a known rotation by consistent positions; return them and the mask of these."""
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
    """Return the EPSG code of the UTM zone (WGS 84) of a position."""
    area = AreaOfInterest(longitude_deg, latitude_deg, longitude_deg, latitude_deg)
    zones = query_utm_crs_info(datum_name="WGS 84", area_of_interest=area)
    if not zones:
        raise InputError(
            f"no UTM zone at {longitude_deg:.3f}, {latitude_deg:.3f} degrees; give the EPSG code of a map system"
        )
    return int(zones[0].code)


def _inliers(offsets: Float[np.ndarray, "n 3"], sigmas: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Mark offsets within a multiple of the median, or of their standard deviations (zero: unknown)."""
    distance = np.linalg.norm(offsets, axis=1)
    allowed = np.linalg.norm(offsets / np.maximum(sigmas, 1e-9), axis=1) <= _BEYOND_OWN
    return (distance <= max(_BEYOND * float(np.median(distance)), 1e-9)) | allowed


def _fit_by_positions(
    there: Float[np.ndarray, "n 3"], here: Float[np.ndarray, "n 3"], own_sigmas: Float[np.ndarray, "n 3"]
) -> tuple[Similarity, np.ndarray]:
    """Estimate a robust similarity (least median of distances, then least squares); return it and the consistent
    positions.
    """
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
    """Return stated standard deviations; otherwise `SIGMA_M`, or the scatter if larger."""
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
    """Estimate the similarity by weighted least squares, with the rotation from attitudes as an observation.

    Without it, the adjustment would have to rotate the whole block, in hundreds of steps.
    """

    # Estimate the shift of the centroid, which is independent of the rotation.
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
    """Estimate shift, rotation and scale from the offsets, and from the angles to the rotation `turn`."""

    def at(x):
        return shift + x[:3], small_rotation(x[3:6]) @ matrix, scale * jnp.exp(x[6])

    def residuals(x, _):
        shift, matrix, scale = at(x)
        offsets = (here - shift - scale * there @ matrix.T) * weight
        return jnp.concatenate([offsets.ravel(), small_angles(matrix @ turn.T) * turn_weight])

    return at(least_squares(residuals, jnp.zeros(7), damping=1e-6).unknowns)


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
    names = np.array(list(positions), object)[~used]
    for name, offset in list(zip(names, offsets[~used], strict=True))[:_LISTED]:
        components = ", ".join(f"{v:z.1f}" for v in offset)
        yield f"the position of {name} differs by {components} m (east, north, up) from the others: rejected"
    if len(names) > _LISTED:
        yield f"{len(names) - _LISTED} more positions are rejected: {few(names[_LISTED:].tolist())}"


def attitude_messages(
    recorded: RecordedRotation | str | None, used: bool, turn: Float[np.ndarray, "3 3"]
) -> Iterator[str]:
    """Yield messages about the agreement of recorded attitudes with the network's rotation `turn` to the map, and their
    use.
    """
    if isinstance(recorded, str):
        yield recorded
    if not isinstance(recorded, RecordedRotation):
        return
    apart = np.rad2deg(np.linalg.norm(scipy.spatial.transform.Rotation.from_matrix(turn @ recorded.turn.T).as_rotvec()))
    scatter, boresight = np.rad2deg([recorded.scatter_rad, recorded.turn_sigma_rad])
    words = f"{len(recorded.image)} recorded attitudes agree with one another to {scatter:.2g} degrees"
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
