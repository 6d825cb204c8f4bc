"""Numbers out of files that are trees or texts: thousands of lists at once, or one that is named."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.text_tables import LARGEST


def number_rows(
    values: Sequence[Any], shape: tuple[int, ...], place: Callable[[int], str]
) -> Float[np.ndarray, "n *shape"]:
    """Values of one shape each as an array. Raises InputError at `place(k)` for the first that is not of it."""
    try:
        rows = np.array(values, float).reshape(-1, *shape) if len(values) else np.zeros((0, *shape))
        if len(rows) == len(values) and (np.abs(rows) <= LARGEST).all() and np.shape(values)[1:] == shape:
            return rows
        if not len(values):
            return rows
    except (TypeError, ValueError, OverflowError):
        pass
    for k, value in enumerate(values):
        try:
            row = np.array(value, float)
            good = row.shape == shape and bool((np.abs(row) <= LARGEST).all())
        except (TypeError, ValueError, OverflowError):
            good = False
        if not good:
            many = "a finite number" if shape == () else f"{' x '.join(map(str, shape))} finite numbers"
            raise InputError(f"{place(k)}: {quoted(value)} is not {many}; correct it, or export the file anew")
    raise InputError(f"{place(0)}: these are no numbers of one kind; export the file anew")


def beginning(path: Path, most: int) -> list[str]:
    """The lines that are not empty among the first `most` bytes of a file, whatever it is."""
    with path.open("rb") as file:
        return [line for line in file.read(most).decode("utf-8", "replace").splitlines() if line.strip()]


def row_numbers(path: Path, row: int, words: Sequence[str], many: int) -> list[float]:
    """So many numbers of a row of text. Raises InputError where they are others."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != many or not all(abs(value) <= LARGEST for value in values):
        raise InputError(f"{path.name}, row {row}: {quoted(' '.join(words))} is not {many} numbers; export it anew")
    return values
