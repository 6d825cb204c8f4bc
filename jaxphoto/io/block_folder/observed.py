"""Tables of declared observations: what the columns of a class say, read and written (`observations.columns`).

Numbers are those of the object frame, whatever the frame of other files.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.arrays import on_device
from jaxphoto.errors import BlockError, few
from jaxphoto.io.block_folder.control import default_sigma
from jaxphoto.io.block_folder.image_points import ObservedPoints
from jaxphoto.io.block_folder.images import Images, check_angles, refuse_duplicates
from jaxphoto.io.block_folder.section import MOST
from jaxphoto.io.block_folder.settings import Settings
from jaxphoto.io.block_folder.table_layout import LAYOUTS, TableLayout
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import OBSERVATIONS, AbstractObservations, Column, columns_of, sigma_key

Kind = type[AbstractObservations]


class Ids(NamedTuple):
    """What ids in tables may name."""

    images: Images
    points: ObservedPoints
    owners: Mapping[str, Sequence[str]]
    """Of declared unknowns, by kind."""

    def find(self, table: Table, column: str, what: str) -> np.ndarray:
        """The number of what each line names. Raises BlockError for what there is not."""
        if what == "image":
            return self.images.find(table, column)
        named = table.ids(column)
        if what == "point":
            index, mend = self.points.find(named), "is measured in no image; measure it or delete the row"
        else:
            known = list(self.owners.get(what, ()))
            index = pd.Index(known, dtype=object).get_indexer(pd.Index(named))
            mend = f"is none of the {what} of this block ({few(known) or 'it has none'}); correct it"
        for line in np.flatnonzero(index < 0):
            raise table.misfit(line, f"{what} {named[line]} {mend}")
        return index


def known_kinds(more: Iterable[Kind]) -> tuple[Kind, ...]:
    """The classes that files may hold: those of jaxphoto, then `more`. Raises BlockError where two have one name."""
    kinds = tuple(dict.fromkeys((*OBSERVATIONS, *more)))
    taken = set(LAYOUTS) - {kind.group for kind in OBSERVATIONS}
    for kind in kinds:
        if kind.group in taken:
            raise BlockError(f"{kind.group}.csv is a table of another class; give {kind.__name__}.group another name")
        taken.add(kind.group)
    return kinds


def own_tables(kinds: Iterable[Kind]) -> list[Kind]:
    """The classes whose tables are read and written here, not by readers of their own."""
    return [kind for kind in kinds if kind.group not in LAYOUTS]


def layout_of(kind: Kind) -> TableLayout:
    """The table of a class; sigmas may be left out."""
    columns = columns_of(kind)
    return TableLayout(
        False,
        tuple(c.name for c in columns if c.field != "sigma"),
        tuple(c.name for c in columns if c.field == "sigma"),
        tuple(c.name for c in columns if c.touches),
    )


def read_rows(kind: Kind, table: Table, ids: Ids, settings: Settings) -> AbstractObservations:
    """The rows of a table. Raises InputError and BlockError with file, row and mend."""
    fields = read_fields(kind, table, ids)
    rows = rows_of(kind, table, fields | {"sigma": _sigmas(kind, table, settings)})
    if kind.once:
        touched = [fields[c.field][c.of_rows] for c in columns_of(kind) if c.touches]
        keys = np.sort(np.stack(touched), axis=0)
        thing = kind.group.replace("_", " ").removesuffix("s")
        refuse_duplicates(table, {str(k): key for k, key in enumerate(keys)}, f"this {thing} is given twice")
    return rows


def read_fields(kind: Kind, table: Table, ids: Ids) -> dict[str, np.ndarray]:
    """All fields but the sigmas, which are zero as are those without a column."""
    fields = {name: np.zeros((len(table), *v.shape[1:]), v.dtype) for name, v in vars(kind.none()).items()}
    for column in columns_of(kind):
        if column.field != "sigma":
            fields[column.field][column.of_rows] = _read(table, column, ids)
    return fields


def rows_of(kind: Kind, table: Table, fields: Mapping[str, np.ndarray]) -> AbstractObservations:
    """The rows of `fields`. Raises InputError for one that cannot be."""
    rows = kind(**{name: v if v.dtype.kind == "i" else on_device(v) for name, v in fields.items()})
    for line, message in rows.flaws():
        raise table.bad(line, message)
    return rows


def table_of(rows: AbstractObservations, names: Mapping[str, Sequence[str]]) -> pd.DataFrame:
    """The table that `read_rows` reads as `rows`; `names` of images, points and owners."""
    return pd.DataFrame({c.name: cells(rows, c, names) for c in columns_of(type(rows))})


def cells(rows: AbstractObservations, column: Column, names: Mapping[str, Sequence[str]]) -> np.ndarray:
    """One column of the table of `rows`."""
    values = np.asarray(getattr(rows, column.field))[column.of_rows]
    if column.touches:
        return np.array(names[column.touches], object)[values]
    return values if column.whole else values / column.scale


def check_absent(rows: AbstractObservations) -> None:
    """Raise BlockError for a field that files do not have, and which is not zero."""
    written = {column.field for column in columns_of(type(rows))}
    for name, value in vars(rows).items():
        if name not in written and np.any(np.asarray(value) != 0):
            raise BlockError(
                f"{rows.group}: {name} is in no file, where it counts as zero; it must be zero to be written"
            )


def _read(table: Table, column: Column, ids: Ids) -> np.ndarray:
    if column.touches:
        return ids.find(table, column.name, column.touches)
    values = table.numbers(column.name)
    if column.whole:
        for line in np.flatnonzero((values != np.round(values)) | (np.abs(values) > MOST)):
            raise table.bad(line, f"{column.name} is {values[line]:g}, not a whole number like 2; correct it")
        return values.astype(int)
    if column.name.endswith("_deg"):
        check_angles(table, values[:, None], (column.name,))
    return values * column.scale


def _sigmas(kind: Kind, table: Table, settings: Settings) -> np.ndarray:
    sigma = np.zeros((len(table), *np.shape(kind.none().sigma)[1:]))  # type: ignore[attr-defined]
    for column in (c for c in columns_of(kind) if c.field == "sigma"):
        given = table.sigmas(column.name)
        for line in np.flatnonzero(np.isnan(given)):
            given[line] = default_sigma(table, line, column.name, settings, sigma_key(kind))
        sigma[column.of_rows] = given * column.scale
    return sigma
