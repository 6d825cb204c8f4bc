"""Single circular targets with known coordinates on a plane, told apart by their arrangement and size.

A circle of known size and its image give the affine map between board and picture there, but for a rotation; the
direction to one neighbour gives that, and the other neighbours say whether it is right. The guesses that most agree
with become homographies over all targets. Of those with most targets the one that fits best wins, unless another
labelling does as well: then the arrangement is the same when it is turned, and no picture can tell how it is seen.

Which side of its plane a field is seen from its coordinates do not say (a floor, a ceiling, a wall), so that both are
tried; of an arrangement that is its own mirror image the side is that of Z, unless the plane stands upright.
"""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.errors import InputError
from jaxphoto.extras.photos.targets.circle_grid import disc_reflectance
from jaxphoto.extras.photos.targets.discs import Blobs, elliptic_blobs, fit_discs
from jaxphoto.extras.photos.targets.pattern import FoundBoard, Pattern
from jaxphoto.io.text_tables import read_csv
from jaxphoto.procedures.calibration import Board

_LEAST = 6
_NEIGHBOURS = 8
# Of the distance between neighbours: what a guess, and what a homography of a distorted picture, may be off.
_OFF, _NEAR = 0.25, 0.3
_GUESSES = 40
# Another labelling is as good from this part of the number of targets on, and up to this multiple of the misfit.
_AS_GOOD, _AS_NEAR = 0.8, 2.0
# Z of the normal of a plane that stands upright.
_UPRIGHT = 0.1


class CircularTargets(Pattern):
    """Dark or bright circles on a plane, from a CSV file: point, X_mm, Y_mm, Z_mm, diameter_mm.

    Raises InputError for a file that cannot be read as that, for fewer than six targets, and where no plane holds them.
    """

    def __init__(self, path: Path) -> None:
        table = read_csv(path, ("point", "X_mm", "Y_mm", "Z_mm", "diameter_mm"))
        xyz = np.stack([table.numbers(name) for name in ("X_mm", "Y_mm", "Z_mm")], axis=1) / 1000
        diameter = table.sigmas("diameter_mm")
        for line in np.flatnonzero(np.isnan(diameter)):
            raise table.bad(line, "diameter_mm is empty; give the diameter of the target")
        ids = tuple(table.ids("point").tolist())
        if len(set(ids)) < len(ids):
            raise InputError(f"{path.name}: a point stands there twice; give each target an id of its own")
        if len(ids) < _LEAST:
            raise InputError(f"{path.name}: {len(ids)} targets are too few; a photograph needs {_LEAST} of them")
        self.board = Board(path.stem, ids, xyz, diameter / 1000)
        plane = self.board.plane
        if plane is None:
            raise InputError(
                f"{path.name}: the targets lie in no plane (to 1 % of their extent), and only those of one are told "
                "apart; give those of one wall"
            )
        middle, axes = plane
        self._flat = (xyz - middle) @ axes[:, :2]
        self._upright = bool(abs(axes[2, 2]) < _UPRIGHT)

    def find(self, picture: np.ndarray) -> FoundBoard | None:
        """The targets that are seen; None where their arrangement is not found, or found in several ways."""
        blobs = elliptic_blobs(picture)
        for dark in (True, False):
            own = blobs.take(blobs.dark == dark)
            pairs = identified(self._flat, self.board.diameter_m / 2, own, self._upright)
            if pairs is not None:
                return FoundBoard(pairs[:, 0], fit_discs(picture, own.take(pairs[:, 1])))
        return None

    def reflectance(self, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Black circles on white; of a board in the plane Z = 0."""
        return disc_reflectance(self.board, xy_m)


class _Labelling(NamedTuple):
    """(target, blob) pairs, the RMS (px) by which a homography misses them, and the side of the plane, 1 or -1."""

    pairs: Int[np.ndarray, "pairs 2"]
    misfit: float
    side: int

    def agrees(self, other: "_Labelling") -> bool:
        """Whether most of these pairs are the other's, too."""
        label = dict(other.pairs[:, ::-1].tolist())
        same = sum(label.get(blob) == target for target, blob in self.pairs.tolist())
        return self.side == other.side and same >= 0.5 * len(self.pairs)


def identified(
    flat: Float[np.ndarray, "targets 2"], radius: Float[np.ndarray, "targets"], blobs: Blobs, upright: bool = False
) -> Int[np.ndarray, "pairs 2"] | None:
    """(target, blob) of those that are each other's, from places in the plane of the field; None if not told.

    Y is up where the field is seen from its front. Of an `upright` field nobody knows which side that is.
    """
    if len(blobs.column_row) < _LEAST:
        return None
    found: list[_Labelling] = []
    for side in (1, -1):
        seen = flat * (side, 1)
        grown = (_grown(seen, guess, blobs) for guess in _guesses(seen * (1, -1), radius, blobs))
        found += [_Labelling(*g, side) for g in grown if g is not None]
    best = _best(found)
    if best is None and not upright:
        best = _best([one for one in found if one.side == 1])
    return None if best is None else best.pairs


def _best(found: list[_Labelling]) -> _Labelling | None:
    """The labelling that fits best among those of most targets; None where another one is as good."""
    most = max((len(one.pairs) for one in found), default=0)
    able = [one for one in found if len(one.pairs) >= _AS_GOOD * most]
    best = min(able, key=lambda one: one.misfit, default=None)
    if best is None or any(one.misfit < _AS_NEAR * best.misfit and not one.agrees(best) for one in able):
        return None
    return best


def _nearest(places: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n k"]:
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    return np.argsort(distance, axis=1)[:, 1 : _NEIGHBOURS + 1]


def _guesses(down, radius, blobs) -> list[np.ndarray]:
    """Lists of pairs (target, blob): a target with those of its neighbours that agree; most first."""
    near_target, near_blob = _nearest(down), _nearest(blobs.column_row)
    # Neighbours as seen from a target, in radii and with circles made round: what is left is a rotation.
    w = (down[near_target] - down[:, None]) / radius[:, None, None]
    lower = np.linalg.cholesky(blobs.shape)
    u = np.einsum("bji,bkj->bki", lower, blobs.column_row[near_blob] - blobs.column_row[:, None])
    wc, uc = w[..., 0] + 1j * w[..., 1], u[..., 0] + 1j * u[..., 1]
    guesses: list[np.ndarray] = []
    for b in range(len(uc)):
        # (target, neighbour of the target, neighbour of the blob)
        turn = uc[b][None, None, :] / wc[:, :, None]
        size = np.abs(turn)
        turned = wc[:, None, None, :] * (turn / np.maximum(size, 1e-12))[..., None]
        error = np.abs(turned[..., None] - uc[b])
        nearest = error.argmin(axis=4)
        agrees = (error.min(axis=4) < _OFF * np.abs(wc)[:, None, None, :]) & (np.abs(np.log(size)) < _OFF)[..., None]
        score = agrees.sum(axis=3)
        for t in np.flatnonzero(score.max(axis=(1, 2)) >= 4):
            m, n = np.unravel_index(score[t].argmax(), score[t].shape)
            ok = np.flatnonzero(agrees[t, m, n])
            pairs = np.column_stack([near_target[t, ok], near_blob[b, nearest[t, m, n, ok]]])
            guesses.append(np.vstack([np.array([[t, b]]), pairs]))
    return sorted(guesses, key=len, reverse=True)[:_GUESSES]


def _grown(flat, pairs, blobs) -> tuple[np.ndarray, float] | None:
    """All pairs that a homography from a few leads to, and by how much it misses them; None where it leads nowhere."""
    spacing = np.linalg.norm(flat[_nearest(flat)[:, 0]] - flat, axis=1)
    for _ in range(4):
        if len(np.unique(pairs[:, 1])) < len(pairs) or len(pairs) < 4:
            return None
        h, _ = cv2.findHomography(flat[pairs[:, 0]], blobs.column_row[pairs[:, 1]])
        if h is None:
            return None
        beside = flat + np.stack([spacing, np.zeros_like(spacing)], axis=1)
        seen, other = (cv2.perspectiveTransform(p[None], h)[0] for p in (flat, beside))
        distance = np.linalg.norm(seen[:, None] - blobs.column_row, axis=2)
        blob = distance.argmin(axis=1)
        good = distance.min(axis=1) < _NEAR * np.linalg.norm(other - seen, axis=1)
        good &= distance.argmin(axis=0)[blob] == np.arange(len(flat))
        pairs = np.column_stack([np.flatnonzero(good), blob[good]])
    if len(pairs) < _LEAST:
        return None
    # Of a homography of these pairs, not of those that led to them.
    h, _ = cv2.findHomography(flat[pairs[:, 0]], blobs.column_row[pairs[:, 1]])
    if h is None:
        return None
    off = cv2.perspectiveTransform(flat[pairs[:, 0]][None], h)[0] - blobs.column_row[pairs[:, 1]]
    return pairs, float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
