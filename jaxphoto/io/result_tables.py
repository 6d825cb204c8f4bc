"""Files of a result folder: tables, summary.json with its verdict, and hashes of the inputs."""

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from jaxphoto.errors import InputError
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.text_files import read_json, read_text
from jaxphoto.io.text_tables import read_csv
from jaxphoto.io.toml import read_toml
from jaxphoto.writing import InputFile, input_file

SUMMARY, INPUTS, TRUTH = "summary.json", "inputs.csv", "truth"
# Columns of text: ids may look like numbers, and image 0012 is not image 12.
_TEXT = dict.fromkeys(
    (
        "camera", "image", "point", "parameter", "parameter_a", "parameter_b", "quantity", "file", "unit", "strip",
        "one", "other", "group", "model", "serial", "lens_serial", "firmware", "drone",
    ),
    str,
)  # fmt: skip
# Files read from a folder that block.toml names, such as an earlier calibration.
_OF_FOLDER = ("interior.csv", "correlation.csv", SUMMARY, TOML, "camera.toml")


def read_result_tables(folder: str | Path, names: Sequence[str] = ()) -> dict[str, pd.DataFrame]:
    """Read the tables of a result folder by name: all, or `names` in their order.

    Raises InputError for folders without tables, missing `names`, and invalid files.
    """
    files = {path.stem: path for path in sorted(Path(folder).glob("*.csv"))}
    if not files:
        raise InputError(f"{folder} has no tables (.csv): give a result folder of jaxphoto adjust")
    if missing := [name for name in names if name not in files]:
        raise InputError(f"{folder} has no table {missing[0]}; it has {', '.join(files)}")
    return {name: read_table(files[name]) for name in names or files}


def read_truth(folder: str | Path) -> dict[str, pd.DataFrame]:
    """Read the true values in the folder of a block; empty if the block was not simulated."""
    return {path.stem: read_table(path) for path in sorted((Path(folder) / TRUTH).glob("*.csv"))}


def read_table(path: Path) -> pd.DataFrame:
    """Read one result table. Raises InputError for an invalid file."""
    content = io.StringIO(read_text(path))
    try:
        return pd.read_csv(content, dtype=_TEXT, keep_default_na=False, na_values=[""])
    except ValueError as error:
        raise InputError(f"{path.name} cannot be read as a table: {' '.join(str(error).split())}") from error


def read_summary(folder: Path) -> dict[str, Any]:
    """Read summary.json of a result folder; empty if it is missing or invalid."""
    try:
        return read_json(folder / SUMMARY)
    except InputError:
        return {}


def reservation(summary: Mapping[str, Any]) -> str:
    """Return the most severe warning about an adjustment (convergence, verdict, global test, prior); "" if none."""
    if summary.get("converged") is False:
        return f"this adjustment did not converge, so its results are invalid: {summary.get('outcome')}"
    if summary.get("verdict") == "red":
        texts = [f["text"] for f in summary.get("findings", ()) if f.get("severity") == "error"]
        return f"the verdict on this adjustment is red: {texts[0] if texts else 'see its report'}"
    test = summary.get("global_test") or {}
    if test.get("passed") is False:
        sigma0, expected = summary["sigma0"], test["expected_sigma0"]
        return (
            f"sigma naught of this adjustment is {sigma0:.3g}, expected {expected:.3g}, a significant difference: its "
            "weights or its model are wrong, and so are its standard deviations"
        )
    if prior_warnings := summary.get("prior_warnings"):
        return f"this adjustment depends on an earlier one: {prior_warnings[0]}"
    return ""


def block_inputs(folder: Path) -> list[InputFile]:
    """Return the hashes of block.toml, its tables, and all files that it names, sorted by name."""
    files = {path.name: path for path in sorted(folder.glob("*.csv"))} | {TOML: folder / TOML}
    for word in _words(read_toml(folder / TOML)):
        path = folder / word
        inside = [path / name for name in _OF_FOLDER] if path.is_dir() else [path]
        files |= {Path(os.path.relpath(path, folder)).as_posix(): path for path in inside if path.is_file()}
    return [input_file(path, name) for name, path in sorted(files.items())]


def _words(value: Any) -> Iterator[str]:
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _words(inner)
    elif isinstance(value, str) and value.strip(". /"):
        yield value


def write_inputs(files: Sequence[InputFile], folder: Path) -> None:
    """Write inputs.csv: file, n_bytes, sha256."""
    pd.DataFrame(files, columns=InputFile._fields).to_csv(folder / INPUTS, index=False)


def read_inputs(path: Path) -> list[InputFile]:
    """Read inputs.csv. Raises InputError for an invalid row."""
    table = read_csv(path, InputFile._fields, text=("file", "sha256"))
    digests, sizes = pd.Series(table.text("sha256")), table.numbers("n_bytes")
    table.check(~digests.str.fullmatch("[0-9a-f]{64}").to_numpy(bool), lambda _: "sha256 is not 64 hexadecimal digits")
    table.check((sizes < 0) | (sizes % 1 != 0), lambda k: f"n_bytes is {sizes[k]:g}, not a count")
    return [InputFile(n, int(s), d) for n, s, d in zip(table.text("file"), sizes, digests, strict=True)]
