"""Surveyed points and marks gathered from the rows of control files of any format."""

from collections.abc import Sequence

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.names import LONGEST, harm_in
from jaxphoto.procedures.control.surveyed import Marks, SurveyedPoints

Mark = tuple[str, str, list[float], float, str]
"""Image, point, column and row, sigma in pixels, place for messages."""


class SurveyRows:
    """Surveyed points in the order of the file."""

    def __init__(self, file: str) -> None:
        self.file = file
        self._rows: dict[str, tuple[list[float], list[float], bool, str]] = {}
        self._names: dict[tuple[str, ...], str] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def named_by(self, xyz: Sequence[float]) -> str:
        """Return the name of a point without one: P1, P2 ..., one for each position."""
        return self._names.setdefault(tuple(map(repr, xyz)), f"P{len(self._names) + 1}")

    def add(
        self,
        name: str,
        xyz: list[float],
        place: str,
        sigma: list[float] | None = None,
        check: bool = False,
        once: bool = False,
    ) -> None:
        """Add a point; with `once`, even a repeated point with the same coordinates is an error."""
        check_name(name, "point", place)
        row = (xyz, sigma or [np.nan] * 3, check, place)
        first = self._rows.setdefault(name, row)
        same = np.array_equal(np.array(first[0]), np.array(xyz), equal_nan=True)
        if first is not row and (once or not same):
            other = "" if same else " with other coordinates"
            raise InputError(
                f"{place}: the point {quoted(name)} stands in {first[3]}, too{other}; give each point once"
            )

    def surveyed(self, system: str = "") -> SurveyedPoints:
        """Return all points. Raise InputError if there is none."""
        if not self._rows:
            raise InputError(f"{self.file}: there is no point with coordinates; add some")
        xyz, sigma, check, place = zip(*self._rows.values(), strict=True)
        points = np.array(xyz, float).reshape(-1, 3), np.array(sigma, float).reshape(-1, 3), np.array(check, bool)
        return SurveyedPoints(self.file, tuple(self._rows), *points, place, system)


def read_marks(rows: Sequence[Mark]) -> Marks:
    """Return marks of rows. Raise InputError for invalid names, and for a point marked twice in an image."""
    seen: dict[tuple[str, str], str] = {}
    for image, point, _, _, place in rows:
        check_name(image, "image", place)
        check_name(point, "point", place)
        first = seen.setdefault((image, point), place)
        if first is not place:
            raise InputError(f"{place}: {quoted(point)} is marked in {quoted(image)} in {first}, too; keep one of them")
    images, points, at, sigma, places = zip(*rows, strict=True) if rows else ((),) * 5
    return Marks(images, points, np.array(at, float).reshape(-1, 2), np.array(sigma, float), places)


def check_name(name: str, what: str, place: str) -> None:
    """Raise InputError for a name that is empty, too long or harmful in results."""
    if not name:
        raise InputError(f"{place}: the {what} is empty; give its name or delete the row")
    if len(name) > LONGEST or harm_in(name):
        raise InputError(f"{place}: the {what} {quoted(name)} {harm_in(name)}")
