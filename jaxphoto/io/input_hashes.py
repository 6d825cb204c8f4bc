"""The files that a block was read from, by SHA-256, and the table inputs.csv of a result folder."""

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.text_tables import read_csv
from jaxphoto.io.toml import read_toml
from jaxphoto.writing import InputFile, input_file

INPUTS = "inputs.csv"
# Of a folder that block.toml names, such as an earlier calibration.
_OF_FOLDER = ("interior.csv", "correlation.csv", "summary.json", TOML, "camera.toml")
_SHA256 = re.compile(r"[0-9a-f]{64}")


def block_inputs(folder: Path) -> list[InputFile]:
    """block.toml, the tables beside it, and files that it names elsewhere, in the order of their names."""
    found = {path.name: path for path in sorted(folder.glob("*.csv"))} | {TOML: folder / TOML}
    for word in _words(read_toml(folder / TOML)):
        path = folder / word
        inside = [path / name for name in _OF_FOLDER] if path.is_dir() else [path]
        found |= {Path(os.path.relpath(path, folder)).as_posix(): path for path in inside if path.is_file()}
    return [input_file(path, name) for name, path in sorted(found.items())]


def _words(value: Any) -> Iterator[str]:
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _words(inner)
    elif isinstance(value, str) and value.strip(". /"):
        yield value


def write_inputs(files: Sequence[InputFile], folder: Path) -> None:
    """inputs.csv: file, n_bytes, sha256."""
    pd.DataFrame(files, columns=InputFile._fields).to_csv(folder / INPUTS, index=False)


def read_inputs(path: Path) -> list[InputFile]:
    """The rows of an inputs.csv. Raises InputError for what is none."""
    table = read_csv(path, InputFile._fields, text=("file", "sha256"))
    names, digests = table.text("file").tolist(), table.text("sha256").tolist()
    sizes = table.numbers("n_bytes").tolist()
    for line, (size, digest) in enumerate(zip(sizes, digests, strict=True)):
        if not _SHA256.fullmatch(digest):
            raise table.bad(line, "sha256 is not 64 hexadecimal digits; write the results anew")
        if size < 0 or size != int(size):
            raise table.bad(line, f"n_bytes is {size:g}, no count; write the results anew")
    return [InputFile(n, int(s), d) for n, s, d in zip(names, sizes, digests, strict=True)]
