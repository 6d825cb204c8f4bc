"""Rows of control files whatever their form: cells with the place they stand at; points and marks gathered."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxphoto.errors import InputError, RowError, quoted
from jaxphoto.io.names import LONGEST, harm_in
from jaxphoto.io.text_tables import LARGEST, finite
from jaxphoto.procedures.control.surveyed import Marks, SurveyedPoints

Mark = tuple[str, str, list[float], float, str]
"""Image, point, column and row, sigma in pixels, place."""


class Cells(NamedTuple):
    """The cells of rows of one file."""

    file: str
    records: list[list[str]]
    rows: list[int]
    called: str = "row"
    """What the file calls a row."""

    def place(self, k: int) -> str:
        """File and row, as messages name them."""
        return f"{self.file}, {self.called} {self.rows[k]}"

    def bad(self, k: int, message: str) -> RowError:
        """An error about one row."""
        return RowError(f"{self.place(k)}: {message}", [self.rows[k]])

    def check(self, sound: Sequence[bool] | np.ndarray, message: Callable[[int], str]) -> None:
        """Raise RowError, with the message of the first, for rows that are not `sound`."""
        wrong = [k for k, good in enumerate(sound) if not good]
        if wrong:
            raise RowError(f"{self.place(wrong[0])}: {message(wrong[0])}", [self.rows[k] for k in wrong])

    def none(self, message: str) -> InputError:
        """An error about all of them."""
        return InputError(f"{self.file}: {message}")

    def number(self, k: int, column: int, name: str) -> float:
        """The finite number in a cell."""
        value = finite(self.records[k][column])
        if value is None:
            found = quoted(self.records[k][column])
            raise self.bad(k, f"{name} is {found}, not a number below {LARGEST:g}; write it like 12.34")
        return value

    def height(self, k: int, column: int) -> float:
        """The same, or NaN where the cell is empty or says nan."""
        return np.nan if self.records[k][column].lower() in ("", "nan") else self.number(k, column, "the height")

    def sigma(self, k: int, column: int | None, name: str) -> float:
        """A standard deviation; NaN where the column or the cell is not there."""
        if column is None or len(self.records[k]) <= column or not self.records[k][column]:
            return np.nan
        value = self.number(k, column, name)
        if value <= 0:
            raise self.bad(k, f"{name} is {value:g}; a standard deviation is positive, so give its true value")
        return value


class SurveyRows:
    """Surveyed points as they are met, in the order of the file."""

    def __init__(self, file: str) -> None:
        self.file = file
        self._of: dict[str, tuple[list[float], list[float], bool, str]] = {}
        self._at: dict[tuple[str, ...], str] = {}

    def __len__(self) -> int:
        return len(self._of)

    def named_by(self, xyz: Sequence[float]) -> str:
        """The name of a point that has none: P1, P2 ..., one for each place."""
        return self._at.setdefault(tuple(map(repr, xyz)), f"P{len(self._at) + 1}")

    def add(
        self,
        name: str,
        xyz: list[float],
        place: str,
        mend: str = "give each point once",
        sigma: list[float] | None = None,
        check: bool = False,
        once: bool = False,
    ) -> None:
        """A point; `once`: it may not come again, not even with the same coordinates.

        Raises InputError for a name that does harm, and for one that stands there twice.
        """
        checked(name, "point", place)
        new = (xyz, sigma or [np.nan] * 3, check, place)
        first = self._of.setdefault(name, new)
        same = np.array_equal(np.array(first[0]), np.array(xyz), equal_nan=True)
        if first is not new and (once or not same):
            also = "" if same else " with other coordinates"
            raise InputError(f"{place}: the point {quoted(name)} stands in {first[3]}, too{also}; {mend}")

    def surveyed(self, system: str = "", own_axes: bool = False) -> SurveyedPoints:
        """All of them. Raises InputError where there is none."""
        if not self._of:
            raise InputError(f"{self.file}: there is no point with coordinates; add some")
        values = list(self._of.values())
        return SurveyedPoints(
            self.file,
            tuple(self._of),
            np.array([v[0] for v in values], float).reshape(-1, 3),
            np.array([v[1] for v in values], float).reshape(-1, 3),
            np.array([v[2] for v in values], bool),
            tuple(v[3] for v in values),
            system,
            own_axes,
        )


def read_marks(rows: Sequence[Mark]) -> Marks:
    """Marks of rows. Raises InputError for names that do harm, and where a point is marked twice in an image."""
    seen: dict[tuple[str, str], str] = {}
    for image, point, _, _, place in rows:
        checked(image, "image", place)
        checked(point, "point", place)
        first = seen.setdefault((image, point), place)
        if first is not place:
            raise InputError(f"{place}: {quoted(point)} is marked in {quoted(image)} in {first}, too; keep one of them")
    return Marks(
        tuple(r[0] for r in rows),
        tuple(r[1] for r in rows),
        np.array([r[2] for r in rows], float).reshape(-1, 2),
        np.array([r[3] for r in rows], float),
        tuple(r[4] for r in rows),
    )


def checked(name: str, what: str, place: str) -> str:
    """`name`. Raises InputError for one that is empty, too long or does harm where results show it."""
    if not name:
        raise InputError(f"{place}: the {what} is empty; give its name or delete the row")
    if len(name) > LONGEST or harm_in(name):
        raise InputError(f"{place}: the {what} {quoted(name)} {harm_in(name)}")
    return name
