"""Lists that the sums of a block run over: pairs of rows that meet, rows by image, chunks of equal size."""

import numpy as np


def check_rows(image: np.ndarray, point: np.ndarray) -> None:
    """Raise ValueError for image rows that are not sorted by point, or hold a point twice in one image."""
    if (np.diff(point) < 0).any():
        raise ValueError(
            "the rows of image_points must be sorted by point: take them in the order of np.argsort(point)"
        )
    key = point.astype(np.int64) * (int(image.max(initial=0)) + 1) + image
    if len(np.unique(key)) < len(key):
        raise ValueError("image_points holds a point twice in one image: keep one row of each")


def pairs_of(image: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, ...]:
    """Rows (a, b) of one point with image[a] >= image[b], and the lower 6 x 6 blocks they fill, sorted by block."""
    n = len(point)
    first = np.searchsorted(point, point, side="left")
    count = np.arange(n) - first + 1
    a = np.repeat(np.arange(n), count)
    b = np.arange(len(a)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    upper = image[a] < image[b]
    a, b = np.where(upper, b, a), np.where(upper, a, b)
    key = image[a].astype(np.int64) * (int(image.max(initial=0)) + 1) + image[b]
    order = np.argsort(key, kind="stable")
    unique, block = np.unique(key[order], return_inverse=True)
    rows, columns = np.divmod(unique, int(image.max(initial=0)) + 1)
    return tuple(v.astype(np.int32) for v in (a[order], b[order], block, rows, columns))


def rows_by_image(image: np.ndarray, point: np.ndarray, n_images: int, no_row: int) -> dict[str, np.ndarray]:
    """The rows of each image and their points, as tables filled up with `no_row`."""
    count = np.bincount(image, minlength=n_images)
    order = np.argsort(image, kind="stable")
    place = np.arange(len(image)) - np.repeat(np.cumsum(count) - count, count)
    rows = np.full((n_images, count.max(initial=0)), no_row, np.int32)
    rows[image[order], place] = order
    points = np.zeros_like(rows)
    points[image[order], place] = point[order]
    return {"image_rows": rows, "image_points": points}


# Common points of two images that are multiplied at once.
_CHUNK = 32


def chunks_of(pairs: tuple[np.ndarray, ...], no_row: int) -> dict[str, np.ndarray]:
    """The pairs of each block in chunks of equal size, filled up with `no_row`."""
    a, b, block = pairs
    count = np.bincount(block)
    size = _CHUNK
    chunks = -(-count // size)
    owner = np.repeat(np.arange(len(count)), chunks)
    place = np.arange(len(a)) - np.repeat(np.cumsum(count) - count, count)
    at = np.repeat(np.cumsum(chunks) - chunks, count) + place // size
    filled = np.full((2, len(owner), size), no_row, np.int32)
    filled[:, at, place % size] = a, b
    return {"chunk_a": filled[0], "chunk_b": filled[1], "chunk_block": owner.astype(np.int32)}


def point_classes(pairs: np.ndarray, n_points: int) -> np.ndarray:
    """Greedy colouring: two points joined by a distance lie in different classes."""
    classes = np.zeros(n_points, np.int32)
    neighbours: dict[int, set[int]] = {}
    for a, b in pairs:
        neighbours.setdefault(int(a), set()).add(int(b))
        neighbours.setdefault(int(b), set()).add(int(a))
    done: set[int] = set()
    for p, around in neighbours.items():
        taken = {int(classes[q]) for q in around & done}
        classes[p] = next(k for k in range(len(taken) + 1) if k not in taken)
        done.add(p)
    return classes
