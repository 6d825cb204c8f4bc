"""`jaxphoto dsm` and `jaxphoto orthophoto`: a surface model from a cloud, and a photograph laid over it."""

from functools import partial
from pathlib import Path
from typing import Annotated, get_args

import jax
import numpy as np
import typer

import jaxphoto
from jaxphoto.block import Block
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.cloud_options import Classes, CloudEpsg, CloudUnit, ReturnsOption, class_numbers
from jaxphoto.cli.cloud_progress import CloudProgress
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.progress import StepsLeft
from jaxphoto.errors import BlockError, InputError
from jaxphoto.io import clouds, raster, read_block
from jaxphoto.lidar.orthophoto import orthophoto
from jaxphoto.lidar.raster import Statistic, filled, hillshade, surface_model
from jaxphoto.procedures import adjust
from jaxphoto.writing import check_file


@command("dsm")
def dsm_command(
    output: Output,
    cloud: Annotated[Path, typer.Argument(help="Cloud: .las, .laz, .csv or .ply (see docs/clouds.md).")],
    out: Annotated[Path, typer.Option(help="GeoTIFF to write.")],
    cell_m: Annotated[float, typer.Option(help="Size of a cell in m.")] = 1.0,
    classes: Classes = None,
    returns: ReturnsOption = "all",
    statistic: Annotated[Statistic, one_of(get_args(Statistic), help="Height of a cell.")] = "highest",
    fill_m: Annotated[float, typer.Option(min=0.0, help="Close holes whose cells lie within this of heights.")] = 0.0,
    cloud_epsg: CloudEpsg = None,
    cloud_unit: CloudUnit = None,
    shading: Annotated[Path | None, typer.Option("--hillshade", help="PNG of the shaded surface to write.")] = None,
) -> None:
    """Make a surface model of a cloud."""
    check_file(out, cloud)
    if shading is not None:
        check_file(shading, cloud, out)
    chosen = class_numbers(classes)
    said = {"epsg": cloud_epsg, "unit": cloud_unit}
    with output.progress.status("reading the cloud") as status:
        system = clouds.cloud_system(cloud, **said)  # type: ignore[arg-type]
        ends = clouds.extent(cloud, **said)[:, :2]  # type: ignore[arg-type]
        # One cell more all around: headers are rounded. What stays empty is left out again.
        ends += np.array([[-cell_m], [cell_m]])
        parts = partial(clouds.cloud_chunks, cloud, classes=chosen, returns=returns, **said)  # type: ignore[arg-type]
        # Of a file that is filtered nobody knows how much will come.
        most = clouds.point_count(cloud) if chosen is None and returns == "all" else None
        seen = CloudProgress(StepsLeft(output.progress, status), status, most).passes(parts)
        surface = surface_model((part.xyz for part in seen()), ends, cell_m, statistic)  # type: ignore[arg-type]
        status.update(f"writing {out}")
        surface = filled(surface, fill_m)
        raster.write_dsm(out, surface, system)
        if shading is not None:
            raster.write_hillshade(shading, hillshade(surface))
    rows, columns = surface.heights.shape
    there = 100 * (1 - np.isnan(surface.heights).mean())
    low, high = np.nanmin(surface.heights), np.nanmax(surface.heights)
    output.wrote(
        out,
        f"wrote {out}: {columns} x {rows} cells of {cell_m:g} m, {there:.0f} % with heights, {low:.2f} to "
        f"{high:.2f} m, in {system.name}",
    )
    if shading is not None:
        output.wrote(shading, f"wrote {shading}")
    output.tell(columns=columns, rows=rows, cell_m=cell_m, part_with_heights=there / 100, low_m=low, high_m=high)
    output.tell(system=system.name)


@command("orthophoto")
def orthophoto_command(
    output: Output,
    block: Annotated[Path, typer.Argument(help="Block folder (see docs/block_folder.md).")],
    photo: Annotated[Path, typer.Argument(help="The photograph of the image.")],
    dsm: Annotated[Path, typer.Argument(help="Surface model to lay it over.")],
    image: Annotated[str, typer.Option(help="Id of the image in the block.")],
    out: Annotated[Path, typer.Option(help="GeoTIFF to write.")],
    dsm_epsg: Annotated[int | None, typer.Option(help="EPSG code of the surface model, where it does not say.")] = None,
    max_steps: Annotated[int, typer.Option(min=1, help="Most iterations.")] = jaxphoto.MAX_STEPS,
) -> None:
    """Adjust a block, and lay the photograph of one of its images over a surface model."""
    check_file(out, block, photo, dsm)
    with output.progress.status("reading") as status:
        read = read_block(block)
        at = _image(read, image)
        sensor = read.sensors[read.image_camera[at]]
        surface, system = raster.read_dsm(dsm, dsm_epsg)
        way = clouds.Placement(dsm.name, system, read.frame, "--dsm-epsg")
        pixels = raster.read_photograph(photo, sensor)
        status.update("adjusting")
        adjusted = adjust(read, max_steps=max_steps)
        if not bool(adjusted.converged):
            raise BlockError(f"{adjusted.outcome.value}: without an adjusted orientation there is no orthophoto")
        status.update("resampling")
        exterior = jax.tree.map(lambda v: np.asarray(v)[at], adjusted.unknowns.exterior)
        picture = orthophoto(
            surface,
            pixels,
            sensor,
            adjusted.unknowns.interior[read.image_camera[at]],
            exterior,
            object_from_map=way.frame_from_metres,
            map_from_object=way.metres,
            corrections=read.corrections,
        )
        if not picture.seen.any():
            (west, south), (east, north) = surface.extent
            x, y, z = way.metres(np.asarray(exterior.position)[None])[0]
            raise InputError(
                f"image {image}, from ({x:.1f}, {y:.1f}, {z:.1f}) m, sees nothing of {dsm.name} (X {west:.1f} to "
                f"{east:.1f}, Y {south:.1f} to {north:.1f} m, Z {np.nanmin(surface.heights):.1f} to "
                f"{np.nanmax(surface.heights):.1f} m); name the surface model of this area"
            )
        raster.write_orthophoto(out, picture, surface, system)
    seen = picture.seen.mean()
    output.wrote(out, f"wrote {out}: image {image} on {100 * seen:.0f} % of the cells of {dsm.name}")
    output.tell(image=image, part_seen=seen)


def _image(block: Block, name: str) -> int:
    if name not in block.images:
        some = ", ".join(block.images[:5]) + (" ..." if len(block.images) > 5 else "")
        raise InputError(f"--image {name}: the block has no such image; it has {some}")
    return block.images.index(name)
