"""Simulated photographs to be oriented: features and matches of a scene with known truth, false matches among them."""

from typing import NamedTuple

import numpy as np

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.initial.matches import PairMatches
from jaxphoto.procedures.orientation.blocks import similarity_between
from jaxphoto.procedures.orientation.colmap import Network
from jaxphoto.procedures.orientation.orient_photographs import network_block
from jaxphoto.statistics import covariance
from tests.formulas import camera_from_object

PIXEL = 0.005
SENSOR = Sensor(1600, 1200, PIXEL)


class Camera(NamedTuple):
    """The true camera: c, principal point (mm), K1, K2, in the sense of `jaxphoto.Brown`."""

    c: float = 8.0
    xp: float = 0.04
    yp: float = -0.03
    k1: float = 1.5e-3
    k2: float = -2e-5

    def measured(self, ideal):
        """From ideal to measured coordinates: Newton's method for r_ideal = r - K1 r^3 - K2 r^5."""
        target = np.linalg.norm(ideal, axis=1, keepdims=True)
        r = target.copy()
        for _ in range(30):
            r -= (r - self.k1 * r**3 - self.k2 * r**5 - target) / (1 - 3 * self.k1 * r**2 - 5 * self.k2 * r**4)
        return ideal * np.divide(r, target, out=np.ones_like(r), where=target > 0) + [self.xp, self.yp]


class Scene(NamedTuple):
    """Truth of images and points."""

    positions: np.ndarray
    matrices: np.ndarray
    points: np.ndarray


class Photographs(NamedTuple):
    """What `orient` is given, and the truth it came from."""

    names: tuple[str, ...]
    features: list[np.ndarray]
    matches: list[PairMatches]
    scene: Scene
    camera: Camera
    point_of: list[np.ndarray]
    """The true point of each feature, -1 for one of none."""


def looking(position, at, roll):
    """`camera_from_object` of a camera that looks from `position` to `at`, rolled about its axis."""
    back = (position - at) / np.linalg.norm(position - at)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    s, c = np.sin(roll), np.cos(roll)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ np.stack([right, np.cross(back, right), back])


def convergent(n_images=10, n_points=400, seed=0):
    """Images round a heap of points, at two heights, some of them rolled by a quarter of a turn."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (n_points, 3)) * [3.0, 3.0, 1.2]
    angles = 2 * np.pi * np.arange(n_images) / n_images * 0.7
    height = 2.5 + 2.0 * (np.arange(n_images) % 2)
    positions = np.column_stack([7.5 * np.cos(angles), 7.5 * np.sin(angles), height])
    positions += 0.2 * rng.normal(size=(n_images, 3))
    rolls = np.where(np.arange(n_images) % 3 == 0, np.pi / 2, 0.0) + 0.05 * rng.normal(size=n_images)
    matrices = np.stack([looking(p, 0.3 * rng.normal(size=3), r) for p, r in zip(positions, rolls, strict=True)])
    return Scene(positions, matrices, points)


def aerial(
    strips=2,
    per_strip=5,
    forward=0.6,
    across=0.3,
    relief=15.0,
    crab_deg=5.0,
    tilt=0.02,
    c=8.0,
    height=100.0,
    per_image=250,
    seed=0,
):
    """Strips flown there and back `height` m over rolling ground, with overlaps, crab, and c (mm) of the lens."""
    rng = np.random.default_rng(seed)
    width, depth = SENSOR.width_mm * height / c, SENSOR.height_mm * height / c
    base, apart = (1 - forward) * width, (1 - across) * depth
    positions, matrices = [], []
    for s in range(strips):
        for k in range(per_strip):
            back = s % 2
            positions.append([base * (per_strip - 1 - k if back else k), apart * s, height])
            kappa = np.pi * back + np.deg2rad(crab_deg) * (1 - 2 * back) + tilt * rng.normal()
            matrices.append(camera_from_object(*(tilt * rng.normal(size=2)), kappa))
    positions = np.array(positions) + 0.01 * height * rng.normal(size=(len(positions), 3))
    low, high = np.array([-width, -depth]) / 2, [base * (per_strip - 1) + width / 2, apart * (strips - 1) + depth / 2]
    n = round(per_image * np.prod(high - low) / (width * depth))
    x, y = rng.uniform(low, high, (n, 2)).T
    rolling = 0.35 * np.sin(2 * x / width) * np.cos(2.5 * y / width) + 0.15 * rng.uniform(-1, 1, n)
    return Scene(positions, np.stack(matrices), np.column_stack([x, y, relief * rolling]))


TRUE = Camera()


def projected(scene, camera, image, points):
    """Where `points` are in an image of `scene`, and whether they are on it."""
    half = np.array([SENSOR.width_mm, SENSOR.height_mm]) / 2
    u, v, w = scene.matrices[image] @ (points - scene.positions[image]).T
    ideal = -camera.c * np.column_stack([u, v]) / w[:, None]
    xy = camera.measured(ideal)
    return xy, (w < 0) & (np.abs(xy) < half).all(axis=1) & (np.linalg.norm(ideal, axis=1) < 1.3 * 5.0)


def photographed(scene, camera=TRUE, noise_px=0.3, false=0.0, seed=1, clutter=60, found=0.8):
    """Features of the points of `scene`, in disorder and among others, and matches of which the part `false` is."""
    rng = np.random.default_rng(seed)
    features, point_of = [], []
    half = np.array([SENSOR.width_mm, SENSOR.height_mm]) / 2
    for image in range(len(scene.positions)):
        xy, visible = projected(scene, camera, image, scene.points)
        seen = np.flatnonzero(visible)
        xy = np.concatenate([xy[seen], rng.uniform(-half, half, (clutter, 2))])
        xy[: len(seen)] += noise_px * PIXEL * rng.normal(size=(len(seen), 2))
        order = rng.permutation(len(xy))
        features.append(xy[order])
        point_of.append(np.append(seen, np.full(clutter, -1))[order])
    # False matches come from a stream of their own, so that the true ones are the same with and without them.
    wrong = np.random.default_rng(seed + 1000)
    matches = []
    for i in range(len(features)):
        for j in range(i + 1, len(features)):
            _, one, other = np.intersect1d(point_of[i], point_of[j], return_indices=True)
            true = point_of[i][one] >= 0
            true &= rng.random(len(true)) < found
            one, other = one[true], other[true]
            if len(one) < 10:
                continue
            n = round(len(one) * false / (1 - false))
            free = [np.setdiff1d(np.arange(len(point_of[k])), used) for k, used in ((i, one), (j, other))]
            n = min(n, *map(len, free))
            pairs = np.column_stack([wrong.permutation(f)[:n] for f in free])
            pairs = np.concatenate([np.column_stack([one, other]), pairs])
            matches.append(PairMatches(i, j, pairs[rng.permutation(len(pairs))] if not false else pairs))
    names = tuple(f"p{k:02d}" for k in range(len(features)))
    return Photographs(names, features, matches, scene, camera, point_of)


def with_epipolar_matches(photographs, per_pair, noise_px=0.3, seed=7):
    """The same and `per_pair` false matches of each pair along epipolar lines, at 0.6 to 1.6 of the true distance."""
    scene, camera, rng = photographs.scene, photographs.camera, np.random.default_rng(seed)
    features, point_of = ([*of_image] for of_image in (photographs.features, photographs.point_of))
    matches = []
    for match in photographs.matches:
        i, j = match.first, match.second
        away = rng.permutation(scene.points) - scene.positions[i]
        where = scene.positions[i] + away * np.exp(rng.uniform(-0.5, 0.5, (len(away), 1)))
        (one, on_one), (other, on_other) = (projected(scene, camera, k, where) for k in (i, j))
        rows = np.flatnonzero(on_one & on_other)[:per_pair]
        more = np.column_stack([len(features[k]) + np.arange(len(rows)) for k in (i, j)])
        for k, xy in ((i, one[rows]), (j, other[rows])):
            features[k] = np.concatenate([features[k], xy + noise_px * PIXEL * rng.normal(size=xy.shape)])
            point_of[k] = np.append(point_of[k], np.full(len(rows), -1))
        matches.append(match._replace(features=np.concatenate([match.features, more])))
    return photographs._replace(features=features, matches=matches, point_of=point_of)


def true_network(p):
    """The network at the truth, and the true point of each of its rows; -1 for a false one."""
    scene, group, edges = p.scene, dict[tuple, set](), []
    for i, j, features in p.matches:
        edges += [((i, a), (j, b)) for a, b in features.tolist()]
    # True matches first; none may show a point twice in an image.
    for one, other in sorted(
        edges, key=lambda e: (p.point_of[e[0][0]][e[0][1]] < 0) + (p.point_of[e[1][0]][e[1][1]] < 0)
    ):
        a, b = group.setdefault(one, {one}), group.setdefault(other, {other})
        if a is not b and not {i for i, _ in a} & {i for i, _ in b}:
            a |= b
            group |= dict.fromkeys(b, a)
    joined = {id(members): sorted(members) for members in group.values() if len(members) > 1}
    rows = np.array([(i, f, k) for k, members in enumerate(joined.values()) for i, f in members]).T
    true = np.array([p.point_of[i][f] for i, f in rows[:2].T])
    points = np.zeros((len(joined), 3))
    points[rows[2]] = scene.points[true]
    n = len(p.names)
    places = (scene.positions.copy(), scene.matrices.copy(), np.ones(n, bool), tuple(range(n)), points)
    return Network(*places, *rows, (p.camera.c / PIXEL,), tuple(p.matches)), true


def block_of(p, network):
    """The block of a network, its camera at its true principal distance."""
    sigmas = [np.full(len(xy), 0.3 * PIXEL) for xy in p.features]
    return network_block("scene", p.names, SENSOR, InteriorOrientation(p.camera.c), p.features, sigmas, network)


def placed(adjusted, scene):
    """Stations and matrices of a network after the similarity that brings its stations nearest to the true ones."""
    order = [int(name[1:]) for name in adjusted.block.images]
    exterior = adjusted.unknowns.exterior
    there = np.asarray(exterior.position)
    s = similarity_between(there, scene.positions[order])
    return order, s, s.of(there), np.asarray(exterior.camera_from_object) @ s.turn.T


def errors_over_sigmas(adjusted, scene):
    """Errors (images, 6) of stations and rotations after `placed`, over their standard deviations in that datum."""
    errors, matrix = errors_with_covariance(adjusted, scene)
    return (errors / np.sqrt(np.diagonal(matrix))).reshape(-1, 6)


def errors_with_covariance(adjusted, scene, camera=None):
    """Errors of stations and rotations after `placed`, by image, and of c and principal point if the true one is given.

    A network has errors e in its own datum. What the similarity leaves of them is S e, S = I - G (G_s' G_s)^-1 G_s',
    with the seven motions G, of which G_s are the rows of stations; so their covariance is S C S' in any datum.
    """
    order, s, stations, matrices = placed(adjusted, scene)
    n, true = len(order), scene.matrices[order]
    found = covariance(adjusted, "camera")
    turned = np.einsum("nij,nkj->nik", matrices, true)
    # A small rotation theta takes M to (I - [theta]x) M.
    rotations = 0.5 * np.stack([turned[:, i, j] - turned[:, j, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
    errors = np.hstack([stations - scene.positions[order], rotations]).ravel()
    datum = np.zeros((n, 6, 6))
    datum[:, :3, :3], datum[:, 3:, 3:] = s.scale * s.turn, np.eye(3)
    x = scene.positions[order] - scene.positions[order].mean(axis=0)
    motions = np.zeros((n, 6, 7))
    motions[:, :3, :3], motions[:, :3, 6] = np.eye(3), x
    motions[:, :3, 3:6] = np.cross(np.eye(3)[None], x[:, None]).transpose(0, 2, 1)
    motions[:, 3:, 3:6] = true
    flat = motions.reshape(6 * n, 7)
    of_station = np.tile(np.arange(6) < 3, n)
    fit = flat @ np.linalg.pinv(flat[of_station])
    left = np.eye(6 * n)
    left[:, of_station] -= fit
    apply = np.einsum("anj,njk->ank", left.reshape(6 * n, n, 6), datum).reshape(6 * n, 6 * n)
    shown = list(range(6 * n))
    if camera is not None:
        interior = adjusted.unknowns.interior["camera"]
        errors = np.append(errors, np.array([interior.c, interior.xp, interior.yp]) - camera[:3])
        shown += [found.labels.index(f"interior[camera].{name}") for name in ("c_mm", "xp_mm", "yp_mm")]
        apply = np.block([[apply, np.zeros((6 * n, 3))], [np.zeros((3, 6 * n)), np.eye(3)]])
    matrix = apply @ np.asarray(found.matrix)[np.ix_(shown, shown)] @ apply.T * float(found.variance_factor)
    return errors, matrix
