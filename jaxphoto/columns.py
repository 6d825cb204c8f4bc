"""Checked columns of a table in memory; errors name table, column and entry."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.errors import InputError
from jaxphoto.rounding import float_step


@runtime_checkable
class TableLike(Protocol):
    """Columns by name: a dictionary of arrays or a pandas DataFrame."""

    def __getitem__(self, column: str, /) -> Any: ...

    def __iter__(self) -> Iterator[str]: ...


def _name(value: Any) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").strip()
    if isinstance(value, float):
        return "" if np.isnan(value) else str(int(value)) if value.is_integer() else str(value)
    return "" if value is None else str(value).strip()


class CheckedColumns:
    """Checked columns of a table in memory; `name` appears in messages."""

    def __init__(self, name: str, columns: TableLike | None, *bare: str) -> None:
        """Create from a table; None is an empty table with the columns `bare`."""
        self.name = name
        given: TableLike = dict.fromkeys(bare, ()) if columns is None else columns
        if isinstance(given, (Sequence, np.ndarray)):
            raise InputError(
                f"{name}: a {type(given).__name__} is no table; give a dictionary of columns or a DataFrame"
            )
        self._refuse_other_rows({str(key): given[key] for key in given})
        self.columns = {str(key): self._array(str(key), given[key]) for key in given}
        lengths = {key: len(np.atleast_1d(column)) for key, column in self.columns.items()}
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"{key} {n}" for key, n in lengths.items())
            raise InputError(f"{name}: the columns differ in length ({listed}); give every column one value per entry")
        self.n = next(iter(lengths.values()), 0)

    def __contains__(self, column: str) -> bool:
        return column in self.columns

    def _array(self, column: str, values: Any) -> np.ndarray:
        """Convert to an array; masked numbers are NaN."""
        if not (isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values)):
            return np.asarray(values)
        if values.dtype.kind not in "fiu":
            raise self.wrong(np.flatnonzero(np.ma.getmaskarray(values))[0], f"{column} is masked; remove the entry")
        return np.ma.filled(values.astype(float), np.nan)

    def _refuse_other_rows(self, given: Mapping[str, Any]) -> None:
        """Raise InputError for pandas Series with different indexes: their rows are matched by position here."""
        series = {key: values for key, values in given.items() if hasattr(values, "iloc")}
        for key, values in series.items():
            first, reference = next(iter(series.items()))
            if len(values) == len(reference) and not values.index.equals(reference.index):
                raise InputError(
                    f"{self.name}: {first} and {key} are Series with different indexes; give one DataFrame, or "
                    ".to_numpy() of each if their order is the same"
                )

    def wrong(self, entry: int | np.integer, message: str) -> InputError:
        """Return an error about an entry, counted from 0."""
        return InputError(f"{self.name}, entry {entry}: {message}")

    def ids(self, column: str, *, empty: bool = False) -> list[str]:
        """Return names as text without surrounding blanks; whole numbers without decimals.

        Raises InputError for an empty name, unless `empty`.
        """
        names = [_name(v) for v in self._column(column).tolist()]
        if "" in names and not empty:
            raise self.wrong(names.index(""), f"the {column} is empty; give its id or remove the entry")
        return names

    def numbers(self, *columns: str, empty: bool = False) -> Float[np.ndarray, "n k"]:
        """Return finite numbers, one column each; NaN is allowed if `empty`. Truth values and dates are no numbers."""
        for c in columns:
            if (dtype := self._column(c).dtype).kind in "bcmM":
                raise InputError(f"{self.name}: the column {c} is {dtype}; give real numbers in the unit of its name")
        try:
            values = np.stack([np.asarray(self._column(c), float).reshape(self.n) for c in columns], axis=1)
        except (TypeError, ValueError) as error:
            raise InputError(f"{self.name}: {', '.join(columns)} must have one number per entry ({error})") from None
        for entry, k in np.argwhere(~np.isfinite(values)):
            if not (empty and np.isnan(values[entry, k])):
                raise self.wrong(entry, f"{columns[k]} is {values[entry, k]}; give a number")
        return values

    def sigmas(
        self, columns: Sequence[str], of_all: str, default: float | None = None, needed: np.ndarray | None = None
    ) -> Float[np.ndarray, "n k"]:
        """Return positive standard deviations: one column each, or one column or value for all.

        Not required where `needed` (n, k) is false: zero there.
        """
        needed = np.ones((self.n, len(columns)), bool) if needed is None else needed
        if set(columns) <= set(self.columns):
            values = self.numbers(*columns, empty=True)
        elif of_all in self or default is not None:
            one = self.numbers(of_all, empty=True) if of_all in self else np.full((self.n, 1), float(default or 0))
            values = np.repeat(one, len(columns), axis=1)
        elif needed.any():
            raise InputError(f"{self.name}: no standard deviation; give {' and '.join(columns)}, or {of_all}")
        else:
            values = np.zeros(needed.shape)
        for entry, k in np.argwhere(needed & ~(values > 0)):
            raise self.wrong(entry, f"the standard deviation {columns[k]} is {values[entry, k]}; it must be positive")
        return np.where(needed, values, 0.0)

    def warn_of_32_bits(self, columns: Sequence[str], sigmas: Float[np.ndarray, "n k"]) -> None:
        """Warn of columns of 32-bit numbers whose step is not small compared with their smallest standard deviation."""
        for k, name in enumerate(columns):
            values, sigma = self.columns.get(name, np.zeros(0)), sigmas[:, k][sigmas[:, k] > 0]
            if len(sigma) and (step := float_step(values, float(sigma.min()))):
                warnings.warn(
                    f"{self.name}, column {name}: {values.dtype} has steps of {step:.2g} at "
                    f"{np.nanmax(np.abs(values)):.7g}, sigma is {sigma.min():.2g}; give float64 computed from the "
                    "original numbers",
                    UserWarning,
                    stacklevel=4,
                )

    def index(self, column: str, known: Sequence[str], message: str) -> Int[np.ndarray, "n"]:
        """Return the index of each name of a column in `known`; see `find`."""
        return self.find(self.ids(column), known, message)

    def find(self, names: Sequence[str], known: Sequence[str], message: str) -> Int[np.ndarray, "n"]:
        """Return the index of each of `names` in `known`. Raises InputError for an unknown name; `message` is a
        template with {name}.
        """
        places = {name: k for k, name in enumerate(known)}
        for entry, name in enumerate(names):
            if name not in places:
                raise self.wrong(entry, message.format(name=name))
        return np.array([places[name] for name in names], int)

    def refuse_twice(self, column: str) -> None:
        """Raise InputError for a duplicate name in a column."""
        met: set[str] = set()
        for entry, name in enumerate(self.ids(column)):
            if name in met:
                raise self.wrong(entry, f"{column} {name} is given twice")
            met.add(name)

    def _column(self, column: str) -> np.ndarray:
        if column not in self.columns:
            there = ", ".join(self.columns) or "none"
            raise InputError(f"{self.name}: the column {column} is missing; its columns are {there}")
        return self.columns[column]
