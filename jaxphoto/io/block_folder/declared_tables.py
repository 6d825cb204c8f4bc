"""Read and write tables of declared observations by the columns of their classes (`observations.columns`).

Values are in the object frame, even if other files are in a map system. Observations with a covariance matrix have two
tables, the rows by set and the lower triangle of each matrix:

    correlated_stations.csv                 set, image, axis, value_m
    correlated_stations_covariance.csv      set, a, b, covariance_m2

`a` and `b` are indices from 1 into the components of a set, ordered by row, then by component of the row. Missing
entries are zero. The sets of a class may differ in size. known_parameters.csv has the columns set, label, value (in the
unit suffix of the label), and reservation, a warning about the source of a set.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Block
from jaxphoto.errors import BlockError, InputError, few
from jaxphoto.io.block_folder.observations import Images, ObservedPoints, sigmas_of
from jaxphoto.io.block_folder.settings import Settings
from jaxphoto.io.block_folder.table_layout import LAYOUTS, Column, TableLayout, numbers, refuse_duplicates, text
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import (
    OBSERVATIONS,
    AbstractObservations,
    Correlated,
    Distances,
    KnownParameters,
    columns_of,
    correlated,
    is_covariance,
    sigma_key,
)
from jaxphoto.observations import Column as ClassColumn
from jaxphoto.observations.columns import FILE_UNITS

Kind = type[AbstractObservations]
Names = Mapping[str, Sequence[str]]
"""Ids of images, points and owners of unknowns, by kind."""
KNOWN, JOINT, _MATRIX, _RESERVATION = "known_parameters", "correlated_", "_covariance", "reservation"


class Ids(NamedTuple):
    """Ids that tables may contain."""

    images: Images
    points: ObservedPoints
    owners: Names

    def find(self, table: Table, column: str, kind: str) -> np.ndarray:
        """Return the index of the id of type `kind` in each line. Raises BlockError for unknown ids."""
        if kind == "image":
            return self.images.find(table, column)
        known, cure = self.points.ids, "is measured in no image; measure it or delete the row"
        if kind != "point":
            known = tuple(self.owners.get(kind, ()))
            cure = f"is none of the {kind} of this block ({few(known) or 'it has none'}); correct it"
        return table.find(column, known, lambda name: f"{kind} {name} {cure}")


def known_kinds(more: Iterable[Kind]) -> tuple[Kind, ...]:
    """Return the classes that files may contain, of jaxphoto and `more`. Raises BlockError for duplicate names."""
    kinds = tuple(dict.fromkeys((*OBSERVATIONS, *more)))
    taken = set(LAYOUTS) - {kind.group for kind in OBSERVATIONS}
    for kind in kinds:
        if kind.group in taken:
            raise BlockError(f"{kind.group}.csv is a table of another class; give {kind.__name__}.group another name")
        taken.add(kind.group)
    return kinds


def own_tables(kinds: Iterable[Kind]) -> list[Kind]:
    """Select the classes that this module reads: all without a reader for their table."""
    return [kind for kind in kinds if kind.group not in LAYOUTS]


def layouts(kinds: Iterable[Kind], partitions: Sequence[str] = ()) -> dict[str, TableLayout]:
    """Return the layouts of all tables of a folder, by name; `partitions` are columns of images.csv."""
    images = LAYOUTS["images"]
    tables = LAYOUTS | {"images": images._replace(columns=(*images.columns, *text(*partitions, required=False)))}
    matrix = text("set") + numbers("a", "b", required=True)
    tables[KNOWN] = TableLayout(
        (*text("set", "label"), *numbers("value", required=True), *text(_RESERVATION, required=False))
    )
    tables[KNOWN + _MATRIX] = TableLayout((*matrix, Column("covariance", required=True)))
    for kind in kinds:
        columns = tuple(
            Column(
                c.name,
                "text" if c.touches else "whole" if c.whole else "sigma" if c.field == "sigma"
                else "angle" if c.name.endswith("_deg") else "number",
                c.field != "sigma",
            )
            for c in columns_of(kind)
        )  # fmt: skip
        tables.setdefault(kind.group, TableLayout(columns))
        tables[JOINT + kind.group] = TableLayout(text("set") + tuple(c for c in columns if c.required))
        tables[JOINT + kind.group + _MATRIX] = TableLayout(
            (*matrix, Column(f"covariance{_square(kind)[0]}", required=True))
        )
    return tables


def read_declared(
    kinds: Sequence[Kind], tables: Mapping[str, Table], ids: Ids, settings: Settings
) -> tuple[Distances, tuple[AbstractObservations | KnownParameters, ...]]:
    """Read the distances of a block and its `more`: one group per table, correlated sets, known parameters."""
    plain = [_rows(kind, tables[kind.group], ids, settings) for kind in own_tables(kinds)]
    joint = [group for kind in kinds for group in _correlated(kind, tables, ids)]
    (distances,) = (rows for rows in plain if isinstance(rows, Distances))
    further = [rows for rows in plain if len(rows) and rows is not distances]
    return distances, (*further, *joint, *_known(tables))


def _rows(kind: Kind, table: Table, ids: Ids, settings: Settings) -> AbstractObservations:
    fields = _fields(kind, table, ids)
    sigma = np.zeros((len(table), *np.shape(kind.none().sigma)[1:]))  # type: ignore[attr-defined]
    for column in (c for c in columns_of(kind) if c.field == "sigma"):
        sigma[column.of_rows] = sigmas_of(table, column.name, settings, sigma_key(kind)) * column.scale
    rows = _instance(kind, table, fields | {"sigma": sigma})
    if kind.unique:
        touched = np.sort([fields[c.field][c.of_rows] for c in columns_of(kind) if c.touches], axis=0)
        thing = f"this {kind.group.replace('_', ' ').removesuffix('s')}"
        refuse_duplicates(table, {str(k): index for k, index in enumerate(touched)}, thing)
    return rows


def _fields(kind: Kind, table: Table, ids: Ids) -> dict[str, np.ndarray]:
    """Return all fields; sigmas and fields without a column are zero."""
    fields = {name: np.zeros((len(table), *v.shape[1:]), v.dtype) for name, v in vars(kind.none()).items()}
    for column in columns_of(kind):
        if column.touches:
            fields[column.field][column.of_rows] = ids.find(table, column.name, column.touches)
        elif column.field != "sigma":
            fields[column.field][column.of_rows] = table.numbers(column.name) * column.scale
    return fields


def _instance(kind: Kind, table: Table, fields: Mapping[str, np.ndarray]) -> AbstractObservations:
    rows = kind(**{name: v if v.dtype.kind == "i" else as_jax_array(v) for name, v in fields.items()})
    for line, message in rows.validation_errors():
        raise table.bad(line, message)
    return rows


def _correlated(kind: Kind, tables: Mapping[str, Table], ids: Ids) -> list[Correlated]:
    """Read the correlated sets of a class, one group per size."""
    table, groups = tables[JOINT + kind.group], []
    sets = list(_sets(table, tables[JOINT + kind.group + _MATRIX], *_square(kind), len(kind.axes)))
    for size in dict.fromkeys(len(lines) for lines, _ in sets):
        some = [(lines, matrix) for lines, matrix in sets if len(lines) == size]
        part = table.take(np.concatenate([lines for lines, _ in some]))
        covariance = np.stack([matrix for _, matrix in some])
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        shape = np.shape(kind.none().sigma)[1:]  # type: ignore[attr-defined]
        rows = _instance(kind, part, _fields(kind, part, ids) | {"sigma": sigma.reshape(-1, *shape)})
        groups.append(correlated(rows, np.arange(len(part)).reshape(-1, size), covariance))
    return groups


def _known(tables: Mapping[str, Table]) -> list[KnownParameters]:
    """Read the joint prior information, one entry per set."""
    table = tables[KNOWN]
    value, label, reservation = table.numbers("value"), table.text("label"), table.text(_RESERVATION)
    return [
        KnownParameters(tuple(label[lines]), value[lines], matrix, next(filter(None, reservation[lines]), ""))
        for lines, matrix in _sets(table, tables[KNOWN + _MATRIX], "", 1.0, 1)
    ]


def _square(kind: Kind) -> tuple[str, float]:
    """Return the unit suffix of the covariance column, and the factor that converts it to jaxphoto's unit."""
    unit = FILE_UNITS.get(kind.unit, kind.unit)
    return (f"_{unit.replace('_per_', '2_per_')}2" if unit else ""), (np.pi / 180) ** 2 if unit != kind.unit else 1.0


def _sets(table: Table, matrices: Table, unit: str, scale: float, k: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the lines of each set, and its covariance matrix with `k` components per line."""
    named, owner = table.text("set"), matrices.text("set")
    matrices.find(
        "set", list(dict.fromkeys(named)), lambda name: f"set {name} is not in {table.file}; add or delete it"
    )
    places, value = matrices.matrix("ab"), matrices.numbers(f"covariance{unit}") * scale
    lines_of, entries_of = (pd.Series(names).groupby(names, sort=False).indices for names in (named, owner))
    for name in dict.fromkeys(named):
        lines, entries = np.asarray(lines_of[name]), np.asarray(entries_of.get(name, ()), int)
        n = k * len(lines)
        matrix = np.full((n, n), np.nan)
        for line in entries:
            a, b = places[line]
            if not (min(a, b) >= 1 and max(a, b) <= n and a % 1 == 0 and b % 1 == 0):
                raise matrices.bad(line, f"a and b count the numbers of set {name}, 1 to {n}; correct {a:g}, {b:g}")
            row, column = int(a) - 1, int(b) - 1
            if np.isfinite(matrix[row, column]) and matrix[row, column] != value[line]:
                message = f"the covariance of {a:g} and {b:g} of set {name} is given with two values; keep one"
                raise matrices.bad(line, message)
            matrix[row, column] = matrix[column, row] = value[line]
        matrix = np.nan_to_num(matrix)
        if not is_covariance(matrix):
            raise InputError(
                f"{matrices.file}: the covariance matrix of set {name} is not positive definite; give a variance "
                f"of each of its {n} numbers (a = b), and consistent covariances"
            )
        yield lines, matrix


def kinds_of(block: Block) -> list[Kind]:
    """Return the classes of the observations in `more`."""
    groups = [rows.rows if isinstance(rows, Correlated) else rows for rows in block.more]
    return list(dict.fromkeys(type(rows) for rows in groups if isinstance(rows, AbstractObservations)))


def declared_tables(block: Block) -> dict[str, pd.DataFrame]:
    """Return the tables of the distances and `more` of a block; groups of one class are joined.

    Raises BlockError for rows in `more` whose table is reserved for another field of the block.
    """
    names = {"image": block.images, "point": block.points}
    names |= {kind: tuple(owners) for kind, owners in block.start.unknowns.tables.items()}
    plain: dict[Kind, list[AbstractObservations]] = {Distances: [block.distances]}
    joint: dict[Kind, list[Correlated]] = {}
    for rows in block.more:
        if isinstance(rows, Correlated):
            joint.setdefault(type(rows.rows), []).append(rows)
        elif isinstance(rows, AbstractObservations):
            if type(rows).group in LAYOUTS:
                raise BlockError(
                    f"Block.more contains {rows.group}, but {rows.group}.csv is reserved for Block.{rows.group}; move "
                    "them there, or give them covariances (observations.correlated)"
                )
            plain.setdefault(type(rows), []).append(rows)
    tables = {kind.group: _table(kind.joined(*groups), names) for kind, groups in plain.items()}
    for groups in joint.values():
        tables |= _correlated_tables(groups, names)
    known = [rows for rows in block.more if isinstance(rows, KnownParameters)]
    return tables | (_known_tables(known) if known else {})


def _table(rows: AbstractObservations, names: Names, sigmas: bool = True) -> pd.DataFrame:
    """Return the table of `rows`. Raises BlockError for a nonzero field that has no column."""
    columns = columns_of(type(rows))
    for name, value in vars(rows).items():
        if name not in [c.field for c in columns] and np.any(np.asarray(value) != 0):
            raise BlockError(f"{rows.group}: {name} has no file format and must be zero; set it to zero")
    return pd.DataFrame({c.name: _cells(rows, c, names) for c in columns if sigmas or c.field != "sigma"})


def _cells(rows: AbstractObservations, column: ClassColumn, names: Names) -> np.ndarray:
    values = np.asarray(getattr(rows, column.field))[column.of_rows]
    if column.touches:
        return np.array(names[column.touches], object)[values]
    return values if column.whole else values / column.scale


def _correlated_tables(groups: Sequence[Correlated], names: Names) -> dict[str, pd.DataFrame]:
    """Return the two tables of the correlated sets of one class: rows and covariances."""
    parts: list[pd.DataFrame] = []
    matrices: list[np.ndarray] = []
    for group in groups:
        size = int(np.shape(group.covariance)[1]) // len(group.rows.axes)
        table = _table(group.flat, names, sigmas=False)
        table.insert(0, "set", np.repeat(np.arange(len(group)) + len(matrices) + 1, size))
        parts.append(table)
        matrices += list(np.asarray(group.covariance))
    kind = type(groups[0].rows)
    name = JOINT + kind.group
    return {name: pd.concat(parts, ignore_index=True), name + _MATRIX: _entries(matrices, *_square(kind))}


def _known_tables(groups: Sequence[KnownParameters]) -> dict[str, pd.DataFrame]:
    """Return the two tables of known parameters: values and covariances."""
    rows = [
        (k, label, value, group.reservation)
        for k, group in enumerate(groups, 1)
        for label, value in zip(group.labels, np.asarray(group.value), strict=True)
    ]
    table = pd.DataFrame(rows, columns=["set", "label", "value", _RESERVATION])
    if not table[_RESERVATION].any():
        table = table.drop(columns=_RESERVATION)
    return {KNOWN: table, KNOWN + _MATRIX: _entries([np.asarray(g.covariance) for g in groups], "", 1.0)}


def _entries(matrices: Sequence[np.ndarray], unit: str, scale: float) -> pd.DataFrame:
    parts = []
    for k, matrix in enumerate(matrices, 1):
        a, b = np.tril_indices(len(matrix))
        kept = (matrix[a, b] != 0) | (a == b)
        columns = {"set": k, "a": a[kept] + 1, "b": b[kept] + 1, f"covariance{unit}": matrix[a, b][kept] / scale}
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)
