"""`jaxphoto example`: blocks, recipes and experiments that come with jaxphoto, in a folder of the user's."""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.output import Output, command
from jaxphoto.io import read_recipe, write_simulation
from jaxphoto.io.block_folder import check_block_target
from jaxphoto.io.shipped import EXAMPLES, shipped
from jaxphoto.simulation import simulate
from jaxphoto.writing import check_file, check_folder, whole_file, whole_folder

_SIMULATED = ("lidar", "strips")
# What one does with each next; OUT is where it lies.
_NEXT = {
    "cross_block": "jaxphoto adjust OUT --out results",
    "recipe": "jaxphoto simulate OUT --out block",
    "boresight": "jaxphoto simulate OUT --out flight",
    "lidar": "jaxphoto simultaneous OUT OUT/cloud.laz --trajectory OUT/trajectory.csv --out both",
    "strips": "jaxphoto strips OUT/cloud.laz --trajectory OUT/trajectory.csv --block OUT "
    "--adjust boresight,range-offset,angle-scale --cell-m 8 --knots-s 5 --out joint",
    "experiments": "jaxphoto experiment 000 --experiments OUT --layouts 4 --out runs",
}


@command("example")
def example_command(
    output: Output,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help=f"Which: {', '.join(EXAMPLES)}; a list if not given.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Where to write it; else NAME or NAME.toml in this folder.")] = None,
) -> None:
    """Write an example block, recipe or experiment that comes with jaxphoto."""
    if name is None:
        for one, what in EXAMPLES.items():
            output.say(f"{one:12} {what}")
        output.tell(examples=dict(EXAMPLES))
        return
    source = shipped(name)
    target = out if out is not None else Path(name if source.is_dir() or name in _SIMULATED else source.name)
    if name in _SIMULATED:
        check_block_target(target, source)
        with output.progress.status("flying"):
            write_simulation(simulate(read_recipe(source)), target)
    elif source.is_dir():
        check_folder(target)
        with whole_folder(target) as work:
            shutil.copytree(source, work, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    else:
        check_file(target)
        with whole_file(target) as work:
            shutil.copyfile(source, work)
    then = _NEXT[name].replace("OUT", str(target))
    output.wrote(target, f"wrote {target}; next: {then}")
    output.tell(next=then)
