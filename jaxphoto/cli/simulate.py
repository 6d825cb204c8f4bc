"""`jaxphoto simulate`: a recipe in, a block folder with its truth out, and the cloud of a lidar."""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.app import app
from jaxphoto.cli.console import plain_console
from jaxphoto.io import read_recipe, write_simulation
from jaxphoto.io.block_folder import check_block_target
from jaxphoto.io.recipe.scan_files import CLOUD, TRAJECTORY
from jaxphoto.simulation import simulate


@app.command("simulate")
def simulate_command(
    recipe: Annotated[Path, typer.Argument(help="Recipe in TOML (see docs/simulation.md).")],
    out: Annotated[Path, typer.Option(help="Block folder to write; a block in it is replaced.")],
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws another flight, other points and noise.")] = 0,
) -> None:
    """Simulate a block with known truth."""
    check_block_target(out, recipe)
    simulation = simulate(read_recipe(recipe), seed)
    write_simulation(simulation, out)
    block, cloud = simulation.block, simulation.cloud
    scanned = "" if cloud is None else f", {len(cloud)} laser points in {CLOUD}, their trajectory in {TRAJECTORY}"
    plain_console().print(
        f"wrote {out}: {len(block.images)} images, {len(block.points)} points, "
        f"{len(block.image_points.image)} image points{scanned} (seed {seed}); the truth is in {out / 'truth'}",
        soft_wrap=True,
    )
