"""Tracks: object points from feature matches between photographs.

A track is a connected component of the graph of features (nodes) and matches (edges). A single false match joins two
tracks into one that appears twice in some photographs. Rejecting such components would mainly remove the long tracks,
which are the most valuable. Therefore `tracks` adds matches one by one, the best supported first, and rejects a match
that would add a photograph twice.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

# Number of matches processed at a time.
_AT_ONCE = 200_000


class PairMatches(NamedTuple):
    """Matches of features of two photographs."""

    first: int
    """Index of a photograph."""
    second: int
    """Index of another photograph, greater than `first`."""
    features: Int[np.ndarray, "n 2"]
    """Index of the feature in the first and in the second photograph; each at most once in its column."""


class Tracks(NamedTuple):
    """Image measurements of tracks, sorted by point, then by photograph."""

    image: Int[np.ndarray, "rows"]
    feature: Int[np.ndarray, "rows"]
    point: Int[np.ndarray, "rows"]
    n_conflicting: int
    """Matches rejected because a point would appear twice in a photograph."""


def tracks(n_features: list[int], pairs: list[PairMatches]) -> Tracks:
    """Build tracks from matches; each point appears at most once in a photograph.

    `n_features` is the number of features of every photograph. Matches are added by decreasing support: the number of
    third features matched to both ends; the order of ties is retained. A match whose two components share a photograph
    is rejected and counted. Points are numbered in the order of their first feature.

    Raises ValueError for an index of a photograph or feature out of range.
    """
    number = np.asarray(n_features, int)
    first = np.concatenate([[0], np.cumsum(number)])
    edges = _edges(first, pairs)
    support = _support(edges, int(first[-1]))
    photograph = np.repeat(np.arange(len(number)), number).tolist()
    edges = edges[np.argsort(-support, kind="stable")]
    parent = list(range(int(first[-1])))
    # Photographs of a component, as a bit mask.
    shown: dict[int, int] = {}
    n_conflicting = 0
    for a, b in itertools.chain.from_iterable(map(np.ndarray.tolist, _portions(edges))):
        a, b = _root(parent, a), _root(parent, b)
        if a == b:
            continue
        of_a, of_b = shown.get(a) or 1 << photograph[a], shown.get(b) or 1 << photograph[b]
        if of_a & of_b:
            n_conflicting += 1
            continue
        if of_a.bit_count() < of_b.bit_count():
            a, b = b, a
        parent[b] = a
        shown[a] = of_a | of_b
        shown.pop(b, None)
    rows = np.unique(edges)
    roots = np.fromiter((_root(parent, k) for k in rows.tolist()), int, len(rows))
    _, begins, point, times = np.unique(roots, return_index=True, return_inverse=True, return_counts=True)
    # Features without accepted matches do not form points.
    kept = times[point] >= 2
    rows, point = rows[kept], begins[point][kept]
    image = np.searchsorted(first, rows, side="right") - 1
    order = np.lexsort((image, point))
    return Tracks(
        image[order], (rows - first[image])[order], np.unique(point, return_inverse=True)[1][order], n_conflicting
    )


def connected_images(n_images: int, pairs: list[PairMatches]) -> list[Int[np.ndarray, "images"]]:
    """Return the groups of images connected by matches, the largest first; an image without matches is a group."""
    parent = list(range(n_images))
    for pair in pairs:
        if len(pair.features):
            parent[_root(parent, pair.second)] = _root(parent, pair.first)
    group = np.array([_root(parent, k) for k in range(n_images)], int)
    return sorted((np.flatnonzero(group == k) for k in np.unique(group)), key=lambda images: -len(images))


def _edges(first: np.ndarray, pairs: list[PairMatches]) -> Int[np.ndarray, "edges 2"]:
    """Return the matches of all pairs, with features numbered consecutively across photographs."""
    edges = [np.zeros((0, 2), int)]
    for one, other, features in pairs:
        if not 0 <= one < other < len(first) - 1:
            raise ValueError(f"a pair of {len(first) - 1} photographs needs first < second, got {one} and {other}")
        number = first[[one + 1, other + 1]] - first[[one, other]]
        if (features < 0).any() or (features >= number).any():
            raise ValueError(f"the pair {one}, {other} matches features out of range; the photographs have {number}")
        edges.append(np.asarray(features, int) + first[[one, other]])
    return np.concatenate(edges)


def _support(edges: np.ndarray, n: int) -> Int[np.ndarray, "edges"]:
    """Return the number of third features matched to both ends of each match: its triangles in the graph."""
    # Import here: SciPy takes 0.25 s to import, and few sessions orient photographs.
    from scipy.sparse import csr_matrix

    both = np.concatenate([edges, edges[:, ::-1]])
    matched = csr_matrix((np.ones(len(both), np.int32), (both[:, 0], both[:, 1])), (n, n))
    # A match may occur twice.
    matched.data[:] = 1
    support = [np.zeros(0, int)]
    for some in _portions(edges):
        one, other = (matched[some[:, side]] for side in (0, 1))
        support.append(np.asarray(one.multiply(other).sum(axis=1), int).ravel())
    return np.concatenate(support)


def _portions(edges: np.ndarray) -> Iterator[np.ndarray]:
    """Yield matches in portions, to limit memory."""
    for begin in range(0, len(edges), _AT_ONCE):
        yield edges[begin : begin + _AT_ONCE]


def _root(parent: list[int], k: int) -> int:
    """Return the representative of the component of `k`, with path halving."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k
