"""`jaxphoto simulate`: a recipe in, a block folder with its truth out, and the cloud of a lidar."""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.output import Output, command
from jaxphoto.io import read_recipe, write_simulation
from jaxphoto.io.block_folder import check_block_target
from jaxphoto.io.recipe.truth import CLOUD, TRAJECTORY
from jaxphoto.simulation import simulate


@command("simulate")
def simulate_command(
    output: Output,
    recipe: Annotated[Path, typer.Argument(help="Recipe in TOML (see docs/simulation.md).")],
    out: Annotated[Path, typer.Option(help="Block folder to write; a block in it is replaced.")],
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws another flight, other points and noise.")] = 0,
) -> None:
    """Simulate a block with known truth."""
    check_block_target(out, recipe)
    with output.progress.status("flying") as status:
        simulation = simulate(read_recipe(recipe), seed)
        status.update(f"writing {out}")
        write_simulation(simulation, out)
    block, cloud = simulation.block, simulation.cloud
    scanned = "" if cloud is None else f", {len(cloud)} laser points in {CLOUD}, their trajectory in {TRAJECTORY}"
    output.wrote(
        out,
        f"wrote {out}: {len(block.images)} images, {len(block.points)} points, "
        f"{len(block.image_points.image)} image points{scanned} (seed {seed}); the truth is in {out / 'truth'}",
    )
    output.tell(
        n_images=len(block.images),
        n_points=len(block.points),
        n_image_points=len(block.image_points.image),
        n_laser_points=0 if cloud is None else len(cloud),
        seed=seed,
    )
