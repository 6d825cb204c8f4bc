"""Results of a study on disk, a row per draw: Parquet parts during a run, then one file.

Parts are written atomically and in any order. An interrupted run resumes with the missing parts and yields an identical
file.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from jaxphoto.block import Block
from jaxphoto.errors import InputError
from jaxphoto.io.text_files import read_json
from jaxphoto.writing import check_room, clear_leftovers, is_place, locked, whole_file

_RUN, _PARTS, DRAWS = "run.json", "parts", "draws.parquet"


class DrawsFolder:
    """Folder of one run: settings, parts, and the file of all draws.

    `settings` contains every input of the draws. Raises InputError if the folder contains a different run or other
    files.
    """

    def __init__(self, directory: Path, settings: dict, draws: int, per_part: int):
        self.directory, self.draws, self.per_part = directory, draws, per_part
        check_place(directory)
        settings = settings | {"draws": draws, "per_part": per_part}
        run = directory / _RUN
        if run.is_file():
            self._check(run, settings)
        else:
            with whole_file(run) as work:
                work.write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")
        if not self.done:
            (directory / _PARTS).mkdir(exist_ok=True)

    def _check(self, run: Path, settings: dict) -> None:
        held, wanted = read_json(run), json.loads(json.dumps(settings))
        for name in [name for name in {**held, **wanted} if held.get(name) != wanted.get(name)][:1]:
            raise InputError(
                f"{self.directory} has a run with other settings ({name} {held.get(name)}, now {wanted.get(name)}): "
                "use a new folder, or the settings of that run to continue it"
            )

    @property
    def done(self) -> bool:
        """True if all draws are in one file."""
        return (self.directory / DRAWS).is_file()

    def missing_parts(self) -> list[int]:
        """Return the indices of missing parts. Raises InputError if a part is damaged."""
        missing = []
        for k in range(self.n_parts):
            if self._part(k).is_file():
                with _reading(self._part(k)):
                    pq.read_schema(self._part(k))
            else:
                missing.append(k)
        return missing

    @property
    def n_parts(self) -> int:
        """Number of parts of the whole run."""
        return -(-self.draws // self.per_part)

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Lock the folder against other processes. Raises InputError if another run uses it."""
        with locked(self.directory / _PARTS) as own:
            if own is False:
                raise InputError(f"another run is drawing into {self.directory}: wait for it, or use a new folder")
            yield

    def fill(
        self,
        compute: Callable[[list[int]], Generator[tuple[int, pd.DataFrame], None, None]],
        progress: Callable[[int], object] = lambda done: None,
        enough: Callable[[pd.DataFrame], bool] = lambda table: False,
    ) -> None:
        """Write the missing parts, which `compute` yields in any order with their numbers, and join all.

        `progress` is called with the number of draws. `enough` is called with the parts in their order; after the first
        for which it is True, the run ends. Raises InputError if another process draws into the folder.
        """
        with self.alone():
            if not self.done:
                missing = self.missing_parts()
                with contextlib.closing(compute(missing)) as parts:
                    self._write(parts, missing, progress, enough)
                self.join()
            self.tidy()

    def _write(self, parts: Iterator, missing: list[int], progress: Callable, enough: Callable) -> None:
        waiting: dict[int, pd.DataFrame | None] = dict.fromkeys(set(range(self.n_parts)) - set(missing))
        done, following = self.draws - sum(map(self.size, missing)), 0
        while True:
            while following in waiting:
                table = waiting.pop(following)
                following += 1
                if enough(self._read_part(following - 1) if table is None else table):
                    self.draws = min(self.draws, following * self.per_part)
                    return
            if (new := next(parts, None)) is None:
                return
            part = new[0]
            waiting[part] = new[1]
            self.write_part(*new)
            done += self.size(part)
            progress(done)

    def size(self, part: int) -> int:
        """Return the number of draws of a part."""
        return min(self.per_part, self.draws - part * self.per_part)

    def _read_part(self, k: int) -> pd.DataFrame:
        with _reading(self._part(k)):
            return pq.read_table(self._part(k), page_checksum_verification=True).to_pandas()

    def write_part(self, k: int, table: pd.DataFrame) -> None:
        """Write the draws of part `k`."""
        with whole_file(self._part(k)) as work:
            # Remove pandas' metadata: they contain versions.
            arrow = pa.Table.from_pandas(table, preserve_index=False).replace_schema_metadata(None)
            pq.write_table(arrow, work, write_page_checksum=True)

    def join(self) -> None:
        """Join all parts into one file."""
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
        """Remove the parts after joining."""
        for part in (self.directory / _PARTS).glob("part-*.parquet"):
            part.unlink()
        clear_leftovers(self.directory / _PARTS)
        with contextlib.suppress(OSError):
            (self.directory / _PARTS).rmdir()

    def columns(self) -> list[str]:
        """Read the names of the columns."""
        with _reading(self._files[0]):
            return pq.read_schema(self._files[0]).names

    def read(self, names: list[str]) -> dict[str, np.ndarray]:
        """Read columns of all draws written so far."""
        tables = []
        for file in self._files:
            with _reading(file):
                tables.append(pq.read_table(file, columns=names, page_checksum_verification=True).select(names))
        table = pa.concat_tables(tables)
        return {name: table.column(name).to_numpy() for name in names}

    @property
    def _files(self) -> list[Path]:
        """File of all draws, or the parts written so far."""
        if self.done:
            return [self.directory / DRAWS]
        missing = set(self.missing_parts())
        return [self._part(k) for k in range(self.n_parts) if k not in missing]

    def _part(self, k: int) -> Path:
        return self.directory / _PARTS / f"part-{k:06d}.parquet"


def digest_of(block: Block) -> str:
    """Return the SHA-256 hash of a block."""
    arrays, structure = jax.tree.flatten(block)
    digest = hashlib.sha256(repr(structure).encode())
    for array in arrays:
        digest.update(np.asarray(array).tobytes())
    return digest.hexdigest()


def check_place(directory: Path) -> None:
    """Raise InputError if no run can be written: `directory` is a file, or contains other files."""
    for path in (directory, *directory.parents):
        if path.is_file():
            raise InputError(f"{path} is a file: give a folder for the draws")
    known = not directory.is_dir() or (directory / _RUN).is_file()
    if not known and any(not is_place(path.name) for path in directory.iterdir()):
        raise InputError(f"{directory} is not empty and has no Monte Carlo run: give a new folder")
    check_room(directory / _RUN)


@contextmanager
def _reading(file: Path) -> Iterator[None]:
    """Raise InputError if a file of draws is damaged."""
    try:
        yield
    # pyarrow raises KeyError or UnicodeDecodeError for damaged column names.
    except (pa.ArrowException, OSError, KeyError, UnicodeDecodeError):
        raise InputError(f"{file} is damaged: delete it to repeat its draws") from None
