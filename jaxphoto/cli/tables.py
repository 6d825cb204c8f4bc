"""`jaxphoto tables`: result tables for papers and other programs."""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.choices import one_of
from jaxphoto.cli.output import Output, command
from jaxphoto.io import read_result_tables
from jaxphoto.io.results_judged import read_summary, reservation
from jaxphoto.report import TABLE_FORMATS, write_table
from jaxphoto.writing import check_folder, whole_folder


@command("tables")
def tables_command(
    output: Output,
    results: Annotated[Path, typer.Argument(help="Folder of results, such as adjust writes.")],
    to: Annotated[str, one_of(TABLE_FORMATS, help="Format.")],
    out: Annotated[Path, typer.Option(help="Folder for the tables; earlier ones in it are replaced.")],
    only: Annotated[
        str, typer.Option(help="Which tables, with commas between, such as interior,exterior; all if not given.")
    ] = "",
) -> None:
    """Write tables of results as CSV, Parquet, Markdown or LaTeX, with as many digits as their sigmas allow."""
    check_folder(out, results)
    tables = read_result_tables(results, [name.strip() for name in only.split(",") if name.strip()])
    with output.progress.status("writing") as status, whole_folder(out) as work:
        for number, (name, table) in enumerate(tables.items(), 1):
            status.update(f"writing table {number} of {len(tables)}")
            write_table(table, name, work, to)
    if against := reservation(read_summary(results)):
        output.warn(against)
    output.wrote(out, f"{len(tables)} tables in {out}")
    output.tell(tables=list(tables))
