"""Which tables a block folder may hold, and those of declared observations read from it and written to it."""

from collections.abc import Iterable, Mapping, Sequence

import pandas as pd

from jaxphoto.block import Block
from jaxphoto.errors import BlockError
from jaxphoto.io.block_folder.joint import (
    correlated_tables,
    joint_layouts,
    known_tables,
    read_correlated,
    read_known,
)
from jaxphoto.io.block_folder.observed import Ids, Kind, check_absent, layout_of, own_tables, read_rows, table_of
from jaxphoto.io.block_folder.settings import Settings
from jaxphoto.io.block_folder.table_layout import LAYOUTS, TableLayout
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import AbstractObservations, Correlated, Distances, KnownParameters


def layouts(kinds: Iterable[Kind], partitions: tuple[str, ...] = ()) -> dict[str, TableLayout]:
    """All tables that a folder may hold, by name; `partitions` are columns of images.csv."""
    images = LAYOUTS["images"]
    images = images._replace(columns=(*images.columns, *partitions), text=partitions)
    plain = {kind.group: layout_of(kind) for kind in own_tables(kinds)}
    return LAYOUTS | {"images": images} | plain | joint_layouts(kinds)


def read_declared(
    kinds: Sequence[Kind], tables: Mapping[str, Table], ids: Ids, settings: Settings
) -> tuple[Distances, tuple[AbstractObservations | KnownParameters, ...]]:
    """The distances of a block, and its `more`: a group a table, sets of correlated rows, known parameters."""
    plain = [read_rows(kind, tables[kind.group], ids, settings) for kind in own_tables(kinds)]
    joint = [group for kind in kinds for group in read_correlated(kind, tables, ids)]
    (distances,) = (rows for rows in plain if isinstance(rows, Distances))
    further = [rows for rows in plain if len(rows) and rows is not distances]
    return distances, (*further, *joint, *read_known(tables))


def declared_tables(block: Block) -> dict[str, pd.DataFrame]:
    """The tables that `read_declared` reads as the distances and `more` of a block; groups of one class make one.

    Raises BlockError for rows of a class whose table can hold only those of the block itself.
    """
    names = {"image": block.images, "point": block.points}
    names |= {kind: tuple(owners) for kind, owners in block.start.unknowns.tables.items()}
    plain: dict[Kind, list[AbstractObservations]] = {Distances: [block.distances]}
    joint: dict[Kind, list[Correlated]] = {}
    for rows in block.more:
        if isinstance(rows, Correlated):
            check_absent(rows.flat)
            joint.setdefault(type(rows.rows), []).append(rows)
        elif isinstance(rows, AbstractObservations):
            check_absent(rows)
            if type(rows).group in LAYOUTS:
                raise BlockError(
                    f"Block.more has {rows.group}, but {rows.group}.csv is for those of Block.{rows.group}; join them "
                    "with these, or give them covariances (observations.correlated)"
                )
            plain.setdefault(type(rows), []).append(rows)
    tables = {kind.group: table_of(kind.joined(*groups), names) for kind, groups in plain.items()}
    for groups in joint.values():
        tables |= correlated_tables(groups, names)
    known = [rows for rows in block.more if isinstance(rows, KnownParameters)]
    return tables | (known_tables(known) if known else {})


def kinds_of(block: Block) -> list[Kind]:
    """The classes of the observations of `more`."""
    groups = [rows.rows if isinstance(rows, Correlated) else rows for rows in block.more]
    return list(dict.fromkeys(type(rows) for rows in groups if isinstance(rows, AbstractObservations)))
