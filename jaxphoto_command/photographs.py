"""Commands that start from photographs."""

import time
from functools import partial
from itertools import count
from pathlib import Path
from threading import Thread
from typing import Annotated, Any, get_args

import typer
from typer import Argument, Option

from jaxphoto_command import options as opt
from jaxphoto_command.application import command
from jaxphoto_command.output import Output

PANEL = "Photographs"
_EXAMPLE = "jaxphoto example photographs && "
_CONTROL = "gcp_list.txt, markers of Metashape, CSV, table of Pix4D"


@command("fly", PANEL, f"{_EXAMPLE}jaxphoto fly photographs --features 1000 --out flight")
def fly(
    output: Output,
    photographs: opt.Photographs,
    out: opt.Out,
    pairs: opt.Pairs = None,
    epsg: opt.MapSystem = None,
    features: opt.Features = None,
    longest_px: opt.LongestSide = None,
    c_mm: opt.PrincipalDistance = None,
    pixel_mm: opt.PixelSize = None,
    model: opt.Distortion = "brown",
    no_lens_prior: Annotated[
        bool, Option("--no-lens-prior", help="Ignore prior information on the lens type (docs/target_calibration.md).")
    ] = False,
    rolling_shutter: Annotated[
        bool, Option("--rolling-shutter", help="Estimate the rolling-shutter readout from positions and times.")
    ] = False,
    exposures: Annotated[
        list[Path] | None, Option(help="Exposure files outside the folders: .MRK, .pos, SBET, a table.")
    ] = None,
    lever_arm: Annotated[str | None, Option(help="Lever arm from camera to antenna (m): right,forward,up.")] = None,
    heights: Annotated[
        str | None,
        Option(help="Height reference, if not in the files: ellipsoid, geoid, take-off, or EPSG code (EGM96: 5773)."),
    ] = None,
    control: Annotated[Path | None, Option(help=f"Surveyed points: {_CONTROL}.")] = None,
    marks: opt.ControlMarks = None,
    control_epsg: opt.ControlSystem = None,
) -> None:
    """Calibrate the camera of a flight from its photographs and their positions: orient, georeference, adjust, assess.

    Unusable photographs are skipped and listed. Exit code 1: results written, but the verdict is red.
    """

    from jaxphoto.camera import InteriorOrientation
    from jaxphoto.errors import counted
    from jaxphoto.extras.formats import read_control
    from jaxphoto.extras.photos.features import LONGEST_PX
    from jaxphoto.extras.photos.matching import (
        MostSimilar,
        match_photographs,
        photograph_pairs,
        usual_choice,
        usual_count,
    )
    from jaxphoto.georeferencing.map_frame import check_heights
    from jaxphoto.georeferencing.recorded_positions import WGS84
    from jaxphoto.io.block_folder import whole_block
    from jaxphoto.io.exposures import exposure_files, located
    from jaxphoto.io.photographs import (
        known_lens,
        sensor_and_interior,
        skipped_messages,
        skipped_subfolders,
        valid_photographs,
    )
    from jaxphoto.io.result_folder import write_photograph_files
    from jaxphoto.procedures.calibration import distortion_model
    from jaxphoto.procedures.flight import KnownOfFlight, calibrate_flight, flight_control
    from jaxphoto.report import prepare_pictures
    from jaxphoto.report.flight import FlightSource, part_folder, print_flight, report_of, write_flight
    from jaxphoto.report.photographs import write_orientation
    from jaxphoto.writing import check_folder, whole_folder
    from jaxphoto_command.certificate import Provenance, certify

    if control is None and (marks or control_epsg):
        raise typer.BadParameter("--marks and --control-epsg need --control FILE.")
    control_files = [path for path in (control, marks) if path]
    check_folder(out, *photographs, *control_files, *(exposures or ()))
    surveyed = read_control(control, marks) if control else None
    code, vertical = map_codes(epsg)
    reference, arm = height_reference(heights), _lever_arm(lever_arm)
    if isinstance(reference, int):
        check_heights(WGS84, reference)
    Thread(target=prepare_pictures, daemon=True).start()
    with output.progress("reading the photographs") as progress:
        read, corrupt = valid_photographs(photographs)
        for text in (*skipped_messages(corrupt), *skipped_subfolders(photographs).values()):
            output.warn(f"skipped: {text}")
        positions = located(read, photographs, exposures or (), code=code, arm=arm, heights=reference)
        read = positions.photographs
        output.say(*positions.sentences)
        points = None
        if surveyed:
            stations = [p.name for p in read], [p.gps for p in read]
            points, code = flight_control(surveyed, control_epsg, *stations, code)
        camera = sensor_and_interior(read, pixel_mm, c_mm)
        distortion = distortion_model(model, camera.sensor)
        choice, number = pairs or usual_choice(read), features or usual_count(len(read))
        compared = photograph_pairs(read, choice)
        matches = "pairs by similarity" if isinstance(compared, MostSimilar) else counted(len(compared), "pair")
        output.say(camera.origin, f"{counted(len(read), 'photograph')}, {matches} to match")
        matched = match_photographs(
            read,
            camera.sensor,
            camera.interior,
            compared,
            count=number,
            longest_px=longest_px or LONGEST_PX,
            in_parts=True,
            progress=progress.steps,
        )
        initial = camera.interior
        taken = {p.name: (p.taken.clock_s, p.taken.resolution_s) for p in read if p.taken}
        flight = calibrate_flight(
            matched.named([p.name for p in read]),
            camera.sensor,
            InteriorOrientation(initial.c, initial.xp, initial.yp, distortion),
            KnownOfFlight(
                {p.name: p.gps for p in read},
                {p.name: p.attitude for p in read},
                code,
                points,
                None if no_lens_prior else known_lens(read, camera, distortion),
                taken if rolling_shutter else None,
                vertical,
            ),
            progress.update,
        )
        flight = flight._replace(left_out=matched.left_out | flight.left_out)
        progress.update("computing statistics")
        reports = [report_of(part) for part in flight.parts]
        in_folders = [path for folder in photographs if folder.is_dir() for path in exposure_files(folder)]
        others = dict.fromkeys([*control_files, *(exposures or ()), *in_folders])
        provenance = Provenance.of([p.path for p in read], list(others))
        progress.update(f"writing {out}")
        with whole_folder(out) as work:
            write_photograph_files({p.name: p.path.name for p in read}, work)
            source = FlightSource(
                positions.sentences,
                camera.origin,
                initial,
                provenance.conditions_for(flight.parts[0].adjusted.block.images),
                provenance.inputs,
                output.options(pairs=choice, features=number, longest_px=longest_px or LONGEST_PX),
                output.command_line(),
            )

            def write_provenance(part: Any, folder: Path) -> None:
                provenance.write(part.adjusted.block.images, folder)

            verdict = write_flight(flight, reports, corrupt, work, source, write_provenance)
            for k, part in enumerate(flight.parts, 1):
                with whole_block(part.adjusted.block, work / part_folder(k, "block")) as folder:
                    matching = {"n_gross": part.matched.n_gross, "sigma_factor": part.matched.sigma_factor}
                    write_orientation(part.oriented, folder, **matching)
                    write_provenance(part, folder)
            no_certificate = certify(work)
    print_flight(flight, reports, verdict, initial, output.screen)
    if no_certificate:
        output.say(f"no certificate: {no_certificate}")
    output.wrote(out, f"results in {out} (open report.html)")
    if verdict.severity == "error":
        raise typer.Exit(1)


@command(
    "control",
    PANEL,
    f"{_EXAMPLE}jaxphoto orient photographs/*.jpg --features 1000 --out block && "
    "jaxphoto control block photographs/gcp_list.txt --out controlled",
)
def control(
    output: Output,
    block: Annotated[Path, Argument(help="Block folder with oriented images.")],
    file: Annotated[Path, Argument(help=f"Surveyed points: {_CONTROL}.")],
    out: opt.Out,
    marks: opt.ControlMarks = None,
    control_epsg: opt.ControlSystem = None,
    epsg: opt.MapSystem = None,
) -> None:
    """Adjust an oriented block with surveyed points and their image measurements.

    A block without a datum is transformed to the control. Contradictory observations are rejected and listed. Exit code
    1: results written, but the verdict is red.
    """
    from jaxphoto.extras.formats import read_control
    from jaxphoto.io import read_block
    from jaxphoto.io.block_folder import whole_block
    from jaxphoto.procedures.adjust import adjust
    from jaxphoto.procedures.control import at_optimum, control_block, retest
    from jaxphoto.procedures.weights import estimate_weights
    from jaxphoto.report import Tables, component_findings, verdict_of
    from jaxphoto.report.page import versions
    from jaxphoto.report.photographs import control_findings, control_summary, write_control
    from jaxphoto.report.results import write_results, write_summary
    from jaxphoto.writing import check_folder, whole_folder
    from jaxphoto_command.certificate import Provenance

    files = [path for path in (file, marks) if path]
    check_folder(out, block, *files)
    code, vertical = map_codes(epsg)
    with output.progress("reading") as progress:
        points, read = read_control(file, marks), read_block(block)
        progress.update("adjusting the block")
        oriented = at_optimum(adjust(read))
        provenance = Provenance.of_block(block, files, [])
        result = control_block(
            oriented, points, system=control_epsg, code=code, vertical=vertical, report=progress.update
        )
        stated = Tables(result.adjusted)
        components = None
        if bool(result.adjusted.converged):
            components = estimate_weights(result.adjusted, redundancy=stated.redundancy, report=progress.update)
        result = retest(result, components.adjusted) if components else result
        progress.update("computing statistics")
        adjusted = result.adjusted
        tables = Tables(adjusted) if components else stated
        weights = component_findings(components, weights=(stated, tables)) if components else []
        verdict = verdict_of(tables, [*weights, *control_findings(result)])
        progress.update(f"writing {out}")
        images = adjusted.block.images
        times = {name: adjusted.seconds[name] for name in ("compile", "solve", "covariance")}
        with whole_folder(out) as work:
            with whole_folder(work / "result") as folder:
                method = {"block": "../block", **output.options()}
                record = output.command_record(block, file, marks)
                write_results(tables, verdict, folder, times, method, record, components=components)
                provenance.write(images, folder)
            write_control(result, work)
            write_summary({**verdict.summary, **control_summary(result), "versions": versions()}, work)
            with whole_block(adjusted.block, work / "block") as folder:
                provenance.write(images, folder)
    output.say(*result.sentences, verdict.headline)
    for finding in verdict.findings:
        if finding.severity != "note" or finding.code == "check_points":
            output.say(f"  {finding.text}")
    output.wrote(out, f"results in {out} (open result/report.html)")
    if verdict.severity == "error":
        raise typer.Exit(1)


@command(
    "calibrate",
    PANEL,
    "jaxphoto example board && jaxphoto calibrate board/*.jpg --board chessboard:8x6:square_mm=30 --out camera",
    "Boards: chessboard:8x6:square_mm=30, circles:4x11:spacing_mm=20:diameter_mm=15, "
    "charuco:7x5:square_mm=30:marker_mm=22:dictionary=4X4_50.",
)
def calibrate(
    output: Output,
    images: Annotated[list[Path], Argument(help="Photographs of the board, taken by one camera at constant focus.")],
    board: Annotated[str, Option(help="Board; see the formats below.")],
    out: opt.Out,
    model: opt.Distortion = "smac",
    r0_mm: opt.R0 = None,
    free: opt.FreeParameters = None,
    pixel_mm: opt.PixelSize = None,
    c_mm: opt.PrincipalDistance = None,
    board_sigma_mm: Annotated[
        float | None,
        Option(callback=opt.positive, help="Standard deviation of the board's coordinates (default: fixed)."),
    ] = None,
    max_steps: opt.MaxSteps = 100,
) -> None:
    """Calibrate a camera with photographs of a board.

    Exit code 1: results written, but not converged.
    """
    from jaxphoto.extras.photos.features import read_grey
    from jaxphoto.extras.photos.targets import find_targets, read_board
    from jaxphoto.io import write_block
    from jaxphoto.io.photographs import photographs, sensor_and_interior
    from jaxphoto.procedures.calibration import calibrate, distortion_model, free_parameters
    from jaxphoto.report import prepare_pictures, print_adjustment, verdict_of
    from jaxphoto.report.photographs import print_calibration, write_calibration
    from jaxphoto.writing import check_folder

    check_folder(out, *images)
    pattern, taken = read_board(board), photographs(images)
    camera = sensor_and_interior(taken, pixel_mm, c_mm)
    wanted = None if free is None else opt.names(free)
    free_parameters(model, distortion_model(model, camera.sensor, r0_mm or 0.0), wanted)
    Thread(target=prepare_pictures, daemon=True).start()
    start, number = time.perf_counter(), count(1)
    with output.progress("detecting the board") as progress:
        targets = find_targets(
            taken, pattern, lambda _: progress.steps("detecting the board", next(number), len(taken))
        )
        seconds = {"read": time.perf_counter() - start}
        progress.update(f"calibrating with {len(targets.detections)} photographs")
        result = calibrate(
            pattern.board,
            targets.detections,
            camera.sensor,
            camera.interior,
            model=model,
            r0_mm=r0_mm or 0.0,
            free=wanted,
            board_sigma_m=None if board_sigma_mm is None else board_sigma_mm / 1000,
            max_steps=max_steps,
        )
        result = result._replace(left_out=targets.left_out | result.left_out)
        progress.update(f"writing {out}")
        tables = write_calibration(
            result,
            out,
            seconds,
            {photograph.name: partial(read_grey, photograph.path) for photograph in taken},
            lambda folder: write_block(result.adjusted.block, folder / "block"),
            detections=targets.detections,
            start=camera.origin,
            record=output.command_record(*images),
            # Add a note if the pixel size is assumed: all lengths in the report scale with it.
            notes=() if pixel_mm is not None else (camera.origin,),
        )
    output.say(camera.origin)
    print_adjustment(tables, verdict_of(tables), output.screen)
    print_calibration(result, output.screen)
    output.wrote(out, f"results in {out} (open report.html and photographs.html)")
    if not result.converged:
        raise typer.Exit(1)


@command("orient", PANEL, f"{_EXAMPLE}jaxphoto orient photographs/*.jpg --features 1000 --out block")
def orient(
    output: Output,
    images: Annotated[list[Path], Argument(help="Photographs of one camera.")],
    out: opt.BlockOut,
    pairs: opt.Pairs = None,
    features: opt.Features = None,
    longest_px: opt.LongestSide = None,
    c_mm: opt.PrincipalDistance = None,
    pixel_mm: opt.PixelSize = None,
    model: opt.Distortion = "brown",
    r0_mm: opt.R0 = None,
) -> None:
    """Orient photographs by their features, as initial values for `jaxphoto adjust`.

    Exit code 1: results written, but not converged.
    """
    from jaxphoto.camera import InteriorOrientation
    from jaxphoto.extras.photos.features import LONGEST_PX
    from jaxphoto.extras.photos.matching import match_photographs, photograph_pairs, usual_choice
    from jaxphoto.io.block_folder import whole_block
    from jaxphoto.io.photographs import photographs, sensor_and_interior
    from jaxphoto.io.text_files import read_json
    from jaxphoto.procedures.calibration import distortion_model
    from jaxphoto.procedures.orientation import orient
    from jaxphoto.report.photographs import orientation_sentences, write_orientation
    from jaxphoto.writing import check_folder

    check_folder(out, *images)
    with output.progress("reading the photographs") as progress:
        read = photographs(images)
        camera = sensor_and_interior(read, pixel_mm, c_mm)
        distortion = distortion_model(model, camera.sensor, r0_mm or 0.0)
        compared = photograph_pairs(read, pairs or usual_choice(read))
        output.say(camera.origin)
        initial = camera.interior
        matched = match_photographs(
            read,
            camera.sensor,
            initial,
            compared,
            count=features,
            longest_px=longest_px or LONGEST_PX,
            progress=progress.steps,
        )
        result = orient(
            [p.name for p in read],
            camera.sensor,
            InteriorOrientation(initial.c, initial.xp, initial.yp, distortion),
            matched.xy_mm,
            matched.pairs,
            matched.sigma_mm,
            title=f"{len(read)} photographs",
            report=progress.update,
        )
        # Report the reason given by the matching for photographs without matches.
        reasons = {name: matched.left_out.get(name, text) for name, text in result.report.unoriented.items()}
        result = result._replace(report=result.report._replace(unoriented=reasons))
        progress.update(f"writing {out}")
        with whole_block(result.block, out) as folder:
            write_orientation(result, folder, n_gross=matched.n_gross, sigma_factor=matched.sigma_factor)
    output.say(
        f"{matched.n_gross} matches rejected before orientation (off the epipolar line, or in pairs with too few); "
        f"sigma factor of the others {matched.sigma_factor:.2g}"
    )
    output.say(*orientation_sentences(result.report))
    output.wrote(out, f"wrote {out}: adjust it with jaxphoto adjust {out} --out DIR")
    output.add(**read_json(out / "orientation.json"))
    if not result.report.converged:
        raise typer.Exit(1)


def map_codes(text: str | None) -> tuple[int | None, int | None]:
    """Parse the EPSG codes of a map system and of its heights, such as `25832+7837`."""
    from jaxphoto.georeferencing.map_frame import check_heights, map_system

    if text is None:
        return None, None
    plan, plus, heights = text.removeprefix("EPSG:").partition("+")
    if not plan.isdecimal() or bool(plus) != heights.isdecimal():
        raise typer.BadParameter(f"--epsg {text}: give the code of a map system, 25832, or with heights, 25832+7837.")
    code, vertical = int(plan), int(heights) if heights else None
    if (system := map_system(code)).is_geographic:
        raise typer.BadParameter(
            f"--epsg {code} ({system.name}) is longitude and latitude; give a map system in metres, like 25832."
        )
    if vertical is not None:
        check_heights(code, vertical)
    return code, vertical


def height_reference(text: str | None) -> Any:
    """Return the height reference, or the EPSG code of the height system."""
    from jaxphoto.georeferencing.recorded_positions import Heights

    if text is None or (text in get_args(Heights) and text != "unknown"):
        return text
    code = text.removeprefix("EPSG:")
    if not code.isdecimal():
        raise typer.BadParameter(f"--heights {text}: give ellipsoid, geoid, take-off, or an EPSG code (EGM96: 5773).")
    return int(code)


def _lever_arm(text: str | None) -> tuple[float, float, float] | None:
    """Parse a lever arm: metres to the right, forward and up."""
    if text is None:
        return None
    try:
        right, forward, up = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"--lever-arm {text}: give three numbers in metres, right,forward,up, like 0,0.03,0.19."
        ) from None
    return right, forward, up
