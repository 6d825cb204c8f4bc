"""Draws on disk: Parquet parts while a Monte Carlo runs, one file when it is done.

A part is written whole or not at all, so a run that was stopped at any moment goes on after its last part, and gives
the same file as one that was not.
"""

import contextlib
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from jaxphoto.block import Block
from jaxphoto.errors import InputError
from jaxphoto.io.json_file import read_json
from jaxphoto.writing import check_room, clear_leftovers, is_place, locked, whole_file

_RUN, _PARTS, DRAWS = "run.json", "parts", "draws.parquet"


class DrawsFolder:
    """The folder of one run: its settings, its parts, and the file of all draws.

    `settings` are all that the draws depend on. Raises InputError where the folder holds another run or something else.
    """

    def __init__(self, directory: Path, settings: dict, draws: int, per_part: int):
        self.directory, self.draws, self.per_part = directory, draws, per_part
        check_place(directory)
        settings = settings | {"draws": draws, "per_part": per_part}
        run = directory / _RUN
        if run.is_file():
            self._check(_settings_in(run), settings)
        else:
            with whole_file(run) as work:
                work.write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")
        if not self.done:
            (directory / _PARTS).mkdir(exist_ok=True)

    def _check(self, held: dict, settings: dict) -> None:
        wanted = json.loads(json.dumps(settings))
        different = [name for name in {**held, **wanted} if held.get(name) != wanted.get(name)]
        if different:
            name = different[0]
            raise InputError(
                f"{self.directory} holds a run with other settings ({name} {held.get(name)}, now {wanted.get(name)}): "
                "name a new folder, or give the settings of that run to go on with it"
            )

    @property
    def done(self) -> bool:
        """Whether all draws are in one file."""
        return (self.directory / DRAWS).is_file()

    @property
    def next_part(self) -> int:
        """The first part that is not there; parts are written in order. Raises InputError for one that is damaged."""
        k = 0
        while self._part(k).is_file():
            with _reading(self._part(k)):
                pq.read_schema(self._part(k))
            k += 1
        return k

    @property
    def n_parts(self) -> int:
        """Parts of the whole run."""
        return -(-self.draws // self.per_part)

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other processes from drawing into this folder meanwhile. Raises InputError where one does."""
        with locked(self.directory / _PARTS) as own:
            if own is False:
                raise InputError(f"another run is drawing into {self.directory}: wait for it, or name a new folder")
            yield

    def write_part(self, k: int, table: pd.DataFrame) -> None:
        """Keep the draws of part `k`."""
        with whole_file(self._part(k)) as work:
            pq.write_table(_arrow(table), work, write_page_checksum=True)

    def join(self) -> None:
        """Bring all parts to one file, part by part."""
        parts = [self._part(k) for k in range(self.n_parts)]
        with _reading(parts[0]):
            schema = pq.read_schema(parts[0])
        with (
            whole_file(self.directory / DRAWS) as work,
            pq.ParquetWriter(work, schema, write_page_checksum=True) as writer,
        ):
            for part in parts:
                with _reading(part):
                    writer.write_table(pq.read_table(part, page_checksum_verification=True))

    def tidy(self) -> None:
        """Remove the parts, which the file of all draws holds; what else somebody put beside them stays."""
        for k in range(self.n_parts):
            self._part(k).unlink(missing_ok=True)
        clear_leftovers(self.directory / _PARTS)
        with contextlib.suppress(OSError):
            (self.directory / _PARTS).rmdir()

    def columns(self) -> list[str]:
        """Names of the columns of the draws there are."""
        with _reading(self._files[0]):
            return pq.read_schema(self._files[0]).names

    def read(self, names: list[str]) -> dict[str, np.ndarray]:
        """Columns of the draws there are."""
        tables = []
        for file in self._files:
            with _reading(file):
                tables.append(pq.read_table(file, columns=names, page_checksum_verification=True).select(names))
        table = pa.concat_tables(tables)
        return {name: table.column(name).to_numpy() for name in names}

    @property
    def _files(self) -> list[Path]:
        """The file of all draws, or the parts there are."""
        return [self.directory / DRAWS] if self.done else [self._part(k) for k in range(self.next_part)]

    def _part(self, k: int) -> Path:
        return self.directory / _PARTS / f"part-{k:06d}.parquet"


def digest_of(block: Block) -> str:
    """A hash of everything that a block says."""
    arrays, structure = jax.tree.flatten(block)
    digest = hashlib.sha256(repr(structure).encode())
    for array in arrays:
        digest.update(np.asarray(array).tobytes())
    return digest.hexdigest()


def check_place(directory: Path) -> None:
    """Raises InputError where no run can be kept: a file, below a file, among something else."""
    for path in (directory, *directory.parents):
        if path.is_file():
            raise InputError(f"{path} is a file: name a folder for the draws")
    known = not directory.is_dir() or (directory / _RUN).is_file()
    if not known and any(not is_place(path.name) for path in directory.iterdir()):
        raise InputError(f"{directory} is not empty and holds no Monte Carlo run: name a new folder")
    check_room(directory / _RUN)


def _settings_in(run: Path) -> dict:
    try:
        return read_json(run)
    except InputError:
        raise InputError(f"{run} holds no settings of a Monte Carlo run: name a new folder") from None


@contextmanager
def _reading(file: Path) -> Iterator[None]:
    """Raises InputError where a file of draws is cut off or was changed."""
    try:
        yield
    # A name of a column that is no text is an error of Python's own.
    except (pa.ArrowException, OSError, KeyError, UnicodeDecodeError):
        raise InputError(f"{file} is damaged: delete it, and its draws are made anew") from None


def _arrow(table: pd.DataFrame) -> pa.Table:
    # Without pandas' own description, which tells of versions.
    return pa.Table.from_pandas(table, preserve_index=False).replace_schema_metadata(None)
