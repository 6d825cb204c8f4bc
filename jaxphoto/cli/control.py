"""`jaxphoto control`: an oriented block and a file of control to the block with it, adjusted and judged."""

from pathlib import Path
from typing import Annotated, Any

import typer

from jaxphoto.cli.exposure_options import map_codes
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.provenance import Provenance
from jaxphoto.errors import InputError
from jaxphoto.extras.photos.control_targets import target_looker
from jaxphoto.extras.photos.targets.on_ground import SYNTAX, read_target
from jaxphoto.io import read_block
from jaxphoto.io.block_folder import whole_block
from jaxphoto.io.control_files import FORMS, read_control
from jaxphoto.io.sound_photographs import in_short, sound_photographs
from jaxphoto.procedures import adjust
from jaxphoto.procedures.control import at_optimum, control_block, control_block_with_targets
from jaxphoto.report import Level, Tables, verdict_of
from jaxphoto.report.control import control_findings, control_summary, write_control
from jaxphoto.report.findings import Verdict
from jaxphoto.report.made import versions
from jaxphoto.report.results import write_results, write_summary
from jaxphoto.writing import check_folder, whole_folder


@command("control")
def control_command(
    output: Output,
    context: typer.Context,
    block: Annotated[Path, typer.Argument(help="Block folder whose images are oriented.")],
    file: Annotated[
        Path,
        typer.Argument(help=f"Surveyed points: {', '.join(FORMS)}."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for block and result; earlier results in it are replaced.")],
    marks: Annotated[Path | None, typer.Option(help="Marks of the points, where FILE has none.")] = None,
    control_epsg: Annotated[
        str | None,
        typer.Option(help="System of the points where FILE does not say it: 25832, 25832+7837 with heights, local."),
    ] = None,
    targets: Annotated[
        str | None, typer.Option(help=f"Targets to find at the points: {', '.join(SYNTAX.values())}.")
    ] = None,
    photographs: Annotated[
        list[Path] | None, typer.Option(help="Folder of the photographs of the block, to find targets in.")
    ] = None,
    epsg: Annotated[
        str | None,
        typer.Option(help="Map system of a block that has none: 25832, 25832+7837 with heights (default: theirs)."),
    ] = None,
) -> None:
    """Adjust an oriented block with control: surveyed points and where photographs show them.

    A block without a place is brought to that of the control. What contradicts the rest is left out and named. Exit
    code 1: written, but the verdict is red.
    """
    check_folder(out, block, file, *((marks,) if marks else ()))
    if (targets is None) != (not photographs):
        raise InputError("targets are found in photographs: give both --targets and --photographs, or neither")
    target, (code, vertical) = read_target(targets) if targets else None, map_codes(epsg)
    with output.progress.status("reading") as status:
        control, given = read_control(file, marks), read_block(block)
        status.update("adjusting the block as it is")
        oriented = at_optimum(adjust(given))
        sound, spoilt = sound_photographs(photographs) if photographs else ([], {})
        paths = {p.name: p.path for p in sound}
        options = {"control_epsg": control_epsg, "targets": targets, "epsg": epsg}
        files = [file, *([marks] if marks else ())]
        signed = Provenance.of_block("control", block, options, files, list(paths.values()))
        how: dict[str, Any] = {"system": control_epsg, "code": code, "vertical": vertical, "report": status.update}
        if target:
            found = control_block_with_targets(oriented, control, target_looker(target, paths, status.update), **how)
        else:
            found = control_block(oriented, control, **how)
        status.update("computing statistics")
        tables = Tables(found.adjusted)
        verdict = Verdict.of([*verdict_of(tables).findings, *control_findings(found)])
        status.update(f"writing {out}")
        images = found.adjusted.block.images
        times = {name: found.adjusted.seconds[name] for name in ("compile", "solve", "covariance")}
        with whole_folder(out) as work:
            with whole_folder(work / "result") as folder:
                told = {"block": "../block", **signed.told}
                write_results(tables, verdict, folder, times, told, made_by(context, block, file, marks))
                signed.write(images, folder)
            write_control(found, work)
            write_summary({**verdict.summary, **control_summary(found), "versions": versions()}, work)
            with whole_block(found.adjusted.block, work / "block") as folder:
                signed.write(images, folder)
    for sentence in in_short(spoilt):
        output.warn(f"no target is looked for in what is left out: {sentence}")
    for sentence in found.sentences:
        output.say(sentence)
    output.say(verdict.headline)
    for finding in verdict.findings:
        if finding.level > Level.INFORMATION or "check point" in finding.text:
            output.say(f"  {finding.text}")
    output.wrote(out, f"results in {out} (open result/report.html)")
    if verdict.level == Level.ALARM:
        raise typer.Exit(1)
