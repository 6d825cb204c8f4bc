"""Observations that a covariance matrix joins, in two tables: the rows by set, and the lower half of each matrix.

    correlated_stations.csv                 set, image, axis, value_m
    correlated_stations_covariance.csv      set, a, b, covariance_m2

`a` and `b` count the numbers of a set from 1: its rows in their order, and of each its numbers. What is not listed is
zero. Sets of a class need not be equally large. Parameters known together are alike: known_parameters.csv has set,
label and value, in the unit that the label ends in, and what speaks against where a set is from (reservation).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
import pandas as pd

from jaxphoto.errors import InputError
from jaxphoto.io.block_folder.observed import Ids, Kind, cells, layout_of, read_fields, rows_of
from jaxphoto.io.block_folder.table_layout import TableLayout
from jaxphoto.io.names import control_in
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import Correlated, KnownParameters, columns_of, correlated, is_covariance
from jaxphoto.observations.columns import FILE_UNITS

KNOWN = "known_parameters"
JOINT = "correlated_"
_MATRIX = "_covariance"
_AGAINST = "reservation"
# Numbers that one covariance matrix joins: some take minutes to invert.
_LARGEST_SET = 5_000


def joint_layouts(kinds: Iterable[Kind]) -> dict[str, TableLayout]:
    """The tables of sets, of classes and of parameters."""
    found = {
        KNOWN: TableLayout(False, ("set", "label", "value"), (_AGAINST,), ("set", "label", _AGAINST)),
        KNOWN + _MATRIX: _matrix(""),
    }
    for kind in kinds:
        plain = layout_of(kind)
        found[JOINT + kind.group] = TableLayout(False, ("set", *plain.columns), (), ("set", *plain.text))
        found[JOINT + kind.group + _MATRIX] = _matrix(_square(kind.unit)[0])
    return found


def read_correlated(kind: Kind, tables: Mapping[str, Table], ids: Ids) -> list[Correlated]:
    """Sets of rows of a class, those of one size together."""
    table, unit, found = tables[JOINT + kind.group], _square(kind.unit), []
    sets = list(_sets(table, tables[JOINT + kind.group + _MATRIX], *unit, len(kind.axes)))
    for size in dict.fromkeys(len(lines) for lines, _ in sets):
        alike = [(lines, matrix) for lines, matrix in sets if len(lines) == size]
        chosen = table.take(np.concatenate([lines for lines, _ in alike]))
        covariance = np.stack([matrix for _, matrix in alike])
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        shape = np.shape(kind.none().sigma)[1:]  # type: ignore[attr-defined]
        rows = rows_of(kind, chosen, read_fields(kind, chosen, ids) | {"sigma": sigma.reshape(-1, *shape)})
        found.append(correlated(rows, np.arange(len(chosen)).reshape(-1, size), covariance))
    return found


def read_known(tables: Mapping[str, Table]) -> list[KnownParameters]:
    """Parameters known together, an entry a set."""
    table = tables[KNOWN]
    value, label = table.numbers("value"), table.ids("label")
    sets = _sets(table, tables[KNOWN + _MATRIX], "", 1.0, 1)
    against = table.text(_AGAINST)
    for line in np.flatnonzero([control_in(said) for said in against]):
        raise table.bad(line, f"the {_AGAINST} has a control character, which a terminal would obey; remove it")
    return [
        KnownParameters(tuple(label[lines]), value[lines], matrix, next(filter(None, against[lines]), ""))
        for lines, matrix in sets
    ]


def correlated_tables(groups: Sequence[Correlated], names: Mapping[str, Sequence[str]]) -> dict[str, pd.DataFrame]:
    """The two tables of sets of rows of one class."""
    parts, matrices, first = [], [], 1
    for group in groups:
        flat, number = group.flat, np.repeat(np.arange(len(group)) + first, _size(group))
        own = {c.name: cells(flat, c, names) for c in columns_of(type(group.rows)) if c.field != "sigma"}
        parts.append(pd.DataFrame({"set": number} | own))
        matrices += list(np.asarray(group.covariance))
        first += len(group)
    name = JOINT + groups[0].rows.group
    return {name: pd.concat(parts, ignore_index=True), name + _MATRIX: _entries(matrices, *_square(groups[0].unit))}


def known_tables(groups: Sequence[KnownParameters]) -> dict[str, pd.DataFrame]:
    """The two tables of parameters known together."""
    rows = [(k + 1, *row) for k, g in enumerate(groups) for row in zip(g.labels, np.asarray(g.value), strict=True)]
    table = pd.DataFrame(rows, columns=["set", "label", "value"])
    if any(g.reservation for g in groups):
        table[_AGAINST] = np.repeat([g.reservation for g in groups], [len(g.labels) for g in groups])
    return {KNOWN: table, KNOWN + _MATRIX: _entries([np.asarray(g.covariance) for g in groups], "", 1.0)}


def _matrix(unit: str) -> TableLayout:
    return TableLayout(False, ("set", "a", "b", f"covariance{unit}"), (), ("set",))


def _square(unit: str) -> tuple[str, float]:
    """The end of the column of covariances in the square of a unit, and what its numbers are multiplied by."""
    own = FILE_UNITS.get(unit, unit)
    return (f"_{own.replace('_per_', '2_per_')}2" if own else ""), (np.pi / 180) ** 2 if own != unit else 1.0


def _size(group: Correlated) -> int:
    """Rows of a set."""
    return int(np.shape(group.covariance)[1]) // len(group.rows.axes)


def _sets(table: Table, matrices: Table, unit: str, scale: float, k: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Of each set its lines, and its covariance matrix over `k` numbers of each."""
    named, owner = table.ids("set"), matrices.ids("set")
    for line in np.flatnonzero(~np.isin(owner, named)):
        raise matrices.misfit(line, f"set {owner[line]} is not in {table.file}; add it there or delete the row")
    places = np.stack([matrices.numbers(name) for name in "ab"], axis=1)
    value = matrices.numbers(f"covariance{unit}") * scale
    lines_of, entries_of = (pd.Series(names).groupby(names, sort=False).indices for names in (named, owner))
    for name in dict.fromkeys(named):
        lines, entries = np.asarray(lines_of[name]), np.asarray(entries_of.get(name, ()), int)
        n = k * len(lines)
        if n > _LARGEST_SET:
            raise table.bad(
                lines[0], f"set {name} has {n} numbers, and a covariance matrix has at most {_LARGEST_SET}; divide it"
            )
        matrix = np.full((n, n), np.nan)
        for line in entries:
            a, b = places[line]
            if not (min(a, b) >= 1 and max(a, b) <= n and a % 1 == 0 and b % 1 == 0):
                raise matrices.bad(line, f"a and b count the numbers of set {name}, 1 to {n}; correct {a:g}, {b:g}")
            row, column = int(a) - 1, int(b) - 1
            if np.isfinite(matrix[row, column]) and matrix[row, column] != value[line]:
                said = f"the covariance of {a:g} and {b:g} of set {name} stands there with two values; keep one"
                raise matrices.bad(line, said)
            matrix[row, column] = matrix[column, row] = value[line]
        matrix = np.nan_to_num(matrix)
        if not is_covariance(matrix):
            raise InputError(
                f"{matrices.file}: the covariance matrix of set {name} is not positive definite; give a variance "
                f"of each of its {n} numbers (a = b), and covariances that go with them"
            )
        yield lines, matrix


def _entries(matrices: Sequence[np.ndarray], unit: str, scale: float) -> pd.DataFrame:
    found = []
    for k, matrix in enumerate(matrices):
        a, b = np.tril_indices(len(matrix))
        kept = (matrix[a, b] != 0) | (a == b)
        columns = {"set": k + 1, "a": a[kept] + 1, "b": b[kept] + 1, f"covariance{unit}": matrix[a, b][kept] / scale}
        found.append(pd.DataFrame(columns))
    return pd.concat(found, ignore_index=True)
