"""The tables of a result folder, as pandas has them."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from jaxphoto.errors import InputError

# Names may look like numbers: image 0012 is not image 12.
_TEXT = dict.fromkeys(
    (
        "camera", "image", "point", "parameter", "parameter_a", "parameter_b", "quantity", "file", "unit", "strip",
        "one", "other", "group", "model", "serial", "lens_serial", "firmware", "drone",
    ),
    str,
)  # fmt: skip


def read_result_tables(folder: str | Path, names: Sequence[str] = ()) -> dict[str, pd.DataFrame]:
    """The tables of a folder of results by name: all of it, or those of `names` in their order.

    Raises InputError where there is none, where one of `names` is missing, and where a file is no table.
    """
    files = {path.stem: path for path in sorted(Path(folder).glob("*.csv"))}
    if not files:
        raise InputError(f"{folder} holds no tables (.csv): give a folder of results, as adjust writes it")
    if missing := [name for name in names if name not in files]:
        raise InputError(f"{folder} has no table {missing[0]}; it has {', '.join(files)}")
    return {name: read_table(files[name]) for name in names or files}


def read_table(path: Path) -> pd.DataFrame:
    """One of them. Raises InputError where the file is no table."""
    try:
        return pd.read_csv(path, dtype=_TEXT, keep_default_na=False, na_values=[""])
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path.name} cannot be read as a table: {' '.join(str(error).split())}") from error
