"""Blocks to measure with: seeded ones of our own, and those of another program's npz.

A `Problem` is plain numpy and says nothing about any solver: every peer gets the same numbers. Model: collinearity with
`corrected = (xy - pp) (1 + k1 r^2 + k2 r^4)` (k1, k2 added: the opposite of `Brown`), rotations R3(kappa) R2(phi)
R1(omega), weighted control and camera stations. Unknowns in this order: c, x_p, y_p, k1, k2; omega, phi, kappa, X, Y, Z
an image; X, Y, Z a point.
"""

import struct
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

TRUE_IOP = np.array([34.250, 0.064, 0.273, -9.1e-5, 1.04e-7])
FRAME = np.array([36.0, 24.0])
HEIGHT = 1000.0
# Nothing further away than this (m, along X or Y) is in a frame.
_REACH = 760.0


@dataclass(frozen=True)
class Problem:
    """One block as arrays; sorted by point, then image. Millimetres in the image, metres and radians elsewhere."""

    obs_img: np.ndarray
    obs_pt: np.ndarray
    obs_xy: np.ndarray
    sigma_img: float
    sta_obs: np.ndarray
    sta_sigma: np.ndarray
    gcp_pt: np.ndarray
    gcp_obs: np.ndarray
    gcp_sigma: np.ndarray
    strip: np.ndarray
    init_iop: np.ndarray
    init_eop: np.ndarray
    init_pts: np.ndarray

    @property
    def n_unknowns(self) -> int:
        return 5 + self.init_eop.size + self.init_pts.size


@dataclass(frozen=True)
class Size:
    """Strips as (x, y, azimuth in degrees, images), spaced by `base`; how many points, control points, and the seed."""

    strips: tuple[tuple[float, float, float, int], ...]
    points: int
    control: int
    seed: int
    base: float = 280.0


def _cross(length: float, half: float) -> tuple[tuple[float, float, float, int], ...]:
    middle = length / 2
    return (
        (0, half, 0, 8),
        (length, -half, 180, 8),
        (middle - half, middle, 270, 8),
        (middle + half, -middle, 90, 7),
    )


def _parallel(n: int, images: int, across: float, crossing: int, crossing_images: int, base: float):
    along = base * (images - 1)
    strips = [(0 if k % 2 == 0 else along, k * across, 0 if k % 2 == 0 else 180, images) for k in range(n)]
    south = (n - 1) * across / 2 - (crossing_images - 1) * base / 2
    strips += [(along * (k + 1) / (crossing + 1), south, 90, crossing_images) for k in range(crossing)]
    return tuple(strips)


SIZES = {
    "P31": Size(_cross(7 * 280.0, 263.0), 187, 33, 31),
    "B200": Size(_parallel(8, 22, 420.0, 2, 12, 280.0), 20_000, 40, 200),
    "B1000": Size(_parallel(24, 40, 420.0, 1, 40, 280.0), 200_000, 100, 1000),
}


def parallel_strips(strips: int, images: int, points: int, seed: int = 0) -> Size:
    """`strips` of `images` each, overlapping by 60 % along and across, without cross strips."""
    return Size(_parallel(strips, images, 420.0, 0, 0, 280.0), points, min(points, 40), seed)


def generate(size: Size) -> Problem:
    """The block of that size, always the same."""
    rng = np.random.default_rng(size.seed)
    of_strips = []
    for k, (x, y, azimuth, n) in enumerate(size.strips):
        a = np.deg2rad(azimuth)
        line = np.array([x, y]) + size.base * np.arange(n)[:, None] * np.array([np.cos(a), np.sin(a)])
        of_strips.append((line, np.full(n, a - np.pi / 2), np.full(n, k)))
    places, kappa, strip = map(np.concatenate, zip(*of_strips, strict=True))
    n = len(places)
    eop = np.column_stack(
        [
            rng.normal(0, 0.026, (n, 2)),
            kappa + rng.normal(0, 0.035, n),
            places + rng.normal(0, 10, (n, 2)),
            HEIGHT + rng.normal(0, 8, n),
        ]
    )
    points, seen = np.zeros((0, 3)), []
    low, high = places.min(0) - 350, places.max(0) + 350
    while len(points) < size.points:
        xy = rng.uniform(low, high, (size.points, 2))
        z = 30 + 25 * np.sin(xy[:, 0] / 320) * np.cos(xy[:, 1] / 250)
        drawn = np.column_stack([xy, z])
        image, point, measured = _visible(eop, drawn)
        good = np.flatnonzero(np.bincount(point, minlength=len(drawn)) >= 3)[: size.points - len(points)]
        new = np.full(len(drawn), -1)
        new[good] = len(points) + np.arange(len(good))
        rows = new[point] >= 0
        seen.append((image[rows], new[point[rows]], measured[rows]))
        points = np.concatenate([points, drawn[good]])
    image, point, measured = (np.concatenate(v) for v in zip(*seen, strict=True))
    order = np.lexsort((image, point))
    image, point, measured = image[order], point[order], measured[order]
    stations = eop[:, 3:] + rng.normal(0, 0.10, (n, 3))
    control = np.sort(rng.choice(len(points), size.control, replace=False))
    observed = points[control] + rng.normal(0, 0.03, (len(control), 3))
    start = points + rng.normal(0, 5.0, points.shape)
    start[control] = observed
    return Problem(
        obs_img=image.astype(np.int32),
        obs_pt=point.astype(np.int32),
        obs_xy=measured + rng.normal(0, 0.004, measured.shape),
        sigma_img=0.004,
        sta_obs=stations,
        sta_sigma=np.full((n, 3), 0.10),
        gcp_pt=control.astype(np.int32),
        gcp_obs=observed,
        gcp_sigma=np.full((len(control), 3), 0.03),
        strip=strip.astype(np.int32),
        init_iop=np.array([35.0, 0, 0, 0, 0]),
        init_eop=np.column_stack([eop[:, :3] + rng.normal(0, 0.0087, (n, 3)), stations]),
        init_pts=start,
    )


def rotations(angles: np.ndarray) -> np.ndarray:
    """Object to camera, one an image: R3(kappa) R2(phi) R1(omega). Complex angles too."""
    (so, sp, sk), (co, cp, ck) = np.sin(angles.T), np.cos(angles.T)
    rows = [
        [cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck],
        [-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk],
        [sp, -so * cp, co * cp],
    ]
    return np.stack([np.stack(r, -1) for r in rows], -2)


def _visible(eop: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Images, points and true coordinates (mm) of every point inside a frame."""
    found = []
    by_x = np.argsort(points[:, 0])
    first, stop = (np.searchsorted(points[by_x, 0], eop[:, 3] + side) for side in (-_REACH, _REACH))
    for i, matrix in enumerate(rotations(eop[:, :3])):
        near = by_x[first[i] : stop[i]]
        near = near[np.abs(points[near, 1] - eop[i, 4]) < _REACH]
        u = (points[near] - eop[i, 3:]) @ matrix.T
        ideal = -TRUE_IOP[0] * u[:, :2] / u[:, 2:]
        far = np.linalg.norm(ideal, axis=1)
        # Beyond the corners of the frame the polynomial has no inverse.
        near, ideal, far = near[far < 23.5], ideal[far < 23.5], far[far < 23.5]
        radius = far
        for _ in range(10):
            r2 = radius**2
            error = radius * (1 + TRUE_IOP[3] * r2 + TRUE_IOP[4] * r2**2) - far
            radius = radius - error / (1 + 3 * TRUE_IOP[3] * r2 + 5 * TRUE_IOP[4] * r2**2)
        xy = ideal * (radius / far)[:, None] + TRUE_IOP[1:3]
        inside = np.all(np.abs(xy) < FRAME / 2 - 0.4, axis=1)
        found.append((np.full(inside.sum(), i), near[inside], xy[inside]))
    image, point, xy = zip(*found, strict=True)
    return np.concatenate(image), np.concatenate(point), np.concatenate(xy)


def read_npz(path: Path) -> Problem:
    """A problem of the peers' generator (keys as the fields of `Problem`)."""
    data = np.load(path)
    numbers = {f.name: data[f.name] for f in fields(Problem)}
    order = np.lexsort((numbers["obs_img"], numbers["obs_pt"]))
    for name in ("obs_img", "obs_pt", "obs_xy"):
        numbers[name] = numbers[name][order]
    return Problem(**(numbers | {"sigma_img": float(numbers["sigma_img"])}))


def write_bin(problem: Problem, path: Path) -> None:
    """The flat file that the C++ peer reads."""
    p = problem
    counts = (len(p.sta_obs), len(p.init_pts), len(p.obs_xy), len(p.gcp_pt))
    arrays = [getattr(p, f.name) for f in fields(Problem) if f.name != "sigma_img"]
    with path.open("wb") as file:
        file.write(b"JXB1" + struct.pack("<4qd", *counts, p.sigma_img))
        for array in arrays:
            file.write(np.ascontiguousarray(array, "<i4" if array.dtype.kind == "i" else "<f8").tobytes())
